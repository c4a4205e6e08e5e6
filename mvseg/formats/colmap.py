"""COLMAP models, text or binary, with every perspective camera model of COLMAP, through pycolmap."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pycolmap

from mvseg.errors import InputError
from mvseg.formats.photos import Photo, build_scene
from mvseg.scene import Scene


def is_colmap_model(folder: Path) -> bool:
    """A folder with cameras.bin or cameras.txt."""
    return (folder / "cameras.bin").is_file() or (folder / "cameras.txt").is_file()


def read_colmap(model: Path, folder: Path) -> Scene:
    """The scene of a COLMAP model; views in the order of their image names; the unit is unknown ("").

    Args:
        model: the folder of cameras, images and points3D (.bin or .txt).
        folder: the scene; photos are expected in its `images/`. Images that COLMAP did not register are left out.

    Raises:
        InputError: the model cannot be read, a camera has no pinhole (EQUIRECTANGULAR), or see `build_scene`.
    """
    try:
        reconstruction = pycolmap.Reconstruction(model)
    except (RuntimeError, ValueError, IndexError, OSError, MemoryError) as error:
        reason = " ".join(str(error).split())
        raise InputError(f"{model}: not a whole COLMAP model ({reason})") from None
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
    return build_scene(folder, photos, unit="", source=model)
