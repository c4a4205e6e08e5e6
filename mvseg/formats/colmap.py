"""COLMAP models, text or binary, with every perspective camera model of COLMAP, through pycolmap."""

from __future__ import annotations

import mmap
import struct
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pycolmap

from mvseg.errors import InputError, InputWarning
from mvseg.formats.photos import Photo, build_scene
from mvseg.scene import Scene

PHOTO_SUFFIXES = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp", ".webp")


def is_colmap_model(folder: Path) -> bool:
    """A folder with cameras.bin or cameras.txt."""
    return (folder / "cameras.bin").is_file() or (folder / "cameras.txt").is_file()


def read_colmap(model: Path, folder: Path) -> Scene:
    """The scene of a COLMAP model; views in the order of their image names; the unit is unknown ("").

    Args:
        model: the folder of cameras, images and points3D (.bin or .txt).
        folder: the scene; photos are expected in its `images/`. Images that COLMAP did not register are left out.

    Raises:
        InputError: the model cannot be read or is cut short, a camera has no pinhole (EQUIRECTANGULAR); see also
            `build_scene`.
    """
    _check_whole(model)
    try:
        reconstruction = pycolmap.Reconstruction(model)
    except (RuntimeError, ValueError, IndexError, OSError, MemoryError) as error:
        reason = " ".join(str(error).split())
        raise InputError(f"{model}: cannot be read as a COLMAP model ({reason})") from None
    photos = []
    for image in sorted(reconstruction.images.values(), key=lambda image: image.name):
        if not image.has_pose:
            continue
        lens = reconstruction.cameras[image.camera_id]
        if not lens.is_perspective():
            raise InputError(f"{model}: image {image.name}: camera model {lens.model_name} is no perspective one")
        cam_from_world = image.cam_from_world()
        photos.append(
            Photo(
                f"images/{image.name}",
                lens.width,
                lens.height,
                np.array(lens.calibration_matrix()),
                np.array(cam_from_world.rotation.matrix()),
                np.array(cam_from_world.translation),
                None if lens.is_perspective_pinhole() and lens.is_undistorted() else lens,
            )
        )
    scene = build_scene(folder, photos, unit="", source=model)
    known = {photo.file.removeprefix("images/") for photo in photos}
    here = [path.relative_to(folder / "images").as_posix() for path in sorted((folder / "images").rglob("*.*"))]
    without = [name for name in here if name not in known and name.lower().endswith(PHOTO_SUFFIXES)]
    if without:
        message = (
            f"{len(without)} photos in images/ have no pose in the model and are left out, the first is {without[0]}"
        )
        warnings.warn(f"{model}: {message}", InputWarning, stacklevel=3)
    return scene


def _check_whole(model: Path) -> None:
    """Raises InputError unless every binary file of a model ends where its own counts say.

    pycolmap itself reads a cut file without complaint and takes whatever it finds for numbers: for the parameters of
    a camera, or for the gigabytes it then asks for.
    """
    for name, record_end in RECORD_ENDS.items():
        path = model / name
        if not path.is_file():
            continue
        try:
            with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
                (count,) = struct.unpack_from("<Q", data, 0)
                end = 8
                for _ in range(count):
                    end = record_end(data, end)
                is_whole = end == len(data)
        except OSError as error:
            raise InputError(f"{path}: cannot be read ({error.strerror})") from None
        except InputError as error:
            raise InputError(f"{path}: {error}") from None
        except (struct.error, ValueError, IndexError, OverflowError):  # beyond the end, or no byte at all
            is_whole = False
        if not is_whole:
            raise InputError(f"{path}: not a whole COLMAP file (its length is not what its counts say)")


def _camera_end(data: mmap.mmap, at: int) -> int:
    (model,) = struct.unpack_from("<i", data, at + 4)
    try:
        camera = pycolmap.Camera.create_from_model_id(0, pycolmap.CameraModelId(model), 1, 1, 1)
    except ValueError:
        raise InputError(f"camera model number {model} is not known") from None
    return at + 24 + 8 * len(camera.params)


def _image_end(data: mmap.mmap, at: int) -> int:
    name_end = data.find(b"\0", at + 64)
    if name_end < 0:
        raise ValueError("no end of the name")
    (num_points,) = struct.unpack_from("<Q", data, name_end + 1)
    return name_end + 9 + 24 * num_points


def _point_end(data: mmap.mmap, at: int) -> int:
    (length,) = struct.unpack_from("<Q", data, at + 43)
    return at + 51 + 8 * length


def _rig_end(data: mmap.mmap, at: int) -> int:
    (num_sensors,) = struct.unpack_from("<I", data, at + 4)
    end = at + (16 if num_sensors else 8)
    for _ in range(num_sensors - 1):
        end += 65 if data[end + 8] else 9  # with a pose or without
    return end


def _frame_end(data: mmap.mmap, at: int) -> int:
    (num_data,) = struct.unpack_from("<I", data, at + 64)
    return at + 68 + 16 * num_data


RECORD_ENDS: dict[str, Callable[[mmap.mmap, int], int]] = {
    "rigs.bin": _rig_end,
    "cameras.bin": _camera_end,
    "frames.bin": _frame_end,
    "images.bin": _image_end,
    "points3D.bin": _point_end,
}
