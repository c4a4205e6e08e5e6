"""The scene folder that `mvseg pose` writes: what it may replace, and `pose.json`, which lists the files of mvseg."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from mvseg._version import made_by
from mvseg.errors import InputError
from mvseg.poses.photo_files import list_photos
from mvseg.results.earlier import check_out, keep_user_files, list_files
from mvseg.system.atomic import folder_whole, sweep_abandoned

POSE_FILE = "pose.json"


def check_folders(photos: Path, out: Path) -> tuple[Path, list[str]]:
    """The folder of the photos and their names, as from `list_photos`, after checking that `out` may be written.

    Raises:
        InputError: no photos, photos inside `out`, or `out` holds something other than an earlier scene of this kind.
    """
    sweep_abandoned(out)
    check_out(out, POSE_FILE)
    source, names = list_photos(photos)
    if out.resolve() in (source.resolve(), *source.resolve().parents):
        raise InputError(f"{out}: the photos lie in it, expected a folder of its own for the scene")
    return source, names


@contextmanager
def new_scene_folder(out: Path) -> Iterator[Path]:
    """A new folder that becomes `out` when the block ends, see `folder_whole`.

    Raises:
        InputError: it cannot be written.
    """
    try:
        with folder_whole(out) as folder:
            yield folder
    except OSError as error:
        raise InputError(f"{out}: the scene folder is not writable ({error.strerror})") from None


def write_pose_file(folder: Path, out: Path, run: Mapping[str, Any]) -> None:
    """Write pose.json into the new folder, last of mvseg's files, and copy the user's files from `out`."""
    content = {**made_by(), **run, "files": list_files(folder, POSE_FILE)}
    (folder / POSE_FILE).write_text(json.dumps(content, indent=1, default=str) + "\n", encoding="utf-8")
    keep_user_files(out, folder, POSE_FILE)
