"""The file of corrections: what the user says is wrong, photo by photo; see docs/formats.md.

An edit names things by points, in pixels of the photo as the user has it (with its distortion, the centre of the
top-left pixel at 0.5, 0.5), never by numbers of a result: numbers change with every run, points do not.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError
from pydantic.types import StrictBool

from mvseg.corrections.numbers import EDITS
from mvseg.errors import InputError
from mvseg.formats.json_file import Items, Pixels, load_json
from mvseg.system.atomic import write_text_whole

FORMAT = "mvseg-corrections/1"

Text = Annotated[str, Field(max_length=1000)]
Pixel = Annotated[float, Field(strict=True, allow_inf_nan=False, ge=-1e6, le=1e6)]
Number = Annotated[int | float, Field(ge=-1e18, le=1e18)]
Point = tuple[Pixel, Pixel]
Place = tuple[Text, Pixel, Pixel]  # view, x, y
DatedPlace = tuple[Text, Text, Pixel, Pixel]  # scene, view, x, y


class _Edit(BaseModel):
    model_config: ClassVar[ConfigDict] = ConfigDict(frozen=True, extra="forbid")
    by: Text | None = None
    when: Text | Number | None = None


class Outline(_Edit):
    """A mask drawn by hand; it replaces every mask of which it covers more than half. Outlines with one `leaf` word
    show one leaf."""

    op: Literal["outline"] = "outline"
    view: Text
    polygon: Annotated[tuple[Point, ...], Field(min_length=3, max_length=EDITS.most_points)]
    leaf: Text | None = None


class Reject(_Edit):
    """The mask at a point is no leaf; `everywhere`: neither is its instance; `stem`: the stem nearest to it is none."""

    op: Literal["reject"] = "reject"
    view: Text
    at: Point
    everywhere: StrictBool = False
    stem: StrictBool = False


class Confirm(_Edit):
    """The mask at a point is right as it is; `everywhere`: all of its instance are; `stem`: the nearest stem is."""

    op: Literal["confirm"] = "confirm"
    view: Text
    at: Point
    everywhere: StrictBool = False
    stem: StrictBool = False


class Split(_Edit):
    """The mask at a point shows two leaves: cut along the line."""

    op: Literal["split"] = "split"
    view: Text
    at: Point
    line: Annotated[tuple[Point, ...], Field(min_length=2, max_length=EDITS.most_points)]


class Link(_Edit):
    """The masks at these places show one leaf (`same`), or different ones each (`different`)."""

    op: Literal["same", "different"]
    at: Annotated[tuple[Place, ...], Field(min_length=2, max_length=EDITS.most_places)]


class TrackLink(_Edit):
    """The same of leaves on different dates: for `mvseg track`; a single scene passes it over."""

    op: Literal["same_track", "different_track"]
    at: Annotated[tuple[DatedPlace, ...], Field(min_length=2, max_length=EDITS.most_points)]


Edit = Annotated[Outline | Reject | Confirm | Split | Link | TrackLink, Field(discriminator="op")]


def topic_of(edit: Edit) -> Literal["masks", "stem", "dates"]:
    """Tell what an edit is about."""
    return "dates" if isinstance(edit, TrackLink) else "stem" if getattr(edit, "stem", False) else "masks"


class PhotoMark(BaseModel):
    """Identity of a photo: its size, pixels, and the SHA-256 of its file; None for masks without a photo."""

    model_config: ClassVar[ConfigDict] = ConfigDict(frozen=True, extra="forbid")
    width: Pixels
    height: Pixels
    sha256: Annotated[str, Field(pattern="^[0-9a-f]{64}$")] | None = None


class _File(BaseModel):
    model_config: ClassVar[ConfigDict] = ConfigDict(extra="forbid")
    format: Literal["mvseg-corrections/1"]
    photos: Annotated[dict[Text, PhotoMark], Field(max_length=EDITS.most_edits)] = {}
    edits: Annotated[Items[Edit], Field(max_length=EDITS.most_edits)]


@dataclass(frozen=True)
class Corrections:
    """Edits in their order: a later one wins.

    Attributes:
        source: the file that they were read from, for messages; None in memory.
        photos: {view: mark} of the photos that they were made for; empty if unknown.
    """

    edits: tuple[Edit, ...] = ()
    source: Path | None = None
    photos: Mapping[str, PhotoMark] = field(default_factory=dict)


def load_corrections(path: Path | str) -> Corrections:
    """Read a file of corrections. Raises InputError: it is missing, too large or not JSON; see `parse_corrections`."""
    path = Path(path)
    return parse_corrections(load_json(path, most=EDITS.most_bytes), source=path)


def parse_corrections(data: Any, source: Path | None = None) -> Corrections:
    """Corrections from what a JSON file holds.

    Args:
        data: {"format": "mvseg-corrections/1", "edits": [{"op": ..., ...}, ...]}, and perhaps "photos": {view: mark}.
        source: the file, for messages.

    Raises:
        InputError: another format, an unknown operation or key, a number that is not finite, too many edits or points.
            The message names the file and the edit, counted from 1.
    """
    try:
        content = _File.model_validate(data)
        return Corrections(tuple(content.edits), source, content.photos)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
    place, edit = first["loc"], ""
    if place[:1] == ("edits",) and len(place) > 1:
        edit, place = f"edit {int(place[1]) + 1}{f' ({place[2]})' if len(place) > 2 else ''}", place[3:]
    key = "".join(f"[{part}]" if isinstance(part, int) else f".{_plain(part)}" for part in place).lstrip(".")
    parts = (str(source or "corrections"), edit, key, _plain(first["msg"], most=150))
    raise InputError(": ".join(filter(None, parts)))


def write_corrections(path: Path, corrections: Corrections) -> None:
    """Write a file of corrections, whole or not at all; `load_corrections` reads the same edits from it."""
    photos = {name: mark.model_dump(exclude_none=True) for name, mark in corrections.photos.items()}
    data = {"format": FORMAT, **({"photos": photos} if photos else {}), "edits": dump_edits(corrections.edits)}
    write_text_whole(path, json.dumps(data, indent=1, allow_nan=False) + "\n")


def dump_edits(edits: Sequence[Edit]) -> list[dict[str, Any]]:
    """The edits as a file holds them, without keys that say nothing."""
    dumped = [edit.model_dump(mode="json", exclude_none=True) for edit in edits]
    return [{"op": each.pop("op"), **{k: v for k, v in each.items() if v is not False}} for each in dumped]


def name_edits(edits: Sequence[Edit]) -> str:
    """A name that only equal lists of edits share."""
    return hashlib.sha256(json.dumps(dump_edits(edits)).encode()).hexdigest()[:16]


def _plain(text: object, most: int = 60) -> str:
    line = str(text).encode("unicode_escape").decode()
    return line if len(line) <= most else f"{line[: most - 3]}..."
