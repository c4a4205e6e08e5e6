"""`report.html`: leaves in 3D, photos and traits on one page that needs no network.

Everything that a file or a user could have named goes through `json.dumps` or `html.escape`; the page's own script puts
it in as text, never as HTML.
"""

from __future__ import annotations

import html
import json
import math
from collections.abc import Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from string import Template
from typing import Any

from mvseg.results.report.leaves import describe_leaves, describe_plant, describe_plant_traits, describe_traits
from mvseg.results.report.pictures import Picture
from mvseg.results.report.space import describe_space
from mvseg.results.result import Result

ASSETS = files("mvseg.results.report") / "assets"
SCRIPTS = (
    "selection.js", "numbers.js", "shapes.js", "space.js", "photos.js", "table.js", "leaf.js", "run.js", "page.js"
)  # fmt: skip
RUN_FIELDS = (
    "mvseg", "torch", "python", "mask_kind", "matched_by", "residual_px", "seconds", "warnings", "checks", "inputs"
)  # fmt: skip


def write_report(path: Path, result: Result, pictures: Sequence[Picture], *, run: Mapping[str, Any]) -> None:
    """Write the page.

    Args:
        path: the file.
        result: what is shown; without shapes the leaves are missing in 3D.
        pictures: one per view.
        run: what run.json says.

    Raises:
        OSError: the file cannot be written.
    """
    page = Template(_read("page.html")).substitute(
        title=html.escape(f"{result.scene.name} - mvseg"),
        style=_read("page.css"),
        data=dump_inside_script(describe_result(result, pictures, run=run)),
        three=_read("three/three.min.js"),
        script="\n".join(_read(name) for name in SCRIPTS),
    )
    path.write_text(page, encoding="utf-8", newline="\n")


def describe_result(result: Result, pictures: Sequence[Picture], *, run: Mapping[str, Any]) -> dict[str, Any]:
    """All that the page shows, as its script reads it."""
    scene = result.scene
    views = [{"name": view.name} | picture.as_json() for view, picture in zip(scene.views, pictures, strict=True)]
    scores = result.masks.detection_scores.tolist()
    for mask in (mask for view in views for mask in view["masks"]):
        if not math.isnan(scores[mask["region"]]):
            mask["detection_score"] = round(scores[mask["region"]], 4)
    return {
        "plant": scene.name,
        "unit": scene.unit or "world unit",
        "numMasks": len(result.regions),
        "views": views,
        "leaves": describe_leaves(result),
        "traits": describe_traits(result.traits),
        "plantTraits": describe_plant_traits(result.traits),
        "whole": describe_plant(result.traits),
        "space": describe_space(result),
        "run": {name: value for name, value in run.items() if name in RUN_FIELDS}
        | {"config": json.dumps(run.get("config", {}), indent=1, default=str)},
    }


def dump_inside_script(content: Any) -> str:
    """JSON that may stand inside a script element: nothing in it ends that element, or starts a comment."""
    text = json.dumps(content, default=str, separators=(",", ":"), allow_nan=False)
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def _read(name: str) -> str:
    return (ASSETS / name).read_text(encoding="utf-8")
