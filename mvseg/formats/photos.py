"""Builds the scene from photos with cameras, as every camera reader gives them, and reads the photos of a scene."""

from __future__ import annotations

import os
import posixpath
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from types import MappingProxyType

import numpy as np
import pycolmap
import torch
from numpy.typing import NDArray

from mvseg.errors import InputError, check_arguments, faults_of, warn
from mvseg.findings.finding import Finding, list_some
from mvseg.formats.image_file import (
    MAX_PIXELS,
    PHOTO_SUFFIXES,
    WrongSize,
    file_name_problem,
    is_grey,
    is_turned,
    read_image_size,
    read_rgb,
    sensor_bits,
)
from mvseg.formats.lens import undistort
from mvseg.scene import Cameras, Scene, View, camera_problem
from mvseg.system.file_hash import hash_files

ReadPhoto = Callable[[int], NDArray[np.uint8]]  # view index -> (H, W, 3) RGB, undistorted: `Photos`, or a stand-in

CACHED_BYTES = 256 * 2**20  # limit: 12 photos of 7 megapixels
STEP = 4  # limit: every fourth row and column is used
WHITE = 250  # chosen: a pixel is white if all of its channels reach this value


@dataclass(frozen=True, eq=False)
class Photo:
    """One photo with its camera, as it stands in a camera file.

    Attributes:
        file: path of the photo relative to the scene folder, "/" between folders.
        width, height: pixels.
        K: (3, 3) float64, without the distortion.
        R, t: (3, 3) and (3,) float64, of cam_from_world.
        lens: the camera with its distortion, None for a pinhole.
    """

    file: str
    width: int
    height: int
    K: np.ndarray
    R: np.ndarray
    t: np.ndarray
    lens: pycolmap.Camera | None = None


def build_scene(
    folder: Path, photos: Sequence[Photo], *, unit: str, source: Path, up: tuple[float, float, float] | None = None
) -> Scene:
    """Build the scene of a folder from its photos; messages name `source`, the file or folder that the cameras come
    from. `unit` is "" and `up`, the direction of the world that points up, None when unknown.

    Raises:
        InputError: fewer than two views, two views with the same name, a file name that leads out of the folder, a
            camera that is not sound, an `up` without a direction. The message names the view's index and its photo.
    """
    if len(photos) < 2:
        there = "is a single view" if photos else "are no views"
        raise InputError(f"{source}: there {there}, expected at least two")
    files = [find_photo(folder, photo.file) for photo in photos]
    moved = []
    for index, (photo, file) in enumerate(zip(photos, files, strict=True)):
        if problem := _problem(photo, file):
            raise InputError(f"{source}: view {index} ({photo.file}): {problem}")
        if posixpath.dirname(posixpath.normpath(photo.file)) != posixpath.dirname(posixpath.normpath(file)):
            moved.append(f"{file} for {photo.file}")
    if moved:
        warn(Finding("photos_by_name", str(source), {"count": len(moved), "first": moved[0]}))
    named = zip(view_names(files), files, photos, strict=True)
    views = tuple(View(name, folder / file, photo.lens) for name, file, photo in named)
    K, R, t = (torch.from_numpy(np.stack([getattr(photo, name) for photo in photos])) for name in ("K", "R", "t"))
    cameras = Cameras(K=K, R=R, t=t, sizes=torch.tensor([[photo.width, photo.height] for photo in photos]))
    with faults_of(source):
        return Scene(name=scene_name(folder), views=views, cameras=cameras, unit=unit, source=source, up=up)


def scene_name(folder: Path) -> str:
    """The name of a scene: that of its folder or, for a symbolic link, of the link."""
    return Path(os.path.abspath(folder)).name


def find_photo(folder: Path, file: str) -> str:
    """Find the photo that a camera file refers to: its path relative to the scene folder; `file` itself, if none.

    It is the file of this path; or the one there whose name differs in case only, or has a suffix where the given name
    has none (nerfstudio, Blender); or, for a path of another machine or one that leads out of the scene folder (those
    of colmap2nerf start at its working directory), the only photo of this name in the scene folder or below its
    `images/`.
    """
    name = file.replace("\\", "/").rsplit("/", 1)[-1].lower()
    leads_out = file_name_problem(file) is not None
    if not leads_out and (folder / file).is_file():
        return file
    beside = [] if leads_out else [((folder / file).parent, "*")]
    for places in (beside, [(folder, "*"), (folder / "images", "**/*")]):
        photos = [path for place in places for path in photos_in(*place)]
        matches = [path for path in photos if name in (path.name.lower(), path.stem.lower())]
        if len(matches) == 1:
            return matches[0].relative_to(folder).as_posix()
    return file


def size_of_photo(folder: Path, file: str) -> tuple[int, int]:
    """Width and height of the photo that a camera file refers to, if the file does not state them. Raises InputError,
    with a reason that does not name the photo, if that is missing, too, or cannot be read."""
    photo = folder / find_photo(folder, file)
    if file_name_problem(os.path.relpath(photo, folder)) or not photo.is_file():
        raise InputError("width and height are missing, and so is the photo")
    with faults_of("width and height are missing, and the photo cannot be read"):
        return read_image_size(photo)


def photos_in(folder: Path, pattern: str = "*") -> list[Path]:
    """The photos of a folder that fit a pattern, by their paths; hidden files are none. [] where there is no folder, or
    it cannot be read."""
    try:
        files = sorted(path for path in folder.glob(pattern) if path.is_file())
    except (OSError, ValueError):  # not readable, or a name that no file system takes
        return []
    return [path for path in files if path.suffix.lower() in PHOTO_SUFFIXES and not path.name.startswith(".")]


def view_names(files: Sequence[str]) -> list[str]:
    """Names of views: the paths of their photos below the folder that all share, without suffix."""
    paths = [PurePosixPath(posixpath.normpath(file)) for file in files]
    shared = posixpath.commonpath([path.parent for path in paths])
    return [path.relative_to(shared).with_suffix("").as_posix() for path in paths]


def _problem(photo: Photo, file: str) -> str | None:
    if problem := file_name_problem(file):
        return problem
    if max(photo.width, photo.height, photo.width * photo.height) > MAX_PIXELS:
        return f"the image size is {photo.width} x {photo.height}, expected at most {MAX_PIXELS} pixels in all"
    if photo.lens is not None and not np.isfinite(photo.lens.params).all():
        return f"its lens has the parameters {photo.lens.params_to_string()}, expected finite numbers"
    size = torch.tensor([photo.width, photo.height])
    return camera_problem(torch.as_tensor(photo.K), torch.as_tensor(photo.R), torch.as_tensor(photo.t), size=size)


def check_photos(scene: Scene) -> None:
    """Check that the photos of a scene exist. All may be missing: masks are enough for matching and for shapes. Raises
    InputError if some are there and others are missing.

    Warns (InputWarning) of photos that EXIF asks viewers to turn: cameras and masks must refer to the stored pixels, as
    those of COLMAP do; of 16-bit photos that all use fewer bits; and of other files in their folder, if all photos are
    missing.
    """
    paths = [view.path for view in scene.views]
    present = [path.is_file() for path in paths]
    if not all(present):
        missing = present.index(False)
        if any(present):
            beside = describe_folder(paths[missing].parent)
            raise InputError(f"{paths[missing]}: the image of view {missing} is missing{beside}")
        if found := photos_in(paths[missing].parent):
            warn(Finding("all_photos_missing", str(paths[0]), {"found": tuple(path.name for path in found)}))
        return
    warn_of_turned(paths)
    known = _bits_of_views(scene)
    if 8 < max(known) < 16:
        deep = [path for path, bits in zip(paths, known, strict=True) if bits > 8]
        warn(Finding("few_bits", str(deep[0]), {"count": len(deep), "bits": max(known)}))


def warn_of_turned(paths: Sequence[Path]) -> None:
    """Warn (InputWarning) of photos that an orientation tag (EXIF's, or TIFF's) asks viewers to turn."""
    if turned := [path for path in paths if is_turned(path)]:
        warn(Finding("turned_for_display", str(turned[0]), {"count": len(turned)}))


def describe_folder(folder: Path) -> str:
    """The photos in the folder where one is missing, as the end of a sentence; "" if there are none."""
    found = [path.name for path in photos_in(folder)]
    return f"; found {list_some(found)}" if found else ""


def require_photos(scene: Scene, folder: Path) -> None:
    """Raises InputError: a scene folder without masks has no photos either."""
    photo = scene.views[0].path
    if not photo.is_file():
        missing = "there are neither photos nor masks (--masks), expected one of them"
        raise InputError(f"{folder}: {missing}{describe_folder(photo.parent)}")


def photo_bits(scene: Scene, view: int) -> int:
    """How many bits the photo of a view is taken to use: 8 or, for a 16-bit file, the most that any photo of the scene
    uses, so that all are brightened by the same factor."""
    own = sensor_bits(scene.views[view].path, tuple(scene.cameras.sizes[view].tolist()))
    return own if own in (8, 16) else max(_bits_of_views(scene))


def _bits_of_views(scene: Scene) -> list[int]:
    sizes = [(width, height) for width, height in scene.cameras.sizes.tolist()]
    return [sensor_bits(view.path, size) for view, size in zip(scene.views, sizes, strict=True)]


@check_arguments
def load_photos(scene: Scene) -> list[torch.Tensor]:
    """V tensors (3, H, W) float32 in [0, 1], RGB, undistorted: what torchvision's detectors take.

    Raises:
        InputError: see `read_photo`.
    """
    photos = [read_photo(scene, view) for view in range(len(scene.views))]
    return [torch.from_numpy(photo).permute(2, 0, 1).float() / 255 for photo in photos]


@dataclass(frozen=True)
class PhotoContent:
    """The numbers of one photo.

    Attributes:
        contrast: standard deviation of its grey levels.
        level: grey level that 99 % of the pixels stay below.
        burnt: share of its pixels that are white.
    """

    contrast: float
    level: float
    burnt: float
    grey: bool


def measure_content(photo: np.ndarray) -> PhotoContent:
    """Measure a photo (H, W, 3) uint8 as it is stored: without its lens distortion it would have black corners."""
    pixels = photo[::STEP, ::STEP]
    levels = pixels.mean(2)
    level, burnt = float(np.quantile(levels, 0.99)), float((pixels.min(2) >= WHITE).mean())
    return PhotoContent(contrast=float(levels.std()), level=level, burnt=burnt, grey=is_grey(pixels))


class Photos:
    """The photos of a scene: `photos(view)` is (H, W, 3) uint8 RGB with its lens distortion removed, see `read_photo`.

    One object goes through all stages of a run. `CACHED_BYTES` of photos are kept in all, so that a scene that fits is
    decoded once. Of a larger one those that came first are kept, since every stage goes through the photos in one
    order; each of the others is decoded once per stage. Content and hash of every photo are kept, however large the
    scene is. (A photo of 16 bits is decoded once more, see `photo_bits`.) Photos are shared: they must not be written
    to. `exist` is true if there are photos; all of them or none, see `check_photos`.
    """

    def __init__(self, scene: Scene, cached: Mapping[int, np.ndarray] = MappingProxyType({})) -> None:
        """`cached`: {view: photo}, those in memory; files are not read for these."""
        self.scene = scene
        self._cached = dict(cached)
        self._contents: dict[int, PhotoContent] = {}
        self._hashes: dict[int, str] = {}

    @property
    def exist(self) -> bool:
        return bool(self._cached) or self.scene.views[0].path.is_file()

    def __call__(self, view: int) -> np.ndarray:
        photo = self._cached.get(view)
        if photo is None:
            stored = read_stored(self.scene, view)
            if view not in self._contents:
                self._contents[view] = measure_content(stored)
            photo = _undistort(stored, self.scene, view)
            photo.flags.writeable = False
            while self._cached and sum(each.nbytes for each in (photo, *self._cached.values())) > CACHED_BYTES:
                self._cached.popitem()  # the one that came last
            self._cached[view] = photo
        return photo

    def content(self, view: int) -> PhotoContent:
        """Content of the photo of a view; raises InputError as `read_photo` does."""
        if view not in self._contents:
            self(view)
        return self._contents[view]

    def sha256(self, view: int) -> str:
        """SHA-256 of the file of a view, which must exist."""
        if view not in self._hashes:
            self._hashes[view] = hash_files(self.scene.views[view].path)
        return self._hashes[view]

    def select(self, scene: Scene, views: Sequence[int]) -> Photos:
        """Select photos of some views, which `scene` has in this order; what is known of them stays known."""
        chosen, places = Photos(scene), {view: place for place, view in enumerate(views)}
        for name in ("_cached", "_contents", "_hashes"):
            setattr(chosen, name, {places[view]: each for view, each in getattr(self, name).items() if view in places})
        return chosen


def read_photo(scene: Scene, view: int) -> np.ndarray:
    """(H, W, 3) uint8 RGB, the photo of a view with its lens distortion removed; see `read_stored`."""
    return _undistort(read_stored(scene, view), scene, view)


def _undistort(stored: np.ndarray, scene: Scene, view: int) -> np.ndarray:
    return undistort(stored, scene.views[view].lens, scene.cameras.K[view].cpu().numpy())


def read_stored(scene: Scene, view: int) -> np.ndarray:
    """(H, W, 3) uint8 RGB, the photo of a view as its lens saw it, in the file's rows and columns, whatever EXIF says;
    see `check_photos`. Photos of 10, 12 or 14 bits in files of 16 are brightened, all of a scene alike; see
    `photo_bits`. Raises InputError if the photo is missing, cannot be read, or is of another size than its camera
    says."""
    path, (width, height) = scene.views[view].path, scene.cameras.sizes[view].tolist()
    if not path.is_file():
        raise InputError(f"{path}: the image of view {view} is missing")
    try:
        return read_rgb(path, (width, height), bits=photo_bits(scene, view))
    except WrongSize as error:
        raise InputError(f"{path}: the image of view {view} is {error}") from None
    except InputError as error:
        message = f"{path}: the image of view {view} cannot be read, expected a whole image file: {error}"
        raise InputError(message) from error
