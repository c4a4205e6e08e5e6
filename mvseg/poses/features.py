"""SIFT features of every photo and their matches, in COLMAP's database.

`find_features` is quick. `extract_features` finds more, COLMAP's own, in four times the time, and matching those takes
nearly ten times as long: for photos of which too few register otherwise. COLMAP's lists of pairs cannot hold names with
spaces, so it gets the photos under numbers.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray

from mvseg.errors import InputError
from mvseg.formats.image_file import read_rgb
from mvseg.poses.cancellable import run_cancellable
from mvseg.poses.config import PoseConfig
from mvseg.poses.numbers import STRUCTURE
from mvseg.poses.photo_files import PhotoFile, group_by_camera
from mvseg.poses.sift import coarsest, count_alike, find_sift
from mvseg.system.running import progress_bar

PHOTOS_AT_ONCE = max(2, os.cpu_count() or 1)  # of one call, after which the progress bar advances


def number_photos(images: Path, photos: Sequence[PhotoFile], folder: Path) -> dict[str, PhotoFile]:
    """Make the photos of `images` appear in a new folder under their numbers; returns them by these names, in order."""
    folder.mkdir(parents=True)
    numbered = {f"{index:06d}{Path(photo.name).suffix.lower()}": photo for index, photo in enumerate(photos)}
    for name, photo in numbered.items():
        try:
            os.link(images / photo.name, folder / name)
        except OSError:  # a disk without links
            shutil.copyfile(images / photo.name, folder / name)
    return numbered


def make_database(
    database: Path, folder: Path, numbered: Mapping[str, PhotoFile], *, config: PoseConfig, lens: pycolmap.Camera | None
) -> None:
    """Make a new database with all photos, of these names in `folder`; those of one camera share it. `lens` is the
    camera, if it is calibrated. Raises InputError if COLMAP cannot read a photo, or photos of one camera differ in
    size."""
    pycolmap.Database.open(database).close()  # makes it
    for names in _names_by_camera(numbered, config):  # in order, so that photos have the same numbers in every run
        pycolmap.import_images(database, folder, pycolmap.CameraMode.SINGLE, names, _reader(config, lens))
    with pycolmap.Database.open(database) as opened:
        for name, photo in numbered.items():
            if opened.read_image_with_name(name) is None:
                raise InputError(f"{photo.name}: COLMAP cannot read this photo, expected JPEG or PNG")


def find_features(database: Path, folder: Path, names: Sequence[str], *, image_size: int) -> NDArray[np.int64]:
    """Find `STRUCTURE.quick_most` features or fewer in each photo of the database, at `quick_size` pixels or fewer;
    returns (V, V) how alike the photos are, see `count_alike`."""
    coarse, size = [], min(image_size, STRUCTURE.quick_size)
    with pycolmap.Database.open(database) as opened:
        number_of = {image.name: image.image_id for image in opened.read_all_images()}
        for name in progress_bar(names, name="features", unit="photo"):
            sift = find_sift(read_rgb(folder / name), image_size=size, most=STRUCTURE.quick_most)
            opened.write_keypoints(number_of[name], np.column_stack([sift.px, sift.scale, sift.angle]))
            bytes_of = pycolmap.FeatureDescriptors(pycolmap.FeatureExtractorType.SIFT, sift.descriptors)
            opened.write_descriptors(number_of[name], bytes_of)
            coarse.append(coarsest(sift))
    return count_alike(coarse)


def extract_features(
    database: Path, folder: Path, numbered: Mapping[str, PhotoFile], *, config: PoseConfig, lens: pycolmap.Camera | None
) -> None:
    """Find COLMAP's features of all photos of the database, which was made with the same arguments."""
    options = {
        "camera_mode": pycolmap.CameraMode.SINGLE,
        "reader_options": _reader(config, lens),
        "extraction_options": pycolmap.FeatureExtractionOptions(use_gpu=False, max_image_size=config.image_size),
    }
    with progress_bar(total=len(numbered), name="more features", unit="photo") as bar:
        for names in _names_by_camera(numbered, config):
            for start in range(0, len(names), PHOTOS_AT_ONCE):
                some = names[start : start + PHOTOS_AT_ONCE]
                run_cancellable(pycolmap.extract_features, database, folder, image_names=some, **options)
                bar.update(len(some))


def _reader(config: PoseConfig, lens: pycolmap.Camera | None) -> pycolmap.ImageReaderOptions:
    reader = pycolmap.ImageReaderOptions(camera_model=config.camera_model)
    if lens is not None:
        reader.camera_model, reader.camera_params = lens.model_name, ",".join(map(repr, map(float, lens.params)))
    return reader


def _names_by_camera(numbered: Mapping[str, PhotoFile], config: PoseConfig) -> list[list[str]]:
    name_of = {photo: name for name, photo in numbered.items()}
    groups = group_by_camera(list(numbered.values()), shared=config.shared_camera)
    return [[name_of[photo] for photo in group] for group in groups]


def match_features(database: Path, names: Sequence[str], pairs: Sequence[tuple[int, int]]) -> None:
    """Match the features of pairs (i, j) of these photos in the database, and keep what fits one relative pose."""
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = STRUCTURE.seed
    # What stays at its pixels is a backdrop that does not turn with the plant: a third of a photo of it, and all photos
    # register around the wrong thing. Photos without one lose nothing by it.
    verification.filter_stationary_matches = True
    listed = database.with_name("pairs.txt")
    options = {
        "matching_options": pycolmap.FeatureMatchingOptions(use_gpu=False),
        "pairing_options": pycolmap.ImportedPairingOptions(match_list_path=listed),
        "verification_options": verification,
    }
    with progress_bar(total=len(pairs), name="matching", unit="pair") as bar:
        for start in range(0, len(pairs), STRUCTURE.pairs_at_once):
            some = pairs[start : start + STRUCTURE.pairs_at_once]
            listed.write_text("".join(f"{names[i]} {names[j]}\n" for i, j in some), newline="\n")
            run_cancellable(pycolmap.match_image_pairs, database, **options)
            bar.update(len(some))
