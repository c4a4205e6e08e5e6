"""What a person says of leaves on different dates, from a file of corrections."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, Field, FiniteFloat, ValidationError

from mvseg.errors import InputError
from mvseg.formats.json_file import Items, read_json
from mvseg.formats.label_png import read_labels
from mvseg.tracking.dates import PlantOnDate
from mvseg.tracking.track import LeafLink

Place = tuple[str, str, FiniteFloat, FiniteFloat]


class _Corrections(BaseModel):
    format: Literal["mvseg-corrections/1"]
    edits: Items[dict[str, Any]]


class LinkEdit(BaseModel):
    """One link: at least two places (scene, view, x, y), pixels of the photo as the user has it."""

    op: Literal["same_track", "different_track"]
    at: Annotated[list[Place], Field(min_length=2)]


def read_link_edits(path: Path) -> list[LinkEdit]:
    """The edits of a file of corrections that link leaves of different dates; others are for single scenes.

    Raises:
        InputError: the file is missing or broken, or a link has fewer than two places.
    """
    edits = []
    for index, edit in enumerate(read_json(path, _Corrections).edits):
        if edit.get("op") in ("same_track", "different_track"):
            try:
                edits.append(LinkEdit.model_validate(edit))
            except ValidationError:
                message = 'expected "at": [["SCENE", "view", x, y], ...], two places or more'
                raise InputError(f"{path}: edits[{index}]: {message}") from None
    return edits


def find_links(edits: Sequence[LinkEdit], dates: Sequence[PlantOnDate]) -> tuple[list[LeafLink], list[str]]:
    """The links between leaves of these dates, and a sentence for each edit that points at no leaf.

    Edits that name none of the scenes are another plant's: they are passed over.
    """
    folders = {date.scene: date.folder for date in dates if date.folder is not None}
    links, lost = [], []
    for edit in edits:
        if not any(scene in folders for scene, *_ in edit.at):
            continue
        leaves = []
        for scene, view, x, y in edit.at:
            leaf = leaf_at(folders[scene], view, x, y) if scene in folders else 0
            leaves.append((scene, leaf))
            if not leaf:
                lost.append(f"{edit.op}: there is no leaf at ({x:g}, {y:g}) in view {view} of {scene}")
        if all(leaf for _, leaf in leaves):
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
