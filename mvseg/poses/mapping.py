"""Structure from motion: matched features become cameras and points (COLMAP's incremental mapping).

COLMAP's global mapping is no quicker here, and where photos share few features it places all of them, wrongly.
"""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import pycolmap

from mvseg.errors import InputError
from mvseg.formats.colmap import read_colmap
from mvseg.formats.opencv_yaml import Calibration
from mvseg.formats.rig import write_rig
from mvseg.poses.cancellable import run_cancellable
from mvseg.poses.config import PoseConfig
from mvseg.poses.features import extract_features, find_features, make_database, match_features, number_photos
from mvseg.poses.numbers import STRUCTURE
from mvseg.poses.pairs import Pair, choose_pairs, pairs_with
from mvseg.poses.photo_files import PhotoFile, calibrated_size
from mvseg.scene import Scene
from mvseg.system.running import progress_bar

PHOTOS = "photos"  # folder of the photos that COLMAP sees
IMAGES, MODEL = "images", "sparse/0"  # of a scene folder
NEXT_STEPS = (
    "more photos with more overlap (every 5 to 10 degrees), sharper and brighter ones, a textured background or table "
    "(newspaper) that stays with the plant, or a turntable calibrated from a board"
)


@dataclass(frozen=True, eq=False)
class Structure:
    """Result of structure from motion, up to a similarity.

    Attributes:
        model: COLMAP's reconstruction of the registered photos; images have the names of the photos.
        registered: names of the photos with a pose, in the order of all photos; `left_out` are the others.
        other_models: number of further photos in each of the other models, which have frames of their own.
    """

    model: pycolmap.Reconstruction
    registered: tuple[str, ...]
    left_out: tuple[str, ...]
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
) -> Structure:
    """Estimate the cameras of photos, and 3D points, from the photos alone. Equal photos give equal cameras, bit by
    bit, on one machine and with one version of pycolmap: random draws have fixed seeds, and the mapping runs on one
    thread. Other processors round differently.

    Args:
        photos: in the order in which they were taken.
        calibration: camera of all photos, which then stays as it is.
        work: folder on whose disk COLMAP keeps its database meanwhile (default: the system's for temporary files).

    Raises:
        InputError: too few photos register (the message says how many, and what to do), COLMAP cannot read a photo, or
            photos of different sizes are to share a camera.
    """
    lens = None if calibration is None else _fixed_lens(calibration, photos)
    if lens is not None:
        config = replace(config, shared_camera=True)
    with tempfile.TemporaryDirectory(dir=work, prefix="colmap-") as folder:
        task = _Task(Path(folder), number_photos(images, photos, Path(folder) / PHOTOS), config, lens)
        models, pairs, plain = _map_quickly(task)
        if not models or models[0].num_reg_images() < STRUCTURE.enough * len(photos):
            models = _sorted([*models, *_map_thoroughly(task, pairs)])
    found = models[0].num_reg_images() if models else 0
    least = config.min_registered or max(STRUCTURE.least, round(STRUCTURE.least_share * len(photos)))
    if found < min(least, len(photos)):
        raise InputError(_too_few(found, len(photos), least, plain=plain, given=config.min_registered is not None))
    model = models[0]
    for image in list(model.images.values()):
        image.name = task.photo_of[image.name].name
    registered = {image.name for image in model.images.values() if image.has_pose}
    numbers = [set(each.reg_image_ids()) for each in models]
    counts = [len(each.difference(*numbers[:place])) for place, each in enumerate(numbers)]  # in none before it
    taken = tuple(photo.name for photo in photos if photo.name in registered)
    left_out = tuple(photo.name for photo in photos if photo.name not in registered)
    others = tuple(count for count in counts[1:] if count)
    return Structure(model=model, registered=taken, left_out=left_out, other_models=others)


@dataclass(frozen=True, eq=False)
class _Task:
    """Data of all attempts: `work` holds databases, and below PHOTOS the photos under the names of `photo_of`."""

    work: Path
    photo_of: Mapping[str, PhotoFile]
    config: PoseConfig
    lens: pycolmap.Camera | None


def _map_quickly(task: _Task) -> tuple[list[pycolmap.Reconstruction], list[Pair], tuple[str, ...]]:
    """Models from few features of chosen pairs, the largest first; the pairs; and photos with hardly any texture."""
    database, names, images = task.work / "quick.db", list(task.photo_of), task.work / PHOTOS
    make_database(database, images, task.photo_of, config=task.config, lens=task.lens)
    alike = find_features(database, images, names, image_size=task.config.image_size)
    with pycolmap.Database.open(database) as opened:
        counts = {image.name: opened.num_keypoints_for_image(image.image_id) for image in opened.read_all_images()}
    plain = tuple(photo.name for name, photo in task.photo_of.items() if counts[name] < STRUCTURE.few_features)
    pairs = choose_pairs([photo.name for photo in task.photo_of.values()], task.config.pairs, alike=alike)
    match_features(database, names, pairs)
    models = _map(task, database, few_matches=False)
    if not _is_whole(models, task):
        found = {image.name for image in models[0].images.values() if image.has_pose} if models else set()
        lost = [index for index, name in enumerate(names) if name not in found]
        more = [] if task.config.pairs else sorted({*pairs_with(lost, len(names))} - {*pairs})
        match_features(database, names, more)
        pairs = sorted([*pairs, *more])
        models = _sorted([*models, *_map(task, database, few_matches=True)])
    return models, pairs, plain


def _map_thoroughly(task: _Task, pairs: Sequence[Pair]) -> list[pycolmap.Reconstruction]:
    database, images = task.work / "thorough.db", task.work / PHOTOS
    make_database(database, images, task.photo_of, config=task.config, lens=task.lens)
    extract_features(database, images, task.photo_of, config=task.config, lens=task.lens)
    match_features(database, list(task.photo_of), pairs)
    models = _map(task, database, few_matches=False)  # strict first: it is right where it succeeds
    return models if _is_whole(models, task) else [*models, *_map(task, database, few_matches=True)]


def _sorted(models: Sequence[pycolmap.Reconstruction]) -> list[pycolmap.Reconstruction]:
    return sorted(models, key=lambda model: -model.num_reg_images())


def _is_whole(models: Sequence[pycolmap.Reconstruction], task: _Task) -> bool:
    return bool(models) and models[0].num_reg_images() == len(task.photo_of)


def _mapping_options(*, fix_lens: bool, few_matches: bool) -> pycolmap.IncrementalPipelineOptions:
    """COLMAP's own, on one thread; `few_matches`, for plants in photos 30 degrees apart, asks less of a photo."""
    least, seed = STRUCTURE.least, STRUCTURE.seed
    options = pycolmap.IncrementalPipelineOptions(num_threads=1, random_seed=seed, min_model_size=least)
    mapper = options.mapper
    mapper.num_threads = 1
    mapper.random_seed = options.triangulation.random_seed = seed
    if fix_lens:
        options.ba_refine_focal_length = options.ba_refine_extra_params = False
        mapper.abs_pose_refine_focal_length = mapper.abs_pose_refine_extra_params = False
    if few_matches:
        mapper.init_min_num_inliers, mapper.init_min_tri_angle = 40, 8.0
        mapper.abs_pose_min_num_inliers = 12
    return options


def _map(task: _Task, database: Path, *, few_matches: bool) -> list[pycolmap.Reconstruction]:
    num_photos = len(task.photo_of)
    with progress_bar(total=num_photos, name="mapping", unit="photo") as bar:

        def count(photos: int) -> None:  # attempts that fail count as well: at most to the end of the bar
            bar.update(min(photos, num_photos - bar.n))

        options = _mapping_options(fix_lens=task.lens is not None, few_matches=few_matches)
        told = {"initial_image_pair_callback": lambda: count(2), "next_image_callback": lambda: count(1)}
        places = database, task.work / PHOTOS, task.work
        models = run_cancellable(pycolmap.incremental_mapping, *places, options, **told)
    return _sorted(list(models.values()))


def _too_few(count: int, num_photos: int, least: int, *, plain: Sequence[str], given: bool) -> str:
    poor = f"; {len(plain)} have hardly any texture, the first is {plain[0]}" if plain else ""
    asked = "--min_registered asks for" if given else "expected at least"
    less = "" if given or count < STRUCTURE.least else f", or --min_registered {count} to accept these"
    return f"{count} of {num_photos} photos could be registered, {asked} {least}{poor}. Next: {NEXT_STEPS}{less}"


def _fixed_lens(calibration: Calibration, photos: Sequence[PhotoFile]) -> pycolmap.Camera:
    size = calibrated_size(calibration, photos)
    if calibration.is_fisheye:
        raise InputError("the calibration is of a fisheye, expected one with k1, k2, p1, p2 (, k3)")
    K = calibration.K
    pinhole = {"model": "PINHOLE", "params": [K[0, 0], K[1, 1], K[0, 2], K[1, 2]]}
    return calibration.lens(*size) or pycolmap.Camera(width=size[0], height=size[1], **pinhole)


# --- files of a scene


def write_structure(structure: Structure, folder: Path) -> Scene:
    """Write the COLMAP model of a scene folder, take away the photos that have no pose, and read it as a scene."""
    for name in structure.left_out:
        (folder / IMAGES / name).unlink(missing_ok=True)
    model = folder / MODEL
    model.mkdir(parents=True, exist_ok=True)
    structure.model.write_binary(model)
    return read_colmap(model, folder)


def move_structure(structure: Structure, similarity: pycolmap.Sim3d, folder: Path) -> Scene:
    """Write and read the scene again with its world moved by a similarity."""
    structure.model.transform(similarity)
    return write_structure(structure, folder)


def write_cameras(scene: Scene, folder: Path) -> None:
    """Write the rig file of a scene folder: what the COLMAP model says, with unit and up."""
    write_rig(folder / "cameras.json", scene, [view.path.relative_to(folder).as_posix() for view in scene.views])
