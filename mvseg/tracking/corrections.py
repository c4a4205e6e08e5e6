"""What a person says of leaves on different dates, from a file of corrections."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Literal

from pydantic import BaseModel, FiniteFloat

from mvseg.errors import InputError
from mvseg.formats.json_file import Items, read_json
from mvseg.formats.label_png import read_labels
from mvseg.tracking.dates import PlantOnDate
from mvseg.tracking.track import LeafLink

FORMAT = "mvseg-corrections/1"
OPERATIONS = ("same_track", "different_track")
Place = tuple[str, str, FiniteFloat, FiniteFloat]


class _Edit(BaseModel):
    op: str
    at: list[Place] | object = None


class _Corrections(BaseModel):
    format: Literal["mvseg-corrections/1"]
    edits: Items[_Edit]


class LinkEdit(BaseModel):
    """One link: at least two places (scene, view, x, y), pixels of the photo as the user has it."""

    op: Literal["same_track", "different_track"]
    at: list[Place]


def read_link_edits(path: Path) -> list[LinkEdit]:
    """The edits of a file of corrections that link leaves of different dates; others are for single scenes.

    Raises:
        InputError: the file is missing or broken, or a link has fewer than two places.
    """
    edits = []
    for index, edit in enumerate(read_json(path, _Corrections).edits):
        if edit.op not in OPERATIONS:
            continue
        try:
            found = LinkEdit.model_validate(edit.model_dump())
        except ValueError:
            message = 'expected "at": [["SCENE", "view", x, y], ...]'
            raise InputError(f"{path}: edits[{index}]: {message}") from None
        if len(found.at) < 2:
            raise InputError(f"{path}: edits[{index}]: {edit.op} has {len(found.at)} places, expected two or more")
        edits.append(found)
    return edits


def find_links(edits: Sequence[LinkEdit], dates: Sequence[PlantOnDate]) -> tuple[list[LeafLink], list[str]]:
    """The links between leaves of these dates, and a sentence for each edit that points at no leaf.

    Edits that name none of the scenes are another plant's: they are passed over.
    """
    folders = {date.scene: date.folder for date in dates if date.folder is not None}
    links, lost = [], []
    for edit in edits:
        here = [place for place in edit.at if place[0] in folders]
        if not here:
            continue
        leaves = []
        for scene, view, x, y in edit.at:
            folder = folders.get(scene)
            leaf = 0 if folder is None else leaf_at(folder, view, x, y)
            if leaf:
                leaves.append((scene, leaf))
            else:
                lost.append(f"{edit.op}: there is no leaf at ({x:g}, {y:g}) in view {view} of {scene}")
        if len(leaves) == len(edit.at):
            links.append(LeafLink(edit.op == "same_track", tuple(leaves)))
    return links, lost


def leaf_at(folder: Path, view: str, x: float, y: float) -> int:
    """The id of the leaf at a point of a view of a result; 0 where there is none, or no such view."""
    path = folder / "labels" / f"{view}.png"
    if not path.resolve().is_relative_to((folder / "labels").resolve()) or not path.is_file():
        return 0
    labels = read_labels(path)
    column, row = int(x // 1), int(y // 1)
    inside = 0 <= row < labels.shape[0] and 0 <= column < labels.shape[1]
    return int(labels[row, column]) if inside else 0
