"""Structure from motion: matched features become cameras and points (COLMAP's incremental mapping)."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import pycolmap
from tqdm import tqdm

from mvseg.errors import InputError
from mvseg.formats.opencv_yaml import Calibration
from mvseg.poses.cancellable import run_cancellable
from mvseg.poses.config import LEAST, LEAST_SHARE, PoseConfig
from mvseg.poses.features import SEED, choose_pairs, extract_features, match_features, number_photos
from mvseg.poses.photo_files import PhotoFile

FEW_FEATURES = 300  # of a photo, below which it has too little texture
NEXT_STEPS = (
    "more photos with more overlap (every 5 to 10 degrees), sharper and brighter ones, a textured background or table "
    "(newspaper) that stays with the plant, or a turntable calibrated from a board"
)


@dataclass(frozen=True, eq=False)
class Structure:
    """What structure from motion found, up to a similarity.

    Attributes:
        model: COLMAP's reconstruction of the registered photos; images have the names of the photos.
        registered: names of the photos with a pose, in the order of all photos.
        left_out: names of the others.
        plain: of all photos, names of those with so few features that nothing could register them.
        other_models: number of further photos in each of the other models, which have frames of their own.
    """

    model: pycolmap.Reconstruction
    registered: tuple[str, ...]
    left_out: tuple[str, ...]
    plain: tuple[str, ...]
    other_models: tuple[int, ...]

    @property
    def residual_px(self) -> float:
        """Mean reprojection error of the points, pixels of the photos."""
        return float(self.model.compute_mean_reprojection_error())


def find_structure(
    images: Path,
    photos: Sequence[PhotoFile],
    *,
    config: PoseConfig,
    calibration: Calibration | None = None,
    work: Path | None = None,
    progress: bool = False,
) -> Structure:
    """Estimate the cameras of photos, and 3D points, from the photos alone.

    Equal photos give equal cameras, bit by bit, on one machine and with one version of pycolmap: random draws have
    fixed seeds, and the mapping runs on one thread. Other processors round differently.

    Args:
        images: folder of the photos.
        photos: in the order in which they were taken.
        config: see `PoseConfig`.
        calibration: camera of all photos, which then stays as it is.
        work: folder on whose disk COLMAP keeps its database meanwhile (default: the system's for temporary files).
        progress: show progress bars.

    Raises:
        InputError: too few photos register (the message says how many, and what to do), COLMAP cannot read a photo, or
            photos of different sizes are to share a camera.
    """
    lens = None if calibration is None else _fixed_lens(calibration, photos)
    if lens is not None:
        config = replace(config, shared_camera=True)
    models: list[pycolmap.Reconstruction] = []
    with tempfile.TemporaryDirectory(dir=work, prefix="colmap-") as folder:
        database, numbered = Path(folder) / "features.db", Path(folder) / "photos"
        photo_of = number_photos(images, photos, numbered)
        extract_features(database, numbered, photo_of, config=config, lens=lens, progress=progress)
        plain = _photos_with_few_features(database, photo_of)
        pairs = choose_pairs([photo.name for photo in photos], config.pairs)
        match_features(database, list(photo_of), pairs, progress=progress)
        for few in (False, True):  # strict first: it is right where it succeeds
            options = _mapping_options(fix_lens=lens is not None, few_matches=few)
            models = [*models, *_map(database, numbered, options, num_photos=len(photos), progress=progress)]
            models.sort(key=lambda model: -model.num_reg_images())
            if models and models[0].num_reg_images() == len(photos):
                break
    found = models[0].num_reg_images() if models else 0
    least = config.min_registered or max(LEAST, round(LEAST_SHARE * len(photos)))
    if found < min(least, len(photos)):
        raise InputError(_too_few(found, len(photos), least, plain=plain, given=config.min_registered is not None))
    model = models[0]
    for image in list(model.images.values()):
        image.name = photo_of[image.name].name
    registered = {image.name for image in model.images.values() if image.has_pose}
    known: set[int] = set()
    counts = []  # of the photos of each model that none before it holds
    for each in models:
        counts.append(len(set(each.reg_image_ids()) - known))
        known |= set(each.reg_image_ids())
    return Structure(
        model=model,
        registered=tuple(photo.name for photo in photos if photo.name in registered),
        left_out=tuple(photo.name for photo in photos if photo.name not in registered),
        plain=plain,
        other_models=tuple(count for count in counts[1:] if count),
    )


def _mapping_options(*, fix_lens: bool, few_matches: bool) -> pycolmap.IncrementalPipelineOptions:
    """COLMAP's own, on one thread. With `few_matches` a photo needs less to register: plants that fill photos taken 30
    degrees apart share few features."""
    options = pycolmap.IncrementalPipelineOptions(num_threads=1, random_seed=SEED, min_model_size=LEAST)
    mapper = options.mapper
    mapper.num_threads = 1
    mapper.random_seed = options.triangulation.random_seed = SEED
    if fix_lens:
        options.ba_refine_focal_length = options.ba_refine_extra_params = False
        mapper.abs_pose_refine_focal_length = mapper.abs_pose_refine_extra_params = False
    if few_matches:
        mapper.init_min_num_inliers, mapper.init_min_tri_angle = 40, 8.0
        mapper.abs_pose_min_num_inliers = 12
    return options


def _map(
    database: Path, folder: Path, options: pycolmap.IncrementalPipelineOptions, *, num_photos: int, progress: bool
) -> list[pycolmap.Reconstruction]:
    """All models, each in a frame of its own."""
    with tqdm(total=num_photos, desc="mapping", unit="photo", disable=not progress) as bar:

        def count(photos: int) -> None:  # attempts that fail count as well: at most to the end of the bar
            bar.update(min(photos, num_photos - bar.n))

        models = run_cancellable(
            pycolmap.incremental_mapping,
            database,
            folder,
            database.parent,
            options,
            initial_image_pair_callback=lambda: count(2),
            next_image_callback=lambda: count(1),
        )
    return list(models.values())


def _photos_with_few_features(database: Path, photo_of: Mapping[str, PhotoFile]) -> tuple[str, ...]:
    with pycolmap.Database.open(database) as opened:
        counts = {image.name: opened.num_keypoints_for_image(image.image_id) for image in opened.read_all_images()}
    return tuple(photo.name for name, photo in photo_of.items() if counts[name] < FEW_FEATURES)


def _too_few(found: int, num_photos: int, least: int, *, plain: Sequence[str], given: bool) -> str:
    """The sentence for too few registered photos."""
    poor = f"; {len(plain)} have hardly any texture, the first is {plain[0]}" if plain else ""
    asked = "--min_registered asks for" if given else "expected at least"
    less = "" if given or found < LEAST else f", or --min_registered {found} to accept these"
    text = f"{found} of {num_photos} photos could be registered, {asked} {least}{poor}"
    return f"{text}. Next: {NEXT_STEPS}{less}"


def _fixed_lens(calibration: Calibration, photos: Sequence[PhotoFile]) -> pycolmap.Camera:
    """The calibrated camera of all photos."""
    size = (calibration.width or photos[0].width, calibration.height or photos[0].height)
    other = next((photo for photo in photos if photo.size != size), None)
    if other is not None:
        given = f"the calibration is of {size[0]} x {size[1]} pixels"
        raise InputError(f"{other.name}: {given}, the photo has {other.width} x {other.height}")
    if calibration.is_fisheye:
        raise InputError("the calibration is of a fisheye, expected one with k1, k2, p1, p2 (, k3)")
    K = calibration.K
    pinhole = {"model": "PINHOLE", "params": [K[0, 0], K[1, 1], K[0, 2], K[1, 2]]}
    return calibration.lens(*size) or pycolmap.Camera(width=size[0], height=size[1], **pinhole)
