"""The scene folder that `mvseg pose` writes: what it may replace; `pose.json` lists the files of mvseg."""

from __future__ import annotations

from pathlib import Path

from mvseg.errors import InputError
from mvseg.poses.photo_files import list_photos
from mvseg.results.earlier import check_out
from mvseg.system.atomic import sweep_abandoned

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
