"""`tracks.html`, one offline page of a plant over days, and `growth.png` for papers."""

from __future__ import annotations

import base64
import html
import math
from collections.abc import Sequence
from importlib.resources import files
from pathlib import Path
from string import Template
from typing import Any

import cv2
import numpy as np
from PIL import Image, ImageDraw
from pydantic import BaseModel

from mvseg.errors import InputError
from mvseg.formats.image_file import encode_jpeg, write_png
from mvseg.formats.json_file import read_json
from mvseg.formats.label_png import read_labels
from mvseg.results.overlay import instance_color
from mvseg.results.report.page import dump_inside_script
from mvseg.tracking.dates import ROWS, PlantOnDate
from mvseg.tracking.growth import SIZES, fit_curves, growth_points
from mvseg.tracking.track import Tracks

PAGE_FILE, INDEX_FILE, CHART_FILE = "tracks.html", "tracks.html", "growth.png"
CROP, QUALITY = 72, 70  # pixels and JPEG quality of a leaf's picture
CURVE_STEPS = 40
CHART = (1500, 1000)  # pixels of growth.png
ASSETS = files("mvseg.tracking") / "assets"


class _Image(BaseModel):
    file_name: str
    name: str


class _Images(BaseModel):
    images: list[_Image]


class _Inputs(BaseModel):
    inputs: dict[str, str] = {}


def write_page(folder: Path, tracks: Tracks) -> None:
    """Write tracks.html and growth.png into a folder.

    Raises:
        OSError: they cannot be written.
    """
    page = Template((ASSETS / "tracks.page.html").read_text(encoding="utf-8")).substitute(
        title=html.escape(f"{tracks.plant} - mvseg track"),
        style=(ASSETS / "tracks.css").read_text(encoding="utf-8"),
        data=dump_inside_script(describe_tracks(tracks)),
        script=(ASSETS / "tracks.js").read_text(encoding="utf-8"),
    )
    (folder / PAGE_FILE).write_text(page, encoding="utf-8", newline="\n")
    write_png(folder / CHART_FILE, draw_growth(tracks))


def write_index(path: Path, plants: Sequence[tuple[str, int, int]]) -> None:
    """Write the list of the pages of many plants: (plant, number of dates, number of tracks), as numbered folders."""
    rows = "\n".join(
        f'<tr><td><a href="plants/{number:05d}/{PAGE_FILE}">{html.escape(plant)}</a><td>{dates}<td>{tracks}</tr>'
        for number, (plant, dates, tracks) in enumerate(plants, start=1)
    )
    style = (ASSETS / "tracks.css").read_text(encoding="utf-8")
    text = (
        f'<!doctype html><html lang="en"><meta charset="utf-8"><title>mvseg track</title><style>{style}</style>'
        f"<body><h1>Plants over days</h1><table><tr><th>plant<th>dates<th>leaves</tr>\n{rows}\n</table></body></html>\n"
    )
    path.write_text(text, encoding="utf-8", newline="\n")


def describe_tracks(tracks: Tracks) -> dict[str, Any]:
    """All that the page shows, as its script reads it. Places are whole thousandths of the plant's size."""
    scale, middle = _extent(tracks)
    leaves: list[dict[str, Any]] = []
    track_of = {(row.date, row.leaf): row for row in tracks.rows if row.leaf is not None}
    for index, date in enumerate(tracks.dates):
        pose = tracks.poses[index]
        crops = _crops(date, {row.leaf or 0: row.track for row in tracks.rows if row.date == index})
        for leaf in date.leaves:
            row = track_of[index, leaf.leaf]
            shape: list[int] = []
            if leaf.points is not None and leaf.midrib is not None:
                rim = _rim(leaf.points) if "length" in leaf.numbers else leaf.midrib
                placed = rim if np.isnan(pose).any() else rim @ pose[:3, :3].T + pose[:3, 3]
                shape = np.round((placed - middle) / scale * 1000).astype(int).ravel().tolist()
            probability = None if math.isnan(row.probability) else round(row.probability, 3)
            leaves.append(
                {"date": index, "leaf": leaf.leaf, "track": row.track, "p": probability, "state": row.state,
                 "flat": "length" in leaf.numbers, "shape": shape, "crop": crops.get(leaf.leaf, "")}
            )  # fmt: skip
    gaps = [[row.date, row.track, row.state] for row in tracks.rows if row.leaf is None]
    colors = {str(track): f"#{bytes(instance_color(track)).hex()}" for track in range(1, tracks.num_tracks + 1)}
    return {
        "plant": tracks.plant,
        "dates": [{"scene": date.scene, "time": date.time, "written": date.written} for date in tracks.dates],
        "leaves": leaves, "gaps": gaps, "colors": colors, "warnings": list(tracks.warnings),
        "numbers": _numbers(tracks), "curves": _curves(tracks),
    }  # fmt: skip


def draw_growth(tracks: Tracks) -> np.ndarray:
    """(H, W, 3) uint8: the area of each leaf (its length where no areas are known) over time, with one standard
    deviation, and its curve where it has one."""
    points = growth_points(tracks)
    trait = "area" if any(point.trait == "area" for point in points) else "length"
    points = [point for point in points if point.trait == trait]
    image = Image.new("RGB", CHART, "white")
    draw, (width, height), (left, bottom) = ImageDraw.Draw(image), CHART, (130, 80)
    most = max((point.number.value for point in points), default=1.0) * 1.1
    times = [date.time for date in tracks.dates]
    span = max(times[-1] - times[0], 1e-9)

    def place(time: float, value: float) -> tuple[float, float]:
        right, up = (time - times[0]) / span * (width - left - 40), value / most * (height - bottom - 40)
        return left + right, height - bottom - up

    for tick in np.linspace(0, most, 6)[:-1].tolist():
        x, y = place(times[0], tick)
        draw.line([(x, y), (width - 40, y)], fill=(225, 225, 225))
        draw.text((10, y - 10), f"{tick:.4g}", fill="black", font_size=20)
    for date in tracks.dates:
        x, y = place(date.time, 0)
        draw.text((x - 20, y + 10), date.written, fill="black", font_size=20)
    unit = points[0].number.unit if points else ""
    draw.text((left, 8), f"{tracks.plant}: {trait} ({unit}) over time", fill="black", font_size=22)
    curves = {curve.track: curve for curve in fit_curves(tracks) if curve.trait == trait}
    for track in range(1, tracks.num_tracks + 1):
        color, own = instance_color(track), [point for point in points if point.track == track]
        dots = [place(tracks.dates[point.date].time, point.number.value) for point in own]
        if track in curves:
            steps = np.linspace(tracks.dates[own[0].date].time, tracks.dates[own[-1].date].time, CURVE_STEPS)
            values = np.clip(curves[track].at(steps), 0, most)
            draw.line([place(t, v) for t, v in zip(steps.tolist(), values.tolist(), strict=True)], fill=color, width=3)
        elif len(dots) > 1:
            draw.line(dots, fill=color, width=2)
        for point, (x, y) in zip(own, dots, strict=True):
            if math.isfinite(point.number.sd):
                up = point.number.sd / most * (height - bottom - 40)
                draw.line([(x, y - up), (x, y + up)], fill=color, width=1)
            draw.ellipse([x - 5, y - 5, x + 5, y + 5], fill=color)
    return np.asarray(image)


def _extent(tracks: Tracks) -> tuple[float, np.ndarray]:
    """Half the size of the largest plant, and the middle of the first one."""
    clouds = [
        np.concatenate([leaf.points for leaf in date.leaves if leaf.points is not None] or [np.zeros((1, 3))])
        for date in tracks.dates
    ]
    middle = (clouds[0].min(0) + clouds[0].max(0)) / 2
    return max(max(float(np.ptp(cloud, axis=0).max()) for cloud in clouds) / 2, 1e-9), middle


def _rim(points: np.ndarray) -> np.ndarray:
    """Once around the points of a surface, from base to tip and back."""
    grid = points.reshape(ROWS, 3, 3)
    return np.concatenate([grid[:, 0], grid[::-1, 2]])


def _numbers(tracks: Tracks) -> dict[str, dict[str, Any]]:
    """{trait: {unit, tracks: {track: [[date, value, sd], ...]}}}."""
    found: dict[str, dict[str, Any]] = {}
    for point in growth_points(tracks):
        of_trait = found.setdefault(point.trait, {"unit": point.number.unit, "tracks": {}})
        sd = point.number.sd if math.isfinite(point.number.sd) else 0.0
        value = float(f"{point.number.value:.5g}")
        of_trait["tracks"].setdefault(str(point.track), []).append([point.date, value, float(f"{sd:.3g}")])
    return found


def _curves(tracks: Tracks) -> dict[str, dict[str, Any]]:
    """{trait: {track: {model, line: [[time, value], ...]}}}."""
    times = np.linspace(tracks.dates[0].time, tracks.dates[-1].time, CURVE_STEPS)
    found: dict[str, dict[str, Any]] = {trait: {} for trait in SIZES}
    for curve in fit_curves(tracks):
        line = [[round(t, 3), float(f"{v:.5g}")] for t, v in zip(times.tolist(), curve.at(times).tolist(), strict=True)]
        found[curve.trait][str(curve.track)] = {"model": curve.model, "line": line}
    return found


def _crops(date: PlantOnDate, track_of: dict[int, int]) -> dict[int, str]:
    """{leaf: JPEG in base64} of where each leaf is largest: of the photo if it is still there, else of its mask."""
    if date.folder is None:
        return {}
    try:
        images = read_json(date.folder / "instances.json", _Images).images
        labels = [read_labels(date.folder / "labels" / f"{image.name}.png") for image in images]
    except InputError:
        return {}
    sizes = np.array([np.bincount(view.ravel(), minlength=max(track_of, default=0) + 1)[: max(track_of) + 1]
                      for view in labels])  # fmt: skip
    crops: dict[int, str] = {}
    for view, image in enumerate(images):
        shown = [leaf for leaf in track_of if leaf and sizes[:, leaf].argmax() == view and sizes[view, leaf]]
        photo = _photo(date.folder, image.file_name, labels[view].shape) if shown else None
        for leaf in shown:
            crops[leaf] = _crop(photo, labels[view] == leaf, instance_color(track_of[leaf]))
    return crops


def _photo(folder: Path, file_name: str, shape: tuple[int, ...]) -> np.ndarray | None:
    """The photo of a view, if it still is where the run found it and has its size."""
    for source in read_json(folder / "run.json", _Inputs).inputs:
        for place in (Path(source).parent / "images", Path(source).parent):
            path = place / file_name
            photo = cv2.imread(str(path)) if path.is_file() else None
            if photo is not None and photo.shape[:2] == shape[:2]:
                return np.asarray(photo[..., ::-1])
    return None


def _crop(photo: np.ndarray | None, mask: np.ndarray, color: tuple[int, int, int]) -> str:
    rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    half = max(rows[-1] - rows[0], columns[-1] - columns[0]) // 2 + 4
    row, column = (rows[0] + rows[-1]) // 2, (columns[0] + columns[-1]) // 2
    box = np.s_[max(row - half, 0) : row + half, max(column - half, 0) : column + half]
    shown = np.where(mask[..., None], np.array(color, np.uint8), np.uint8(24))[box]
    if photo is not None:
        shown = np.where(mask[box][..., None], photo[box], photo[box] // 2)
    scale = CROP / max(shown.shape[:2])
    size = (max(round(shown.shape[1] * scale), 1), max(round(shown.shape[0] * scale), 1))
    small = cv2.resize(np.ascontiguousarray(shown), size, interpolation=cv2.INTER_AREA)
    return base64.b64encode(encode_jpeg(small, quality=QUALITY)).decode("ascii")
