"""Is a binary COLMAP model whole?

pycolmap itself reads a file that was cut short without complaint, and takes whatever it finds for numbers: for the
parameters of a camera, or for the gigabytes that it then asks for.
"""

from __future__ import annotations

import mmap
import struct
from collections.abc import Callable
from pathlib import Path

import pycolmap

from mvseg.errors import InputError


def check_binary_model(model: Path) -> None:
    """Walk through every binary file of a model, record by record; a model in text has none.

    Raises:
        InputError: a file cannot be read, does not end where its own counts say, or names an unknown camera model.
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
