"""The photos of a folder, checked and copied upright into a scene."""

from __future__ import annotations

import math
import shutil
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import accumulate, pairwise
from pathlib import Path

from PIL import Image, ImageOps

from mvseg.errors import InputError, faults_of
from mvseg.formats.find_views import natural_order
from mvseg.formats.heic import SUFFIXES as HEIC_SUFFIXES
from mvseg.formats.image_file import (
    ORIENTATION,
    read_image,
    read_orientation,
    read_rgb,
    sensor_bits,
    turn_upright,
    write_png,
)
from mvseg.formats.opencv_yaml import Calibration
from mvseg.formats.photos import photos_in
from mvseg.poses.numbers import STRUCTURE
from mvseg.system.running import progress_bar

FOCAL_LENGTH, FOCAL_LENGTH_35MM, DIGITAL_ZOOM = 0x920A, 0xA405, 0xA404  # definition: EXIF tags
CAMERA_MODEL, EXIF_BLOCK = 0x0110, 0x8769  # definition: EXIF tags


@dataclass(frozen=True)
class PhotoFile:
    """A photo in a scene's `images/`.

    Attributes:
        name: path below `images/`, "/" between folders.
        width, height: pixels.
        optics: what EXIF says of camera model and focal length; "" where it says nothing.
        is_turned: it was turned upright, as EXIF asks.
        zoom: digital zoom; 1 where EXIF says nothing.
    """

    name: str
    width: int
    height: int
    optics: str = ""
    is_turned: bool = False
    zoom: float = 1.0

    @property
    def folder(self) -> str:
        return self.name.rpartition("/")[0]

    @property
    def size(self) -> tuple[int, int]:
        return self.width, self.height


def calibrated_size(calibration: Calibration, photos: Sequence[PhotoFile]) -> tuple[int, int]:
    """Width and height of photos that were all taken with a calibrated camera. Raises InputError if a photo has another
    size than the calibration, or than the first photo if that says none."""
    size = (calibration.width or photos[0].width, calibration.height or photos[0].height)
    other = next((photo for photo in photos if photo.size != size), None)
    if other is not None:
        given = f"the calibration is of {size[0]} x {size[1]} pixels"
        raise InputError(f"{other.name}: {given}, the photo has {other.width} x {other.height}")
    return size


def list_photos(folder: Path) -> tuple[Path, list[str]]:
    """List the photos of a folder: the files in it; without any, those in its `images/`; without these, those in its
    sub-folders, one for each camera. Returns the folder (or its `images/`), and the paths of the photos relative to it,
    in natural order. Raises InputError if there is no such folder, it holds fewer than three photos, or two photos
    differ in their suffix only."""
    if not folder.is_dir():
        problem = "is a file" if folder.exists() else "no such folder"
        raise InputError(f"{folder}: {problem}, expected a folder of photos or a video (MP4, MOV, 3GP, AVI, MKV, WebM)")
    paths = photos_in(folder)
    if not paths and (paths := photos_in(folder / "images")):
        folder = folder / "images"
    if not paths:
        folders = [path for path in sorted(folder.iterdir()) if path.is_dir() and not path.name.startswith(".")]
        paths = [path for each in folders for path in photos_in(each)]
    photos = [path.relative_to(folder).as_posix() for path in paths]
    if len(photos) < STRUCTURE.least:
        kinds = "JPEG, PNG, TIFF, BMP, WebP, HEIC"
        raise InputError(f"{folder}: found {len(photos)} photos ({kinds}), expected at least three")
    first_with: dict[str, str] = {}
    for name in photos:
        other = first_with.setdefault(name.rpartition(".")[0].lower(), name)
        if other != name:
            raise InputError(f"{folder}: {other} and {name} differ in their suffix only, expected one of them")
    return folder, sorted(photos, key=natural_order)


def copy_photos(folder: Path, names: Sequence[str], images: Path) -> list[PhotoFile]:
    """Copy photos, by their paths in `folder`, into a scene's new `images/`, as they are where that is possible.

    Photos that EXIF turns are written anew, upright, as JPEG if they are JPEG; so are WebP and HEIC files and those of
    10, 12 or 14 bits in 16, which COLMAP cannot read. HEIC becomes JPEG, too; all others of these become 8-bit PNG,
    brightened by the same factor. Raises InputError, which names the photo, if one is broken or truncated, and OSError
    if one cannot be copied.
    """
    photos = []
    bits = max((sensor_bits(folder / name) for name in names), default=8)
    for name in progress_bar(names, name="photos", unit="photo"):
        path = images / name
        path.parent.mkdir(parents=True, exist_ok=True)
        with faults_of(f"{folder / name}: the photo cannot be read, expected a whole image file"):
            photos.append(_copy(folder / name, path, images, bits=bits))
    return photos


def _copy(source: Path, path: Path, images: Path, *, bits: int) -> PhotoFile:
    orientation = read_orientation(source)
    turned = orientation != 1
    image = read_image(source)  # decoded, so that a truncated file is found now
    optics, zoom = _describe_optics(image)
    is_heic = source.suffix.lower() in HEIC_SUFFIXES
    if is_heic or (turned and image.format == "JPEG"):
        path = path.with_suffix(".jpg") if is_heic else path
        exif = image.getexif()
        exif[ORIENTATION] = orientation
        image = ImageOps.exif_transpose(image)
        exif[ORIENTATION] = 1
        image.convert("RGB").save(path, format="JPEG", quality=STRUCTURE.quality, subsampling=0, exif=exif)
    elif turned or path.suffix.lower() == ".webp" or sensor_bits(source) not in (8, 16):
        path = path.with_suffix(".png")
        pixels = turn_upright(read_rgb(source, bits=bits), orientation)
        image = Image.fromarray(pixels)
        write_png(path, pixels)
    else:
        shutil.copyfile(source, path)
    name = path.relative_to(images).as_posix()
    return PhotoFile(name=name, width=image.width, height=image.height, optics=optics, is_turned=turned, zoom=zoom)


def _describe_optics(image: Image.Image) -> tuple[str, float]:
    try:
        exif = image.getexif()
        block = exif.get_ifd(EXIF_BLOCK)
        told = [exif.get(CAMERA_MODEL), block.get(FOCAL_LENGTH), block.get(FOCAL_LENGTH_35MM)]
        zoom = float(block.get(DIGITAL_ZOOM) or 1)
    except Exception:  # a damaged EXIF block says nothing
        return "", 1.0
    return " ".join(str(each).strip("\0 ") for each in told if each), zoom if zoom > 0 and zoom < math.inf else 1.0


def group_by_camera(photos: Sequence[PhotoFile], *, shared: bool | None = None) -> list[list[PhotoFile]]:
    """Group photos that share one camera, focal length and distortion; their order stays. `shared` True: one camera
    took all; False: each photo has its own; None: photos of one folder, size and (EXIF) focal length share one, and
    nearly one digital zoom, which jitters. Raises InputError if photos of different sizes are to share one camera."""
    groups: dict[object, list[PhotoFile]] = defaultdict(list)
    zooms = sorted({photo.zoom for photo in photos})
    is_new = [after > STRUCTURE.zoom_step * before for before, after in pairwise(zooms)]
    level = dict(zip(zooms, accumulate([0, *is_new]), strict=True))
    for photo in photos:
        key = (photo.folder, photo.width, photo.height, photo.optics, level[photo.zoom])
        groups["all" if shared else photo.name if shared is False else key].append(photo)
    for first, *others in groups.values():
        if other := next((each for each in others if each.size != first.size), None):
            sizes = f"{first.name} has {first.width} x {first.height} pixels"
            sizes += f", {other.name} {other.width} x {other.height}"
            raise InputError(f"{sizes}: they cannot share one camera, expected --shared_camera false or none")
    return list(groups.values())
