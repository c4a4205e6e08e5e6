"""Photos from a turntable, from their folder to a scene folder: calibrated once from a board, then used for plants."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from mvseg._version import made_by
from mvseg.errors import InputError, faults_of, warn
from mvseg.formats.board import BoardConfig
from mvseg.formats.image_file import read_rgb
from mvseg.formats.opencv_yaml import Calibration, read_calibration
from mvseg.formats.positions import read_photo_angles
from mvseg.formats.scene_folder import load_scene
from mvseg.formats.turntable import read_turntable_parts, write_turntable
from mvseg.poses.board_calibration import calibrate_turntable
from mvseg.poses.focal_length import FocalLength
from mvseg.poses.mapping import IMAGES
from mvseg.poses.photo_files import PhotoFile, calibrated_size, copy_photos
from mvseg.poses.table_fit import TableCamera
from mvseg.results.earlier import Output, replace_result
from mvseg.runs.pose_photos import list_folder, write_walk
from mvseg.scene import Scene
from mvseg.system.atomic import sweep_abandoned
from mvseg.system.running import now_running, progress_bar
from mvseg.system.say import say

TURNTABLE_FILE = "turntable.json"
ONLY_CAMERA = "camera"  # name of a camera without a folder for its photos

Angles = Path | float | None


def pose_board_photos(
    photos: Path, out: Path, *, board: BoardConfig, unit: str = "", calibration: Path | None = None
) -> Scene:
    """Calibrate a turntable from photos of a board on it, and write a scene folder with a `turntable.json`. Warns
    (InputWarning) of a focal length that the photos leave uncertain.

    Args:
        photos: folder of photos that one camera took from one place; or of one folder for each camera, with photos at
            the same angles in the same order.
        out: the scene folder; an earlier one is replaced, files of the user in it stay.
        board: its lengths are in `unit`.
        calibration: file of OpenCV or ROS with the matrix and distortion of all cameras, which are then not estimated.

    Raises InputError: see `calibrate_turntable`; the calibration is of another size or a lens that a turntable file
    cannot hold, a photo is broken, or `out` holds something else.
    """
    output = Output("scene", of=(photos,))
    sweep_abandoned(out)
    source, names = list_folder(photos, out)
    given = None if calibration is None else read_calibration(calibration.parent, calibration.name)
    run: dict[str, Any] = made_by() | {"board": asdict(board), "unit": unit}
    with replace_result(out, run, output) as folder:
        files = copy_photos(source, names, folder / IMAGES)
        by_camera: dict[str, list[PhotoFile]] = {}
        grey: dict[str, list[np.ndarray]] = {}
        for file in progress_bar(files, name="board", unit="photo"):
            camera = file.folder or ONLY_CAMERA
            by_camera.setdefault(camera, []).append(file)
            photo = cv2.cvtColor(read_rgb(folder / IMAGES / file.name), cv2.COLOR_RGB2GRAY)
            grey.setdefault(camera, []).append(photo)
        with faults_of(calibration):
            lens = None if given is None else _given_lens(given, files)
        fit = calibrate_turntable(grey, board, lens=lens)
        views = []
        for camera, each in by_camera.items():
            for file, angle in zip(each, fit.angles.tolist(), strict=True):
                if np.isfinite(angle):
                    views.append((f"{IMAGES}/{file.name}", camera, round(angle, 6)))
                else:
                    (folder / IMAGES / file.name).unlink()
        cameras = {name: _describe_camera(fit.cameras[name]) for name in by_camera}
        write_turntable(folder / TURNTABLE_FILE, cameras, views, unit=unit)
        scene = load_scene(folder)
        walk = write_walk(scene, folder, out)
        run |= {"residual_px": round(fit.residual_px, 4), "corners": fit.num_corners, "photos": len(files)}
        lengths = {name: FocalLength(float(each.K[0, 0]), each.focal_deviation) for name, each in fit.cameras.items()}
        run["lenses"] = [{"camera": name, "focal_length": asdict(length)} for name, length in lengths.items()]
        code = "turntable_focal_length_unsure"
        doubts = [each for name, length in lengths.items() for each in length.doubts(code, name)]
        run["findings"] = [each.as_json() for each in doubts]
        run["registered"] = [name.removeprefix(f"{IMAGES}/") for name, _, _ in views]
    for finding in doubts:
        warn(finding)
    if now_running().progress:
        share = f"{len(views)} of {len(files)} photos are at angles at which the board is seen"
        say(f"{out}: {share}, {fit.residual_px:.2f} px, axis and cameras are in {TURNTABLE_FILE}")
        for name, length in lengths.items():
            say(f"  {name}: {length.describe()}")
        say(walk)
        say(f"  the same turntable with a plant: mvseg pose PHOTOS --out SCENE --turntable {out / TURNTABLE_FILE}")
    return scene


def pose_turntable_photos(photos: Path, out: Path, *, turntable: Path, angles: Angles = None) -> Scene:
    """The scene folder of photos from a turntable that was calibrated before; `photos` and `out` are those of
    `pose_board_photos`, folders of cameras named as in the calibration.

    `angles` are a CSV file of `read_photo_angles`; or the degrees from one photo of a camera to its next one; None:
    those of the file, which then has as many views of each camera as there are photos. Raises InputError: photos of a
    camera that the file does not know, of another number or size than it says, or without an angle; a photo is broken,
    or `out` holds something else.
    """
    reads = (turntable, angles) if isinstance(angles, Path) else (turntable,)
    output = Output("scene", of=(photos,), reads=reads)
    sweep_abandoned(out)
    source, names = list_folder(photos, out)
    cameras, known, unit = read_turntable_parts(turntable)
    camera_of = _camera_of(names, list(cameras), turntable)
    angle_of = _angles_of(names, camera_of, known, angles=angles, turntable=turntable)
    run: dict[str, Any] = made_by() | {"photos": len(names), "turntable": str(turntable), "unit": unit}
    with replace_result(out, run, output) as folder:
        files = copy_photos(source, names, folder / IMAGES)
        for file, camera in zip(files, camera_of, strict=True):
            size, expected = (file.width, file.height), (cameras[camera]["width"], cameras[camera]["height"])
            if size != expected:
                given = f"{size[0]} x {size[1]} pixels, the turntable's camera {expected[0]} x {expected[1]}"
                raise InputError(f"{file.name} has {given}, expected photos of that camera")
        views = list(zip([f"{IMAGES}/{file.name}" for file in files], camera_of, angle_of, strict=True))
        write_turntable(folder / TURNTABLE_FILE, cameras, views, unit=unit)
        scene = load_scene(folder)
        walk = write_walk(scene, folder, out)
    if now_running().progress:
        step = f"steps of {angles:g} degrees" if isinstance(angles, float) else f"the angles of {angles or turntable}"
        say(f"{out}: {len(files)} photos at {step}\n{walk}")
    return replace(scene, source=out / TURNTABLE_FILE)


def _camera_of(names: Sequence[str], cameras: Sequence[str], turntable: Path) -> list[str]:
    if len(cameras) == 1:
        return [cameras[0]] * len(names)
    folders = [name.rpartition("/")[0] for name in names]
    for name, folder in zip(names, folders, strict=True):
        if folder not in cameras:
            message = f"{name} is in no folder of a camera"
            raise InputError(f"{turntable}: {message}, expected folders of these names: {', '.join(cameras)}")
    return folders


def _angles_of(
    names: list[str], camera_of: list[str], angles_of: list[tuple[str, float]], *, angles: Angles, turntable: Path
) -> list[float]:
    if isinstance(angles, Path):
        listed = read_photo_angles(angles)
        keys = [name if name in listed else name.rpartition("/")[2] for name in names]
        if absent := [name for name, key in zip(names, keys, strict=True) if key not in listed]:
            raise InputError(f"{angles}: there is no angle of photo {absent[0]}")
        return [listed[key] for key in keys]
    places = [camera_of[:index].count(camera) for index, camera in enumerate(camera_of)]
    if angles is not None:
        return [angles * place for place in places]
    counts = Counter(camera_of)
    of_camera = {camera: [angle for name, angle in angles_of if name == camera] for camera in counts}
    for camera, count in counts.items():
        if count != (num_views := len(of_camera[camera])):
            of = f" of camera {camera}" if len(counts) > 1 else ""
            problem = f"{turntable}: {num_views} views{of} for {count} photos"
            raise InputError(f"{problem}, expected one per photo, in the order of their names, or --angles")
    return [of_camera[camera][place] for camera, place in zip(camera_of, places, strict=True)]


def _given_lens(given: Calibration, files: Sequence[PhotoFile]) -> TableCamera:
    lens = np.append(given.distortion, np.zeros(max(0, 5 - len(given.distortion))))
    if given.is_fisheye or len(lens) > 5 or given.K[0, 1]:
        raise InputError("expected K without skew and k1, k2, p1, p2, k3, which a turntable file can hold")
    size = calibrated_size(given, files)
    return TableCamera(K=given.K, distortion=lens, R=np.eye(3), t=np.zeros(3), size=size)


def _describe_camera(camera: TableCamera) -> dict[str, Any]:
    arrays = {name: getattr(camera, name).tolist() for name in ("K", "R", "t", "distortion")}
    return {"width": camera.size[0], "height": camera.size[1], **arrays}
