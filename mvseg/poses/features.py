"""SIFT features of every photo and their matches, computed by COLMAP into its database.

COLMAP's lists of pairs cannot hold names with spaces, so it gets the photos under numbers.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path

import pycolmap
from tqdm import tqdm

from mvseg.errors import InputError
from mvseg.poses.cancellable import run_cancellable
from mvseg.poses.config import PoseConfig
from mvseg.poses.photo_files import PhotoFile, group_by_camera

PHOTOS_AT_ONCE = max(2, os.cpu_count() or 1)  # of one call, after which the progress bar advances
PAIRS_AT_ONCE = 10
SEED = 0


def number_photos(images: Path, photos: Sequence[PhotoFile], folder: Path) -> list[str]:
    """Make the photos of `images` appear in a new folder under their numbers; returns these names, in order."""
    folder.mkdir(parents=True)
    names = [f"{index:06d}{Path(photo.name).suffix.lower()}" for index, photo in enumerate(photos)]
    for photo, name in zip(photos, names, strict=True):
        try:
            os.link(images / photo.name, folder / name)
        except OSError:  # a disk without links
            shutil.copyfile(images / photo.name, folder / name)
    return names


def extract_features(
    database: Path,
    folder: Path,
    names: Sequence[str],
    *,
    photos: Sequence[PhotoFile],
    config: PoseConfig,
    lens: pycolmap.Camera | None = None,
    progress: bool = False,
) -> None:
    """Find the features of all photos; photos of one camera share it in the database.

    Args:
        database: COLMAP's, made here.
        folder: of the photos.
        names: of the photos in `folder`.
        photos: what is known of each.
        config: see `PoseConfig`.
        lens: the camera, if it is calibrated.
        progress: show a progress bar.

    Raises:
        InputError: COLMAP cannot read a photo, or photos of different sizes are to share a camera.
    """
    options = pycolmap.FeatureExtractionOptions(use_gpu=False, max_image_size=config.image_size)
    name_of = dict(zip(photos, names, strict=True))
    reader = pycolmap.ImageReaderOptions(camera_model=config.camera_model)
    if lens is not None:
        reader.camera_model, reader.camera_params = lens.model_name, ",".join(map(repr, map(float, lens.params)))
    groups = group_by_camera(photos, shared=config.shared_camera)
    pycolmap.Database.open(database).close()  # makes it
    for group in groups:  # first, so that photos have the same numbers in every run, whichever thread ends first
        listed = [name_of[photo] for photo in group]
        pycolmap.import_images(database, folder, pycolmap.CameraMode.SINGLE, listed, reader)
    _check_read(database, name_of)
    with tqdm(total=len(photos), desc="features", unit="photo", disable=not progress) as bar:
        for group in groups:
            for start in range(0, len(group), PHOTOS_AT_ONCE):
                some = [name_of[photo] for photo in group[start : start + PHOTOS_AT_ONCE]]
                extract = partial(
                    pycolmap.extract_features,
                    database,
                    folder,
                    image_names=some,
                    camera_mode=pycolmap.CameraMode.SINGLE,
                    reader_options=reader,
                    extraction_options=options,
                )
                run_cancellable(lambda token, extract=extract: extract(cancellation_token=token))  # type: ignore[misc]
                bar.update(len(some))


def _check_read(database: Path, name_of: Mapping[PhotoFile, str]) -> None:
    with pycolmap.Database.open(database) as opened:
        for photo, name in name_of.items():
            if opened.read_image_with_name(name) is None:
                raise InputError(f"{photo.name}: COLMAP cannot read this photo, expected JPEG or PNG")


def match_features(
    database: Path, names: Sequence[str], pairs: Sequence[tuple[int, int]], *, progress: bool = False
) -> None:
    """Match the features of pairs of photos, and keep what fits one relative pose.

    Args:
        database: with the features of all photos; matches are added.
        names: of the photos in the database, without spaces.
        pairs: (i, j), indices of `names`.
        progress: show a progress bar.
    """
    matching = pycolmap.FeatureMatchingOptions(use_gpu=False)
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = SEED
    listed = database.with_name("pairs.txt")
    pairing = pycolmap.ImportedPairingOptions(match_list_path=listed)
    with tqdm(total=len(pairs), desc="matching", unit="pair", disable=not progress) as bar:
        for start in range(0, len(pairs), PAIRS_AT_ONCE):
            some = pairs[start : start + PAIRS_AT_ONCE]
            listed.write_text("".join(f"{names[i]} {names[j]}\n" for i, j in some), newline="\n")
            run_cancellable(
                lambda token: pycolmap.match_image_pairs(
                    database,
                    matching_options=matching,
                    pairing_options=pairing,
                    verification_options=verification,
                    cancellation_token=token,
                )
            )
            bar.update(len(some))
