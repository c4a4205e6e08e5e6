"""Which photos are compared, SIFT features of every photo and their matches, computed by COLMAP into its database.

COLMAP's lists of pairs cannot hold names with spaces, so it gets the photos under numbers.
"""

from __future__ import annotations

import os
import shutil
from collections import defaultdict
from collections.abc import Mapping, Sequence
from itertools import combinations
from pathlib import Path

import pycolmap
from tqdm import tqdm

from mvseg.errors import InputError
from mvseg.poses.cancellable import run_cancellable
from mvseg.poses.config import Pairs, PoseConfig
from mvseg.poses.photo_files import PhotoFile, group_by_camera

PHOTOS_AT_ONCE = max(2, os.cpu_count() or 1)  # of one call, after which the progress bar advances
PAIRS_AT_ONCE = 10
SEED = 0
FEW = 40  # photos up to which all pairs are compared: 780 pairs, a minute or two on two cores
OVERLAP = 10  # neighbours on either side in a sequence
FAR = 2  # neighbours further away are 2 x OVERLAP, 4 x OVERLAP, ... steps off


def choose_pairs(names: Sequence[str], pairs: Pairs | None = None) -> list[tuple[int, int]]:
    """Pairs of photos to compare, as indices i < j, each once, in order.

    "exhaustive" are all pairs. "sequential" is for walks round a plant and turntables: each photo with its OVERLAP
    next neighbours on either side and with some further away, the last photos being neighbours of the first. Photos of
    different folders (one per camera) are neighbours if their places in their sequences are.

    Args:
        names: paths of the photos, "/" between folders, in the order in which they were taken.
        pairs: None: exhaustive for FEW photos, sequential for more.
    """
    if pairs == "exhaustive" or (pairs is None and len(names) <= FEW):
        return list(combinations(range(len(names)), 2))
    sequences: dict[str, list[int]] = defaultdict(list)
    for index, name in enumerate(names):
        sequences[name.rpartition("/")[0]].append(index)
    found: set[tuple[int, int]] = set()
    for one in sequences.values():
        for other in sequences.values():
            for place, index in enumerate(one):
                same = round(place * len(other) / len(one))  # the place of this photo in the other sequence
                near = {other[(same + step) % len(other)] for step in _steps(len(other))}
                found |= {(min(index, each), max(index, each)) for each in near if each != index}
    return sorted(found)


def _steps(num_photos: int) -> list[int]:
    """How far off the neighbours of a photo are, in a sequence."""
    steps = list(range(OVERLAP + 1))
    while steps[-1] * FAR <= num_photos // 2:
        steps.append(steps[-1] * FAR)
    return [sign * step for step in steps for sign in (1, -1)]


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


def extract_features(
    database: Path,
    folder: Path,
    numbered: Mapping[str, PhotoFile],
    *,
    config: PoseConfig,
    lens: pycolmap.Camera | None = None,
    progress: bool = False,
) -> None:
    """Find the features of all photos, of these names in `folder`; photos of one camera share it in the database, which
    is made here. `lens` is the camera, if it is calibrated.

    Raises:
        InputError: COLMAP cannot read a photo, or photos of different sizes are to share a camera.
    """
    options = pycolmap.FeatureExtractionOptions(use_gpu=False, max_image_size=config.image_size)
    reader = pycolmap.ImageReaderOptions(camera_model=config.camera_model)
    if lens is not None:
        reader.camera_model, reader.camera_params = lens.model_name, ",".join(map(repr, map(float, lens.params)))
    name_of = {photo: name for name, photo in numbered.items()}
    groups = group_by_camera(list(numbered.values()), shared=config.shared_camera)
    of_cameras = [[name_of[photo] for photo in group] for group in groups]
    pycolmap.Database.open(database).close()  # makes it
    for names in of_cameras:  # first, so that photos have the same numbers in every run, whichever thread ends first
        pycolmap.import_images(database, folder, pycolmap.CameraMode.SINGLE, names, reader)
    with pycolmap.Database.open(database) as opened:
        for name, photo in numbered.items():
            if opened.read_image_with_name(name) is None:
                raise InputError(f"{photo.name}: COLMAP cannot read this photo, expected JPEG or PNG")
    with tqdm(total=len(numbered), desc="features", unit="photo", disable=not progress) as bar:
        for names in of_cameras:
            for start in range(0, len(names), PHOTOS_AT_ONCE):
                some = names[start : start + PHOTOS_AT_ONCE]
                run_cancellable(
                    pycolmap.extract_features,
                    database,
                    folder,
                    image_names=some,
                    camera_mode=pycolmap.CameraMode.SINGLE,
                    reader_options=reader,
                    extraction_options=options,
                )
                bar.update(len(some))


def match_features(
    database: Path, names: Sequence[str], pairs: Sequence[tuple[int, int]], *, progress: bool = False
) -> None:
    """Match the features of pairs (i, j) of photos in the database, which have these names, and keep what fits one
    relative pose."""
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
                pycolmap.match_image_pairs,
                database,
                matching_options=matching,
                pairing_options=pairing,
                verification_options=verification,
            )
            bar.update(len(some))
