"""Photos from a turntable, from their folder to a scene folder: calibrated once from a board, then used for plants."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from tqdm import tqdm

from mvseg.batch.pose_folder import check_folders, new_scene_folder, write_pose_file
from mvseg.errors import InputError
from mvseg.formats.board import BoardConfig
from mvseg.formats.image_file import read_rgb
from mvseg.formats.scene_folder import load_scene
from mvseg.formats.turntable import read_turntable_angles, write_turntable
from mvseg.poses.board_calibration import TurntableCalibration, calibrate_turntable
from mvseg.poses.photo_files import PhotoFile, copy_photos
from mvseg.poses.scene_files import IMAGES
from mvseg.scene import Scene

TURNTABLE_FILE = "turntable.json"


def pose_board_photos(photos: Path, out: Path, *, board: BoardConfig, unit: str = "", quiet: bool = False) -> Scene:
    """Calibrate a turntable from photos of a board on it, and write a scene folder with a `turntable.json`.

    Args:
        photos: folder of photos that one camera took from one place.
        out: the scene folder; an earlier one is replaced, files of the user in it stay.
        board: what is printed; its lengths are in `unit`.
        unit: name of the unit.
        quiet: no progress bars and no line at the end.

    Raises:
        InputError: see `calibrate_turntable`; a photo is broken, or `out` holds something else.
    """
    source, names = check_folders(photos, out)
    with new_scene_folder(out) as folder:
        files = copy_photos(source, names, folder / IMAGES, progress=not quiet)
        found = calibrate_turntable(_read_grey(folder, files, quiet=quiet), board)
        shown = [index for index in range(len(files)) if math.isfinite(found.angles[index])]
        for index in sorted(set(range(len(files))) - set(shown)):
            (folder / IMAGES / files[index].name).unlink()
        angles = [(f"{IMAGES}/{files[index].name}", round(float(found.angles[index]), 6)) for index in shown]
        write_turntable(folder / TURNTABLE_FILE, _describe_camera(found), angles, unit=unit)
        scene = load_scene(folder)
        run: dict[str, Any] = {"residual_px": round(found.residual_px, 4), "corners": found.num_corners}
        run["photos"] = len(files)
        run |= {"registered": [files[index].name for index in shown], "board": asdict(board), "unit": unit}
        write_pose_file(folder, out, run)
    if not quiet:
        share = f"{len(shown)} of {len(files)} photos show the board"
        print(f"{out}: {share}, {found.residual_px:.2f} px, axis and camera are in {TURNTABLE_FILE}")
        print(f"  the same turntable with a plant: mvseg pose PHOTOS --out SCENE --turntable {out / TURNTABLE_FILE}")
    return scene


def pose_turntable_photos(photos: Path, out: Path, *, turntable: Path, quiet: bool = False) -> Scene:
    """The scene folder of photos from a turntable that was calibrated before, taken at the same angles, in that order.

    Args:
        photos: folder of photos.
        out: the scene folder, as above.
        turntable: a turntable file, with as many views as there are photos.
        quiet: no progress bars and no line at the end.

    Raises:
        InputError: another number or size of photos than the file says; a photo is broken, or `out` holds something
            else.
    """
    source, names = check_folders(photos, out)
    camera, angles, unit = read_turntable_angles(turntable)
    if len(names) != len(angles):
        message = f"{len(angles)} views for {len(names)} photos, expected one per photo, in the order of their names"
        raise InputError(f"{turntable}: {message}")
    with new_scene_folder(out) as folder:
        files = copy_photos(source, names, folder / IMAGES, progress=not quiet)
        for file in files:
            size, expected = (file.width, file.height), (camera["width"], camera["height"])
            if size != expected:
                given = f"{size[0]} x {size[1]} pixels, the turntable's camera {expected[0]} x {expected[1]}"
                raise InputError(f"{file.name} has {given}, expected photos of that camera")
        views = [(f"{IMAGES}/{file.name}", angle) for file, angle in zip(files, angles, strict=True)]
        write_turntable(folder / TURNTABLE_FILE, camera, views, unit=unit)
        scene = load_scene(folder)
        write_pose_file(folder, out, {"photos": len(files), "turntable": str(turntable), "unit": unit})
    if not quiet:
        print(f"{out}: {len(files)} photos at the angles of {turntable}")
    return replace(scene, source=out / TURNTABLE_FILE)


def _read_grey(folder: Path, files: Sequence[PhotoFile], *, quiet: bool) -> list[np.ndarray]:
    bar = tqdm(files, desc="board", unit="photo", disable=quiet)
    return [cv2.cvtColor(read_rgb(folder / IMAGES / file.name), cv2.COLOR_RGB2GRAY) for file in bar]


def _describe_camera(found: TurntableCalibration) -> dict[str, Any]:
    arrays = {"K": found.K, "R": found.R, "t": found.t, "distortion": found.distortion}
    return {"width": found.size[0], "height": found.size[1]} | {name: each.tolist() for name, each in arrays.items()}
