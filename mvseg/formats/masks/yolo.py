"""YOLO segmentation: one .txt file per photo, one line per mask: `class x1 y1 x2 y2 ...`, from 0 to 1 over the photo.

A confidence may stand at the end of each line (`save_conf` of ultralytics), and a number of the track behind it
(`YOLO_TRACKS`). Names of the classes come from a `classes.txt`, `obj.names` or `data.yaml` beside the files or in one
of the two folders above (ultralytics and Roboflow: `data.yaml`, `train/labels/`).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np

from mvseg.errors import InputError, faults_of
from mvseg.formats.coco import decode_segmentation
from mvseg.formats.masks.found_mask import FoundMask
from mvseg.formats.text_file import read_text, read_yaml

NAME_FILES = ("classes.txt", "obj.names", "data.yaml", "dataset.yaml")
MAX_BYTES = 1 << 28  # limit: of a photo
YOLO_TRACKS = "YOLO tracks"  # a kind of masks: each line ends in a confidence and the number of a track


def has_tracks(paths: Iterable[Path]) -> bool:
    """Whether every line of all files ends in a confidence and the number of a track, as those of ultralytics' `track`
    with `save_conf` do: a number from 0 to 1, and a whole one from 1 that no other line of its file has. As a corner it
    would be the photo's bottom edge, or below it. Raises InputError if a file cannot be read."""
    is_there = False
    for path in paths:
        lines = [line.split() for line in read_text(path, "YOLO's masks", most=MAX_BYTES).splitlines() if line.strip()]
        tracks = {line[-1] for line in lines if len(line) % 2 and len(line) > 6 and _is_track(*line[-2:])}
        if len(tracks) < len(lines):
            return False
        is_there = is_there or bool(lines)
    return is_there


def _is_track(confidence: str, number: str) -> bool:
    with suppress(ValueError):
        return 0 <= float(confidence) <= 1 and number.isdecimal() and int(number) >= 1
    return False


def read_yolo(path: Path, width: int, height: int, *, names: dict[int, str], tracks: bool = False) -> list[FoundMask]:
    """The masks of a photo, numbered by their lines from 1; boxes (4 numbers) have no mask. Classes without a name in
    `names` (see `read_class_names`) go by their numbers. Of `tracks`, the last two numbers of each line are left out.
    Raises InputError if the file cannot be read, a line is not as above, or a polygon leaves the photo by far."""
    masks = []
    for number, line in enumerate(read_text(path, "YOLO's masks", most=MAX_BYTES).splitlines(), start=1):
        if not line.strip():
            continue
        with faults_of(f"{path}: line {number}"):
            words = line.split()[:-2] if tracks else line.split()
            masks.append(_read_line(words, number, (width, height), names=names))
    return masks


def _read_line(words: Sequence[str], number: int, size: tuple[int, int], *, names: dict[int, str]) -> FoundMask:
    first, *rest = words
    try:
        kind, values = int(float(first)), [float(value) for value in rest]
    except (ValueError, OverflowError):
        raise InputError("holds something that is not a number, expected: class x1 y1 x2 y2 x3 y3 ...") from None
    category = names.get(kind, str(kind))
    if len(values) in (4, 5):
        return FoundMask(number, None, category)
    if len(values) < 6:
        raise InputError(f"has {len(values)} numbers after the class, expected three corners or more")
    corners = np.array(values[: len(values) // 2 * 2]).reshape(-1, 2)  # an odd last one is the confidence
    if not np.isfinite(corners).all() or np.abs(corners - 0.5).max() > 1:
        raise InputError("its corners are not between 0 and 1 (shares of the photo's width and height)")
    return FoundMask(number, decode_segmentation([(corners * size).ravel().tolist()], *size), category)


def name_files(folder: Path) -> list[Path]:
    """List files that may hold the names of the classes of a folder of masks; the first that is there is read."""
    return [place / name for place in (folder, folder.parent, folder.parent.parent) for name in NAME_FILES]


def read_class_names(folder: Path) -> dict[int, str]:
    """{class number: name}; empty if there is no file of names. Raises InputError if one cannot be read."""
    path = next((path for path in name_files(folder) if path.is_file()), None)
    if path is None:
        return {}
    is_yaml, expected = path.suffix == ".yaml", "names of classes"
    content = read_yaml(path, expected) if is_yaml else {"names": read_text(path, expected).split("\n")}
    try:
        names = (content or {}).get("names", [])
        pairs = names.items() if isinstance(names, dict) else enumerate(names)
        return {int(number): str(name).strip() for number, name in pairs if str(name).strip()}
    except (AttributeError, TypeError, ValueError, OverflowError):  # whatever shape YAML may have
        raise InputError(f"{path}: cannot be read as {expected}") from None
