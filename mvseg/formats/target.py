"""The target: a page to print, A4, with shapes of known area among AprilTags. It is target.pdf, and so are its areas.

Lengths are millimetres, from the top left corner of the page, x to the right, y down. Does not import torch.
"""

from __future__ import annotations

import shutil
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path

import numpy as np

from mvseg.arrays import Floats
from mvseg.errors import InputError
from mvseg.formats.board import Family
from mvseg.system.atomic import write_whole

FAMILY: Family = "APRILTAG_36H11"
PAGE = Path(__file__).with_suffix(".pdf")
INK = "0.8353 0.0000 0.4706 rg\n"  # the colour of the shapes, as the page sets it: unlike wood, soil, skin and leaves
TAG = 25.0  # definition: side of a tag's black square
TAG_COLUMNS, TAG_ROWS = (12.0, 65.0, 120.0, 173.0), (12.0, 125.0, 238.0)  # definition: their left and upper edges
BAR = 100.0  # definition: length of the scale bar
PAPER = 4.0  # definition: around each shape, nothing else is printed
SIGN = b"(mvseg target: AprilTags"  # by which the page is known


@dataclass(frozen=True, eq=False)
class Shape:
    """A filled polygon, named as in the tables; `outline` are its (P, 2) corners, whole micrometres, as in the file."""

    name: str
    outline: Floats

    @property
    def area(self) -> float:
        """Area of the polygon, mm^2: exact."""
        x, y = self.outline.T
        return float(abs(x @ np.roll(y, 1) - y @ np.roll(x, 1)) / 2)

    @property
    def cell(self) -> Floats:
        """(4, 2) corners of the box around it in which all else is white paper."""
        (left, top), (right, bottom) = self.outline.min(0) - PAPER, self.outline.max(0) + PAPER
        return np.array([[left, top], [right, top], [right, bottom], [left, bottom]])


@cache
def list_shapes() -> tuple[Shape, ...]:
    """The shapes of the page: a disc and three leaves, one of them bent."""
    filled = PAGE.read_text(encoding="ascii").split(INK)[1:]
    names = ("disc", "broad leaf", "narrow leaf", "bent leaf")
    lines = [part.partition("\nh")[0].split() for part in filled]  # x y and "m" or "l", for each corner
    outlines = [np.array(words).reshape(-1, 3)[:, :2].astype(float) for words in lines]
    return tuple(Shape(name, outline) for name, outline in zip(names, outlines, strict=True))


def tag_corners() -> dict[int, Floats]:
    """{number of the tag: (4, 2) corners, clockwise from its top left}."""
    square = TAG * np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]])
    return {number: square + place for number, place in enumerate((x, y) for y in TAG_ROWS for x in TAG_COLUMNS)}


def tag_distance() -> float:
    """Between the centres of the first and the last tag."""
    corners = tag_corners()
    return float(np.linalg.norm((corners[len(corners) - 1] - corners[0])[0]))


def write_target(path: Path) -> None:
    """Write the page, whole or not at all; its folder is made. Raises InputError if it would not be called .pdf."""
    if path.suffix.lower() != ".pdf":
        raise InputError(f"{path}: expected a name that ends with .pdf")
    path.parent.mkdir(parents=True, exist_ok=True)
    write_whole(path, partial(shutil.copyfile, PAGE))
