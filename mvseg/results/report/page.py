"""`report.html`: leaves in 3D, photos and traits on one page that needs no network.

Everything that a file or a user could have named goes through `json.dumps` or `html.escape`; the page's own script puts
it in as text, never as HTML.
"""

from __future__ import annotations

import html
import json
from collections.abc import Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from string import Template
from typing import Any

from mvseg.checks.camera_plan import draw_walk
from mvseg.results.plant_graph import plant_graph
from mvseg.results.report.correct import describe_correct, describe_questions
from mvseg.results.report.leaves import describe_leaves, describe_traits, draw_lines
from mvseg.results.report.pictures import Picture
from mvseg.results.report.space import describe_space
from mvseg.results.result import Result

ASSETS = files("mvseg.results.report") / "assets"
SCRIPTS = (
    "selection.js", "numbers.js", "figures.js", "shapes.js", "stems.js", "space.js", "photos.js", "table.js", "leaf.js",
    "run.js", "lens.js", "edits.js", "brush.js", "pane.js", "queue.js", "panel.js", "correct.js", "server.js",
    "page.js",
)  # fmt: skip
RUN_FIELDS = (
    "card", "mvseg", "torch", "python", "mask_kind", "matched_by", "residual_px", "seconds", "findings", "inputs",
)  # fmt: skip


def write_report(path: Path, result: Result, pictures: Sequence[Picture], *, run: Mapping[str, Any]) -> None:
    """Write the page, see `build_page`. Raises OSError: the file cannot be written."""
    path.write_text(build_page(result, pictures, run=run), encoding="utf-8", newline="\n")


def build_page(result: Result, pictures: Sequence[Picture], *, run: Mapping[str, Any], is_served: bool = False) -> str:
    """The page of a result; without shapes the leaves are missing in 3D. `is_served`: `mvseg correct` serves it: it
    sends each edit there, and shows the consequences. Otherwise it connects to nothing."""
    data = describe_page(result, pictures, run=run)
    data["correct"]["isServed"] = is_served
    return Template(_read("page.html")).substitute(
        title=html.escape(f"{result.scene.name} - mvseg"),
        style=_read("page.css") + _read("correct.css"),
        connect="; connect-src 'self'" if is_served else "",
        data=dump_inside_script(data),
        three=_read("three/three.min.js"),
        script="\n".join(_read(name) for name in SCRIPTS),
    )


def describe_page(result: Result, pictures: Sequence[Picture], *, run: Mapping[str, Any]) -> dict[str, Any]:
    """All that the page shows, as its script reads it."""
    scene = result.scene
    return {
        "plant": scene.name,
        "unit": scene.unit or "world unit",
        "numMasks": len(result.regions),
        "views": [
            {"name": view.name} | picture.as_json() | {"stems": draw_lines(result, index, picture)}
            for index, (view, picture) in enumerate(zip(scene.views, pictures, strict=True))
        ],
        "leaves": describe_leaves(result),
        "stems": [] if result.traits is None else plant_graph(result.traits)["stems"],
        **describe_traits(result.traits),
        "space": describe_space(result),
        "correct": describe_correct(result, pictures, run=run),
        "walk": draw_walk(scene)[1] if len(scene.views) > 1 else "",
        "run": {name: value for name, value in run.items() if name in RUN_FIELDS}
        | {"config": json.dumps(run.get("config", {}), indent=1, default=str)},
    }


def describe_update(result: Result, pictures: Sequence[Picture]) -> dict[str, Any]:
    """Data that the mode "Correct" shows anew of a result of the same photos; for `pictures` see
    `Picture.with_masks`."""
    return {
        "views": [{"masks": picture.outlines} for picture in pictures],
        "leaves": describe_leaves(result),
        "doubts": describe_questions(result, pictures),
        "numMasks": len(result.regions),
    }


def dump_inside_script(content: Any) -> str:
    """JSON that may stand inside a script element: nothing in it ends that element, or starts a comment."""
    text = json.dumps(content, default=str, separators=(",", ":"), allow_nan=False)
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def _read(name: str) -> str:
    return (ASSETS / name).read_text(encoding="utf-8")
