"""From photos with cameras, as every reader of cameras gives them, to a scene; and the photos of a scene, read."""

from __future__ import annotations

import os
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import numpy as np
import pycolmap
import torch

from mvseg.errors import InputError, InputWarning
from mvseg.formats.image_file import MAX_SIDE, file_name_problem, is_turned, read_rgb
from mvseg.formats.lens import undistort
from mvseg.scene import Cameras, Scene, View, camera_problem


@dataclass(frozen=True, eq=False)
class Photo:
    """One photo with its camera, as it stands in a camera file.

    Attributes:
        file: path of the photo relative to the scene folder, "/" between folders.
        width: pixels.
        height: pixels.
        K: (3, 3) float64, without the distortion.
        R: (3, 3) float64, of cam_from_world.
        t: (3,) float64, of cam_from_world.
        lens: the camera with its distortion, None for a pinhole.
    """

    file: str
    width: int
    height: int
    K: np.ndarray
    R: np.ndarray
    t: np.ndarray
    lens: pycolmap.Camera | None = None


def build_scene(folder: Path, photos: Sequence[Photo], *, unit: str, source: Path) -> Scene:
    """The scene of a folder from its photos.

    Args:
        folder: the scene; its name becomes that of the scene.
        photos: one per view.
        unit: of the world, "" when unknown.
        source: the file or folder that the cameras come from; messages name it.

    Raises:
        InputError: fewer than two views, two views with the same name, a file name that leads out of the folder, a
            camera that is not sound. The message names the view's index and its photo.
    """
    if not photos:
        raise InputError(f"{source}: there are no views, expected at least two")
    if len(photos) < 2:
        raise InputError(f"{source}: there is a single view, expected at least two")
    for index, photo in enumerate(photos):
        problem = _problem(photo)
        if problem:
            raise InputError(f"{source}: view {index} ({photo.file}): {problem}")
    views = tuple(
        View(name, folder / photo.file, photo.lens)
        for name, photo in zip(view_names([photo.file for photo in photos]), photos, strict=True)
    )
    cameras = Cameras(
        K=torch.from_numpy(np.stack([photo.K for photo in photos])),
        R=torch.from_numpy(np.stack([photo.R for photo in photos])),
        t=torch.from_numpy(np.stack([photo.t for photo in photos])),
        sizes=torch.tensor([[photo.width, photo.height] for photo in photos]),
    )
    try:
        return Scene(name=folder.resolve().name, views=views, cameras=cameras, unit=unit, source=source)
    except InputError as error:
        raise InputError(f"{source}: {error}") from None


def view_names(files: Sequence[str]) -> list[str]:
    """Names of views: the paths of their photos below the folder that all share, without suffix."""
    paths = [PurePosixPath(os.path.normpath(file)) for file in files]
    shared = os.path.commonpath([path.parent for path in paths])
    return [path.relative_to(shared).with_suffix("").as_posix() for path in paths]


def _problem(photo: Photo) -> str | None:
    """What is wrong with a photo's path or camera, as the end of a sentence; None for a sound one."""
    problem = file_name_problem(photo.file)
    if problem:
        return problem
    if max(photo.width, photo.height) > MAX_SIDE:
        return f"the image size is {photo.width} x {photo.height}, expected at most {MAX_SIDE} pixels a side"
    size = torch.tensor([photo.width, photo.height])
    return camera_problem(torch.as_tensor(photo.K), torch.as_tensor(photo.R), torch.as_tensor(photo.t), size=size)


def check_photos(scene: Scene) -> None:
    """Are the photos of a scene there? None at all is fine: masks are enough for matching and for shapes.

    Warns (InputWarning) of photos that EXIF asks viewers to turn: cameras and masks must refer to the stored pixels, as
    those of COLMAP do.

    Raises:
        InputError: some photos are there and others are missing.
    """
    present = [view.path.is_file() for view in scene.views]
    if any(present) and not all(present):
        missing = present.index(False)
        raise InputError(f"{scene.views[missing].path}: the image of view {missing} is missing")
    turned = [view.path for view in scene.views if view.path.is_file() and is_turned(view.path)]
    if turned:
        message = f"EXIF turns {len(turned)} photos for display; cameras and masks must refer to the pixels as stored"
        warnings.warn(f"{turned[0]}: {message}", InputWarning, stacklevel=2)


def load_photos(scene: Scene) -> list[torch.Tensor]:
    """V tensors (3, H, W) float32 in [0, 1], RGB, undistorted: what torchvision's detectors take.

    Raises:
        InputError: see `read_photo`.
    """
    photos = [read_photo(scene, view) for view in range(len(scene.views))]
    return [torch.from_numpy(photo).permute(2, 0, 1).float() / 255 for photo in photos]


def read_photo(scene: Scene, view: int) -> np.ndarray:
    """(H, W, 3) uint8 RGB, the photo of a view with its lens distortion removed.

    Rows and columns are those that the file stores, whatever EXIF says; see `check_photos`.

    Raises:
        InputError: the photo is missing, cannot be read, or is of another size than its camera says.
    """
    path, (width, height) = scene.views[view].path, scene.cameras.sizes[view].tolist()
    if not path.is_file():
        raise InputError(f"{path}: the image of view {view} is missing")
    try:
        pixels = read_rgb(path)
    except InputError as error:
        message = f"{path}: the image of view {view} cannot be read, expected a whole image file: {error}"
        raise InputError(message) from None
    if pixels.shape[:2] != (height, width):
        size = f"{pixels.shape[1]} x {pixels.shape[0]}"
        turned = " (as it is stored; EXIF turns it for display)" if is_turned(path) else ""
        raise InputError(f"{path}: the image of view {view} is {size}{turned}, its camera says {width} x {height}")
    return undistort(pixels, scene.views[view].lens, scene.cameras.K[view].cpu().numpy())
