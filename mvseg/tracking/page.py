"""`tracks.html`: one offline page of a plant over days."""

from __future__ import annotations

import base64
import html
import math
from collections.abc import Iterable, Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from string import Template
from typing import Any

import numpy as np

from mvseg.arrays import Floats
from mvseg.results.overlay import instance_color
from mvseg.results.report.page import ASSETS as REPORT_ASSETS
from mvseg.results.report.page import dump_inside_script
from mvseg.tracking.dates import Number, SeenLeaf
from mvseg.tracking.growth import Growth
from mvseg.tracking.numbers import OBSERVATIONS
from mvseg.tracking.track import Tracks

PAGE_FILE = "tracks.html"
ASSETS = files("mvseg.tracking") / "assets"
SHARED_SCRIPTS = ("selection.js", "figures.js", "stems.js")  # with the page of a result
SERVED_SCRIPTS = ("numbers.js", "edits.js", "server.js")  # of the page that corrects a result


def write_page(folder: Path, tracks: Tracks, growth: Growth) -> None:
    page = build_tracks_page(tracks.plant, describe_tracks(tracks, growth))
    (folder / PAGE_FILE).write_text(page, encoding="utf-8", newline="\n")


def build_tracks_page(plant: str, data: Mapping[str, Any]) -> str:
    """The page; `data` of `describe_tracks`, with "correct" where `mvseg correct` serves it: {"edits", "revision", and
    the rest that its script reads}."""
    styles, scripts = ["tracks.css"], [REPORT_ASSETS / name for name in SHARED_SCRIPTS]
    if is_served := "correct" in data:
        styles.append("tracks_correct.css")
        scripts += [REPORT_ASSETS / name for name in SERVED_SCRIPTS]
    scripts += [ASSETS / name for name in ("tracks.js", *(("tracks_correct.js",) if is_served else ()))]
    return Template((ASSETS / "tracks.page.html").read_text(encoding="utf-8")).substitute(
        title=html.escape(f"{plant} - mvseg track"),
        style="".join((ASSETS / name).read_text(encoding="utf-8") for name in styles),
        connect="; connect-src 'self'" if is_served else "",
        correct=(ASSETS / "correct.part.html").read_text(encoding="utf-8") if is_served else "",
        data=dump_inside_script(data),
        script="\n".join(script.read_text(encoding="utf-8") for script in scripts),
    )


def write_index(path: Path, plants: Sequence[tuple[str, int, int]]) -> None:
    """Write the list of the pages of many plants: (plant, number of dates, number of tracks), as numbered folders.
    Those without dates failed, and have none."""
    rows = "\n".join(
        f'<tr><td><a href="plants/{number:05d}/{PAGE_FILE}">{html.escape(plant)}</a><td>{dates}<td>{tracks}</tr>'
        for number, (plant, dates, tracks) in enumerate(plants, start=1)
        if dates
    )
    style = (ASSETS / "tracks.css").read_text(encoding="utf-8")
    text = (
        f'<!doctype html><html lang="en"><meta charset="utf-8"><title>mvseg track</title><style>{style}</style>'
        f"<body><h1>Plants over days</h1><table><tr><th>plant<th>dates<th>leaves</tr>\n{rows}\n</table></body></html>\n"
    )
    path.write_text(text, encoding="utf-8", newline="\n")


def describe_tracks(tracks: Tracks, growth: Growth) -> dict[str, Any]:
    """All that the page shows, as its script reads it. Places are whole thousandths of the plant's size."""
    scale, middles = _extent(tracks)
    leaves: list[dict[str, Any]] = []
    for index, date in enumerate(tracks.dates):
        rows = {row.leaf: row for row in tracks.rows if row.date == index and row.leaf is not None}
        pose, middle = tracks.poses[index], middles.get(tracks.roots[index], np.zeros(3))
        for leaf in date.leaves:
            row, shape, picture = rows[leaf.leaf], np.zeros((0, 3)), date.pictures.get(leaf.leaf)
            if leaf.points is not None and leaf.midrib is not None:
                grid = leaf.points.reshape(OBSERVATIONS.rows, 3, 3)  # once around the surface, base to tip and back
                shape = np.concatenate([grid[:, 0], grid[::-1, 2]]) if "length" in leaf.numbers else leaf.midrib
            node = np.zeros((0, 3)) if leaf.node_place is None else leaf.node_place[None]
            in_plant = [(each @ pose[:3, :3].T + pose[:3, 3] - middle) / scale * 1000 for each in (shape, node)]
            line, at = (np.round(each).astype(int).ravel().tolist() for each in in_plant)
            leaves.append(
                {"date": index, "leaf": leaf.leaf, "track": row.track, "p": _round(row.probability, 3),
                 "state": row.state, "flat": "length" in leaf.numbers,
                 "crop": base64.b64encode(picture.jpeg).decode("ascii") if picture else "",
                 "place": [picture.view, *picture.at] if picture else None,
                 "shape": line, "at": at, "node": _describe_node(leaf, pose)}
            )  # fmt: skip
    return {
        "plant": tracks.plant,
        "unit": tracks.dates[0].unit or "world unit",
        "dates": [
            {name: getattr(date, name) for name in ("scene", "time", "written")}
            | {"photo": base64.b64encode(date.photo).decode("ascii")}
            | {name: getattr(row, name) for name in ("leaves", "born", "gone")}
            for date, row in zip(tracks.dates, growth.plant, strict=True)
        ],
        "knows_up": all(date.knows_up for date in tracks.dates),
        "leaves": leaves,
        "gaps": [[row.date, row.track, row.state] for row in tracks.rows if row.leaf is None],
        "colors": {str(n): f"#{bytes(instance_color(n)).hex()}" for n in sorted({row.track for row in tracks.rows})},
        "warnings": list(map(str, tracks.findings)),
        "numbers": _describe_numbers((each.trait, each.track, each.date, each.number) for each in growth.points),
        "whole": _describe_plant(growth),
    }


def _describe_node(leaf: SeenLeaf, pose: Floats) -> dict[str, Any] | None:
    if leaf.node is None or "node_height" not in leaf.numbers:
        return None
    height, azimuth = leaf.numbers["node_height"], leaf.numbers.get("node_azimuth")
    turn = math.degrees(math.atan2(pose[1, 0], pose[0, 0]))
    place = {"azimuth": None if azimuth is None else _round((azimuth.value + turn) % 360, 4)}
    return place | {"stem": leaf.node[0], "node": leaf.node[1], "height": height.value, "sd": _round(height.sd, 3) or 0}


def _describe_plant(growth: Growth) -> dict[str, Any]:
    numbers = [
        (trait, 0, row.date, number)
        for row in growth.plant
        for trait, number in {
            "total area": row.total_area, "relative growth rate": row.relative_growth_rate,
            "leaves": Number(row.leaves, 0.0, ""), "leaves that appeared": Number(row.born, 0.0, ""),
            "days per new leaf": Number(row.phyllochron, 0.0, "days"),
        }.items()
    ]  # fmt: skip
    nothing = {trait: {"unit": "", "tracks": {"0": []}} for trait, *_ in numbers}
    return nothing | _describe_numbers(each for each in numbers if math.isfinite(each[-1].value))


def _describe_numbers(numbers: Iterable[tuple[str, int, int, Number]]) -> dict[str, Any]:
    described: dict[str, dict[str, Any]] = {}
    for trait, track, date, number in numbers:
        of_trait = described.setdefault(trait, {"unit": number.unit, "tracks": {}})
        row = [date, _round(number.value, 5), _round(number.sd, 3) or 0.0]
        of_trait["tracks"].setdefault(str(track), []).append(row)
    return described


def _round(value: float, digits: int) -> float | None:
    return float(f"{value:.{digits}g}") if math.isfinite(value) else None


def _extent(tracks: Tracks) -> tuple[float, dict[int, np.ndarray]]:
    clouds: dict[int, list[np.ndarray]] = {root: [np.zeros((0, 3))] for root in tracks.roots}
    for date, root, pose in zip(tracks.dates, tracks.roots, tracks.poses, strict=True):
        clouds[root] += [leaf.points @ pose[:3, :3].T + pose[:3, 3] for leaf in date.leaves if leaf.points is not None]
    placed = {root: np.concatenate(points) for root, points in clouds.items()}
    boxes = {root: (cloud.min(0), cloud.max(0)) for root, cloud in placed.items() if len(cloud)}
    half = max((float((high - low).max()) / 2 for low, high in boxes.values()), default=0.0)
    return max(half, 1e-9), {root: (low + high) / 2 for root, (low, high) in boxes.items()}
