"""COLMAP models, text or binary, with every perspective camera model of COLMAP, through pycolmap."""

from __future__ import annotations

import mmap
import struct
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path

import numpy as np
import pycolmap

from mvseg.errors import InputError, warn
from mvseg.findings.finding import Finding, Values
from mvseg.formats.find_views import natural_order
from mvseg.formats.photos import Photo, build_scene, photos_in
from mvseg.scene import Scene


def is_colmap_model(folder: Path) -> bool:
    """A folder with cameras.bin or cameras.txt."""
    return (folder / "cameras.bin").is_file() or (folder / "cameras.txt").is_file()


def find_colmap_model(folder: Path) -> Path | None:
    """Find the COLMAP model of a scene folder: `sparse/` itself, or the folder of `sparse/` (else of `colmap/sparse/`)
    whose model has the most photos, the first of equals; None if there is none. COLMAP writes `sparse/0`, `sparse/1`,
    ... where it could not connect all photos. Warns (InputWarning) of all other models: each has its own world."""
    for place in (folder / "sparse", folder / "colmap" / "sparse"):
        if is_colmap_model(place):
            return place
        models = sorted(filter(is_colmap_model, place.glob("*")), key=lambda path: natural_order(path.name))
        if counts := {model: _count_photos(model) for model in models}:
            best = max(counts, key=counts.__getitem__)
            if len(counts) > 1:
                shown = tuple(f"{model.name} with {count} photos" for model, count in counts.items())
                taken: Values = {"count": len(counts), "models": shown, "taken": best.name}
                warn(Finding("several_models", str(place), taken))
            return best
    return None


def _count_photos(model: Path) -> int:
    with suppress(OSError, struct.error):
        if (model / "images.bin").is_file():
            with (model / "images.bin").open("rb") as file:
                return int(struct.unpack("<Q", file.read(8))[0])
        with (model / "images.txt").open(encoding="utf-8", errors="replace") as file:
            return sum(not line.startswith("#") for line in file) // 2  # of each photo: its pose, its points
    return 0


def read_colmap(model: Path, folder: Path) -> Scene:
    """Read a COLMAP model, the folder of cameras, images and points3D (.bin or .txt); the unit is unknown ("").

    Views are in the order of their image names; images that COLMAP did not register are left out. Photos are expected
    in the `images/` of `folder`. Raises InputError if the model cannot be read or is truncated, or a camera is not
    perspective (EQUIRECTANGULAR); see also `build_scene`.
    """
    _check_binary_model(model)
    try:
        reconstruction = pycolmap.Reconstruction(model)
        for image_id, name in _list_names(model / "images.txt"):
            if image_id in reconstruction.images:
                reconstruction.images[image_id].name = name
        images = sorted(reconstruction.images.values(), key=lambda image: image.name)  # which may be no UTF-8
    except (RuntimeError, ValueError, IndexError, OSError, MemoryError) as error:
        raise InputError(f"{model}: cannot be read as a COLMAP model ({' '.join(str(error).split())})") from None
    photos = [_photo(model, image, reconstruction.cameras[image.camera_id]) for image in images if image.has_pose]
    scene = build_scene(folder, photos, unit="", source=model)
    registered, images_folder = {view.path for view in scene.views}, folder / "images"
    photos_there = photos_in(images_folder, "**/*")
    if left_out := [path.relative_to(images_folder).as_posix() for path in photos_there if path not in registered]:
        warn(Finding("photos_without_pose", str(model), {"count": len(left_out), "first": left_out[0]}))
    return scene


def _list_names(path: Path) -> Iterator[tuple[int, str]]:
    """Ids and names of the images of a text model, which pycolmap cuts at a space; nothing of a binary model."""
    if path.with_suffix(".bin").is_file() or not path.is_file():
        return
    with path.open(encoding="utf-8") as file:
        for line in file:
            if line.strip() and not line.startswith("#"):
                image_id, *_, name = line.strip().split(maxsplit=9)
                yield int(image_id), name
                next(file, "")  # its points, of which there may be none


def _photo(model: Path, image: pycolmap.Image, lens: pycolmap.Camera) -> Photo:
    if not lens.is_perspective():
        raise InputError(f"{model}: image {image.name}: camera model {lens.model_name} is not a perspective one")
    file, pose, K = f"images/{image.name}", image.cam_from_world(), np.array(lens.calibration_matrix())
    R, t = np.array(pose.rotation.matrix()), np.array(pose.translation)
    distorted = None if lens.is_perspective_pinhole() and lens.is_undistorted() else lens
    return Photo(file=file, width=lens.width, height=lens.height, K=K, R=R, t=t, lens=distorted)


def _check_binary_model(model: Path) -> None:
    """Refuse a truncated binary model: pycolmap 4.2 may accept half of it, never return, or allocate gigabytes."""
    for name, record_end in RECORD_ENDS.items():
        path = model / name
        if not path.is_file():
            continue
        try:
            with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
                end = 8
                for _ in range(_number(data, 0, "<Q")):
                    end = record_end(data, end)
                is_whole = end == len(data)
        except KeyError as number:
            raise InputError(f"{path}: camera model number {number} is not known") from None
        except (struct.error, ValueError, IndexError, OverflowError):  # beyond the end, or no byte at all
            is_whole = False
        if not is_whole:
            raise InputError(f"{path}: not a whole COLMAP file (its length is not what its counts say)")


def _number(data: mmap.mmap, at: int, form: str) -> int:
    return int(struct.unpack_from(form, data, at)[0])


def _camera_end(data: mmap.mmap, at: int) -> int:
    model = _number(data, at + 4, "<i")
    try:
        camera = pycolmap.Camera.create_from_model_id(0, pycolmap.CameraModelId(model), 1, 1, 1)
    except ValueError:
        raise KeyError(model) from None
    return at + 24 + 8 * len(camera.params)


def _image_end(data: mmap.mmap, at: int) -> int:
    name_end = data.find(b"\0", at + 64)
    if name_end < 0:
        raise IndexError("no end of the name")
    return name_end + 9 + 24 * _number(data, name_end + 1, "<Q")


def _rig_end(data: mmap.mmap, at: int) -> int:
    num_sensors = _number(data, at + 4, "<I")
    end = at + (16 if num_sensors else 8)
    for _ in range(num_sensors - 1):
        end += 65 if data[end + 8] else 9  # with a pose or without
    return end


RECORD_ENDS: dict[str, Callable[[mmap.mmap, int], int]] = {
    "rigs.bin": _rig_end,
    "cameras.bin": _camera_end,
    "frames.bin": lambda data, at: at + 68 + 16 * _number(data, at + 64, "<I"),
    "images.bin": _image_end,
    "points3D.bin": lambda data, at: at + 51 + 8 * _number(data, at + 43, "<Q"),
}
