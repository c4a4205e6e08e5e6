"""Data for correcting a result on the page: where its pictures are in the photos, its name, and the questions."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mvseg.checks.cameras import find_coverage
from mvseg.corrections.corrected import APPLIED, PASSED, Fate
from mvseg.corrections.file import dump_edits, name_edits
from mvseg.corrections.mask_questions import list_mask_questions
from mvseg.corrections.same_scene import mark_photos
from mvseg.formats.lens import photo_from_pinhole
from mvseg.formats.photos import Photos
from mvseg.results.report.pictures import Picture
from mvseg.results.result import Result
from mvseg.scene import Scene

COLUMNS = 33  # limit: columns of the grid of a lens: between its points, straight lines are less than a pixel off


def describe_correct(result: Result, pictures: Sequence[Picture], *, run: Mapping[str, Any]) -> dict[str, Any]:
    """The data of the mode "Correct": the edits of the result, and the problem of each; `run` is its run.json."""
    marks = mark_photos(result.photos or Photos(result.scene))
    made = () if result.corrections is None else result.corrections.edits
    edits = dump_edits(made)
    name = json.dumps([result.scene.name, run.get("inputs"), run.get("code"), edits], default=str)
    lenses, of_view = describe_lenses(result.scene)
    views = zip(result.scene.cameras.sizes.tolist(), of_view, strict=True)
    return {
        "key": hashlib.sha256(name.encode()).hexdigest()[:16],
        "edits": edits,
        "photos": {name: mark.model_dump(exclude_none=True) for name, mark in marks.items()},
        "revision": name_edits(made),
        "outcomes": [describe_fate(fate) for fate in result.fates],
        "lenses": lenses,
        "angles": measure_angles(result).tolist(),
        "views": [{"size": size, "lens": lens} for size, lens in views],
        "doubts": describe_questions(result, pictures),
    }


def measure_angles(result: Result) -> NDArray[np.int64]:
    """(V, V) degrees between the directions from which two photos show the point that most cameras look at, as the
    finding `one_sided` measures them."""
    cameras = result.scene.cameras.to("cpu")
    sights = cameras.centers.numpy() - find_coverage(cameras).point
    sights = sights / np.maximum(np.linalg.norm(sights, axis=1, keepdims=True), 1e-300)
    return np.degrees(np.arccos(np.clip(sights @ sights.T, -1, 1))).round().astype(np.int64)


def describe_fate(fate: Fate) -> str:
    """The problem of an edit; "" if it was applied."""
    return fate.problem if fate.fate in (APPLIED, PASSED) else f"{fate.fate} {fate.problem}".strip()


def describe_lenses(scene: Scene) -> tuple[list[dict[str, Any]], list[int | None]]:
    """Each lens once, as the displacements of a grid of points between the undistorted image and the photo; and the
    lens of each view, None for a pinhole.

    A grid has its numbers of columns and rows, from edge to edge of the photo, and x and y of the moves, pixels, row by
    row; 0 where the photo shows nothing.
    """
    grids: dict[tuple[Any, ...], dict[str, Any]] = {}
    of_view: list[int | None] = []
    for view, size, K in zip(scene.views, scene.cameras.sizes.tolist(), scene.cameras.K.cpu().numpy(), strict=True):
        if view.lens is None:
            of_view.append(None)
            continue
        name, (width, height) = (view.lens.model_name, *view.lens.params, *K.ravel().tolist(), *size), size
        if name not in grids:
            rows = max(2, round(COLUMNS * height / width))
            x, y = np.meshgrid(np.linspace(0, width, COLUMNS), np.linspace(0, height, rows))
            points = np.stack((x.ravel(), y.ravel()), 1)
            moves = np.nan_to_num(photo_from_pinhole(view.lens, K, points) - points, nan=0, posinf=0, neginf=0)
            grids[name] = {"columns": COLUMNS, "rows": rows, "moves": np.round(moves, 2).ravel().tolist()}
        of_view.append([*grids].index(name))
    return [*grids.values()], of_view


def describe_questions(result: Result, pictures: Sequence[Picture]) -> list[dict[str, Any]]:
    """The queue; outlines in units of the pictures."""
    cameras = result.scene.cameras.to("cpu")
    photos = result.photos if result.photos is not None and result.photos.exist else None
    asked = list_mask_questions(result.masks, result.surfaces, cameras=cameras, rejected=result.rejected, photos=photos)
    sizes = cameras.sizes.tolist()
    return [
        asdict(each) | {"outlines": [{"view": view, "outline": pictures[view].place(outline, sizes[view])}
                                     for view, outline in each.outlines]}
        for each in asked
    ]  # fmt: skip
