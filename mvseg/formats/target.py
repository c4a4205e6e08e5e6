"""The target: a page to print, A4, with shapes of known area among AprilTags, as PDF.

Lengths are millimetres, from the top left corner of the page, x to the right, y down. Does not import torch.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mvseg.errors import InputError
from mvseg.formats.board import Family, marker_dictionary
from mvseg.system.atomic import write_text_whole

Floats = NDArray[np.float64]

WIDTH, HEIGHT = 210.0, 297.0
FAMILY: Family = "APRILTAG_36H11"
TAG, MODULES = 25.0, 8  # side of a tag's black square, and how many modules that is
TAG_COLUMNS, TAG_ROWS = (12.0, 65.0, 120.0, 173.0), (12.0, 125.0, 238.0)  # their left and upper edges
BAR, BAR_LEFT, BAR_TOP = 100.0, 12.0, 269.0  # the scale bar
FONT_SIZE = 3.0
BLACK, INK = (0, 0, 0), (213, 0, 120)  # sRGB; of the shapes: unlike wood, soil, skin and leaves
PAPER = 4.0  # around each shape, nothing else is printed
POINTS = 360  # of half an outline
POINTS_PER_MM = 72 / 25.4  # of PDF
SIGN = b"(mvseg target: AprilTags"  # by which the page is known


@dataclass(frozen=True, eq=False)
class Shape:
    """A filled polygon.

    Attributes:
        name: as the tables have it.
        outline: (P, 2) its corners, whole micrometres, as the file has them.
    """

    name: str
    outline: Floats

    @property
    def area(self) -> float:
        """Of the polygon, mm^2: exact."""
        x, y = self.outline.T
        return float(abs(x @ np.roll(y, 1) - y @ np.roll(x, 1)) / 2)

    @property
    def cell(self) -> Floats:
        """(4, 2) corners of the box around it in which all else is white paper."""
        (left, top), (right, bottom) = self.outline.min(0) - PAPER, self.outline.max(0) + PAPER
        return np.array([[left, top], [right, top], [right, bottom], [left, bottom]])


def list_shapes() -> tuple[Shape, ...]:
    """The shapes of the page: a disc and three leaves, one of them bent."""
    turn = np.linspace(0, 2 * np.pi, 2 * POINTS, endpoint=False)
    outlines = {
        "disc": 35 * np.stack([np.cos(turn), np.sin(turn)], 1),
        "broad leaf": leaf_outline(72, 54, ends=(0.6, 0.9)),
        "narrow leaf": leaf_outline(72, 24, ends=(0.8, 1.0)),
        "bent leaf": leaf_outline(76, 30, ends=(0.7, 0.9), bend=np.radians(70)),
    }
    centers = ((58.0, 81.0), (152.0, 81.0), (58.0, 194.0), (152.0, 194.0))
    placed = []
    for (name, outline), center in zip(outlines.items(), centers, strict=True):
        middle = (outline.min(0) + outline.max(0)) / 2
        placed.append(Shape(name, (outline - middle + center).round(3)))
    return tuple(placed)


def leaf_outline(length: float, width: float, *, ends: tuple[float, float], bend: float = 0.0) -> Floats:
    """(2 POINTS - 2, 2) outline of a flat leaf with its tip up; u runs along the midrib from 0 at the base to 1.

    Args:
        length: of the midrib, an arc of a circle.
        width: at the widest place.
        ends: powers of u and 1 - u in the half width: 0.5 is round, 1 is pointed.
        bend: angle between the midrib's directions at base and tip, radians.
    """
    u = (1 - np.cos(np.linspace(0, np.pi, POINTS))) / 2
    half = u ** ends[0] * (1 - u) ** ends[1]
    half *= width / 2 / half.max()
    angle = bend * (u - 0.5)
    # the midrib is the integral of its direction; sinc keeps the straight leaf
    chord = length * (u - 0.5) * np.sinc(angle / 2 / np.pi)
    midrib = chord[:, None] * np.stack([np.sin(angle / 2), -np.cos(angle / 2)], 1)
    across = half[:, None] * np.stack([np.cos(angle), np.sin(angle)], 1)
    return np.concatenate([midrib + across, (midrib - across)[-2:0:-1]])


def tag_corners() -> dict[int, Floats]:
    """{number of the tag: (4, 2) corners, clockwise from its top left}."""
    square = TAG * np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]])
    places = [(x, y) for y in TAG_ROWS for x in TAG_COLUMNS]
    return {number: square + place for number, place in enumerate(places)}


def tag_distance() -> float:
    """Between the centres of the first and the last tag."""
    corners = tag_corners()
    return float(np.linalg.norm((corners[len(corners) - 1] - corners[0])[0]))


def tag_modules(number: int) -> NDArray[np.bool_]:
    """(MODULES, MODULES): which modules of a tag are black, the border included."""
    return np.asarray(marker_dictionary(FAMILY).generateImageMarker(number, MODULES, borderBits=1) == 0)


def write_target(path: Path) -> None:
    """Write the page, whole or not at all; its folder is made.

    Raises:
        InputError: it would not be called .pdf.
    """
    if path.suffix.lower() != ".pdf":
        raise InputError(f"{path}: expected a name that ends with .pdf")
    path.parent.mkdir(parents=True, exist_ok=True)
    write_text_whole(path, _as_pdf())


def _paths() -> list[tuple[tuple[int, int, int], list[Floats]]]:
    """What is filled: colour and polygons. All modules of a tag are one path, so that no seams show between them."""
    paths = [(INK, [shape.outline]) for shape in list_shapes()]
    for number, corners in tag_corners().items():
        cells = np.argwhere(tag_modules(number))[:, ::-1]
        square = np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
        paths.append((BLACK, [corners[0] + TAG / MODULES * (square + cell) for cell in cells]))
    bars = [(0.0, 1.5, BAR, 1.0), (0.0, 0.0, 0.3, 4.0), (BAR - 0.3, 0.0, 0.3, 4.0)]  # left, top, width, height
    for left, top, width, height in bars:
        box = np.array([[0, 0], [width, 0], [width, height], [0, height]])
        paths.append((BLACK, [box + (BAR_LEFT + left, BAR_TOP + top)]))
    return paths


def _lines() -> list[tuple[float, float, str]]:
    """What is written: x, y of the baseline, text."""
    tags = f"AprilTags 36h11 of {TAG:g} mm, {tag_distance():.2f} mm from the centre of the first to that of the last"
    areas = ", ".join(f"{shape.name} {shape.area:.1f} mm2" for shape in list_shapes())
    return [
        (BAR_LEFT + BAR + 3, BAR_TOP + 3.2, "100 mm between the outer edges: measure it with a ruler"),
        (BAR_LEFT, BAR_TOP + 9, "Print on A4 at 100 % (not \"fit to page\"), in colour, on matt paper; keep it flat."),
        (BAR_LEFT, BAR_TOP + 13.5, f"mvseg target: {tags}"),
        (BAR_LEFT, BAR_TOP + 18, areas),
    ]  # fmt: skip


def _as_pdf() -> str:
    """One page in ASCII, so that characters are bytes; its coordinates are turned over, to millimetres with y down."""
    k = POINTS_PER_MM
    parts = [f"{k:.9f} 0 0 {-k:.9f} 0 {k * HEIGHT:.6f} cm"]
    for color, polygons in _paths():
        parts.append(" ".join(f"{value / 255:.4f}" for value in color) + " rg")
        for polygon in polygons:
            first, *others = (f"{x:.6g} {y:.6g}" for x, y in polygon)
            parts.append("\n".join([f"{first} m", *(f"{each} l" for each in others), "h"]))
        parts.append("f")
    for x, y, text in _lines():
        words = text.replace("(", r"\(").replace(")", r"\)")
        parts.append(f"BT /F {FONT_SIZE:g} Tf 1 0 0 -1 {x:g} {y:g} Tm ({words}) Tj ET")
    content = "\n".join(parts)
    objects = [
        "<< /Type /Catalog /Pages 2 0 R >>",
        "<< /Type /Pages /Kids [3 0 R] /Count 1 >>",
        f"<< /Type /Page /Parent 2 0 R /MediaBox [0 0 {k * WIDTH:.6f} {k * HEIGHT:.6f}] /Contents 4 0 R "
        "/Resources << /Font << /F << /Type /Font /Subtype /Type1 /BaseFont /Helvetica >> >> >> >>",
        f"<< /Length {len(content)} >>\nstream\n{content}\nendstream",
    ]
    text, offsets = "%PDF-1.4\n", []
    for number, each in enumerate(objects, start=1):
        offsets.append(len(text))
        text += f"{number} 0 obj\n{each}\nendobj\n"
    table = "".join(f"{offset:010d} 00000 n \n" for offset in offsets)
    size, start = len(objects) + 1, len(text)
    text += f"xref\n0 {size}\n0000000000 65535 f \n{table}"
    return text + f"trailer\n<< /Size {size} /Root 1 0 R >>\nstartxref\n{start}\n%%EOF\n"
