"""Simulated data sets: many scenes of a preset, written in parallel, resumed after an interruption."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, fields, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from mvseg.errors import InputError
from mvseg.formats.coco import write_coco
from mvseg.formats.label_png import read_label_png
from mvseg.formats.run_lengths import encode_mask
from mvseg.formats.text_file import write_table
from mvseg.scene import Cameras
from mvseg.simulation.cameras import arc_cameras
from mvseg.simulation.growth import SimulatedPlant, grow_plant
from mvseg.simulation.scene_writer import write_scene
from mvseg.simulation.wild import make_wild
from mvseg.system.atomic import is_partial, lock_folder, sweep_folder, write_text_whole, write_whole
from mvseg.system.worker_pool import run_all

Photo = tuple[dict[str, Any], list[dict[str, Any]]]  # COCO image and its annotations, still without ids

# Without "leggy" and "fern", which are there for training only: published figures stay comparable.
EVALUATED_FAMILIES = ("ovate", "lanceolate", "rosette", "strap", "lobed", "compound")


@dataclass(frozen=True)
class Preset:
    """Plan of a data set: for every split, number of leaves and number of views, that many plants. A plant is the same
    for every number of views, and different from every plant of another split.

    Attributes:
        plants: (split, plants per number of leaves) pairs.
        leaves, views: the numbers that are crossed with each other.
        size: image width and height in pixels.
        families: the plants of a number of leaves take these in turn, each number starting one further on.
        has_free_cameras: cameras all around the plant, at any height and zoom, instead of the 200 degree arc.
        has_coco: write `<split>.json` with the leaves of all photos, category "leaf".
        is_wild: see `wild.make_wild`; cotyledons come on top of the number of leaves.
    """

    plants: tuple[tuple[str, int], ...]
    leaves: tuple[int, ...]
    views: tuple[int, ...]
    size: tuple[int, int] = (480, 480)
    families: tuple[str, ...] = EVALUATED_FAMILIES
    has_free_cameras: bool = False
    has_coco: bool = False
    is_wild: bool = False


TRAIN = Preset(
    plants=(("train", 70), ("val", 4)),
    leaves=(2, 4, 6, 8, 10, 12, 16, 20, 24, 32, 40, 48),
    views=(9,),
    families=EVALUATED_FAMILIES * 10 + ("leggy",) * 10,  # to learn that bare stems are not leaves
    has_free_cameras=True,
    has_coco=True,
)
WILD_PLANTS, WILD_FAMILIES = (("train", 8), ("val", 1)), (*EVALUATED_FAMILIES, "leggy")
PRESETS = {
    "paper-eval": Preset(plants=(("dev", 3), ("test", 6)), leaves=(4, 8, 16, 32), views=(3, 5, 10, 20)),
    "train": TRAIN,
    "wild": replace(TRAIN, plants=WILD_PLANTS, size=(512, 512), families=WILD_FAMILIES, is_wild=True),
}


@dataclass(frozen=True)
class SceneSpec:
    """One scene of a data set: its folder below the data set's, and everything that it is made from."""

    folder: str
    split: str
    family: str
    num_leaves: int
    num_views: int
    seed: int


def list_specs(preset: Preset, seed: int) -> list[SceneSpec]:
    """Every scene of the data set, in a fixed order."""
    scenes = []
    for split, num_plants in preset.plants:
        for cell, num_leaves in enumerate(preset.leaves):
            for index in range(num_plants):
                family = preset.families[(index + cell) % len(preset.families)]
                entropy = [seed, num_leaves, index, *split.encode()]
                plant_seed = int(np.random.SeedSequence(entropy).generate_state(1)[0])
                for num_views in preset.views:
                    name = f"{split}/{family}-{index:03d}_leaves-{num_leaves:02d}_views-{num_views:02d}"
                    scenes.append(SceneSpec(name, split, family, num_leaves, num_views, plant_seed))
    return scenes


def write_dataset(preset: Preset | str, folder: Path | str, *, seed: int = 0, num_workers: int = 1) -> None:
    """Write the scenes of a preset, their list `scenes.csv`, and COCO files where the preset asks for them.

    A finished scene is skipped, so the same call goes on after an interruption. The number of workers changes no file.
    Raises InputError: an unknown preset, a number out of range, a folder with a data set of another preset or seed, or
    one that another process is writing to.
    """
    if isinstance(preset, str):
        if preset not in PRESETS:
            raise InputError(f"unknown preset '{preset}', expected one of {', '.join(PRESETS)}")
        preset = PRESETS[preset]
    if num_workers < 1:  # before the folder is made
        raise InputError(f"num_workers is {num_workers}, expected at least 1")
    if seed < 0:
        raise InputError(f"the seed is {seed}, expected 0 or more")
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    with lock_folder(folder):
        claim_dataset(folder, recipe=json.dumps({"preset": asdict(preset), "seed": seed}, indent=1))
        scenes, work = list_specs(preset, seed), partial(finish_scene, folder, preset)
        results = tqdm(run_all(work, scenes, num_workers), total=len(scenes), unit="scene", desc=str(folder))
        annotated = list(zip(scenes, results, strict=True))
        for split, _ in preset.plants if preset.has_coco else ():
            photos = [photo for scene, of_scene in annotated if scene.split == split for photo in of_scene]
            write_annotations(folder / f"{split}.json", photos)
        columns = [field.name for field in fields(SceneSpec)]
        write_table(folder / "scenes.csv", columns, [tuple(asdict(scene).values()) for scene in scenes])


def claim_dataset(folder: Path, *, recipe: str) -> None:
    """Claim a folder that is empty or holds the same data set, and delete unfinished files of a killed run."""
    made_from = folder / "dataset.json"
    if not made_from.is_file() and not all(is_partial(path) for path in folder.iterdir()):
        raise InputError(f"{folder}: holds files that are not a data set, expected a new or empty folder")
    if made_from.exists() and made_from.read_text(encoding="utf-8") != recipe:
        raise InputError(f"{folder} holds a data set of another preset or seed, expected an empty folder")
    for each in (folder, *folder.glob("*/")):
        sweep_folder(each)
    write_text_whole(made_from, recipe)


def finish_scene(dataset: Path, preset: Preset, scene: SceneSpec) -> list[Photo]:
    """Write a scene unless it is there, and read its annotations back when the preset wants them."""
    folder = dataset / scene.folder
    if not folder.exists():
        plant = grow_plant(scene.family, scene.num_leaves, scene.seed)
        plant = make_wild(plant, scene.seed) if preset.is_wild else plant
        write_scene(folder, plant, scene_cameras(scene, plant, preset), seed=scene.seed)
    if not preset.has_coco:
        return []
    names = [f"{scene.folder}/images/{view:03d}.jpg" for view in range(scene.num_views)]
    return [annotate_photo(dataset, name, preset.size) for name in names]


def scene_cameras(scene: SceneSpec, plant: SimulatedPlant, preset: Preset) -> Cameras:
    """The arc of the evaluation, or cameras all around, at heights and with a zoom drawn for the scene."""
    rng = np.random.default_rng([scene.seed, *b"cameras"])  # not the numbers that the look is drawn from
    width, height = preset.size
    start = rng.uniform(0, 360)
    if not preset.has_free_cameras:
        return arc_cameras(scene.num_views, plant, start_deg=start, width=width, height=height)
    heights = tuple(rng.uniform(5, 85, 5))
    cameras = arc_cameras(scene.num_views, plant, span_deg=360, start_deg=start, elevations_deg=heights,
                          width=width, height=height)  # fmt: skip
    K = cameras.K.clone()
    K[:, :2, :2] *= rng.uniform(0.6, 1.5)
    return replace(cameras, K=K)


def annotate_photo(dataset: Path, name: str, size: tuple[int, int]) -> Photo:
    """The COCO image and annotations of a photo `<scene>/images/<view>.jpg` of width and height `size`."""
    photo = Path(name)
    truth = read_label_png(dataset / photo.parents[1] / "truth" / f"{photo.stem}.png", *size)
    leaf_ids = np.unique(truth[truth > 0]).tolist()
    annotations = [{"segmentation": encode_mask(truth == leaf_id), "instance_id": leaf_id} for leaf_id in leaf_ids]
    return {"file_name": name, "width": size[0], "height": size[1]}, annotations


def write_annotations(path: Path, photos: list[Photo]) -> None:
    """Write one COCO file of photos and their annotations, ids from 1 in order, whole or not at all."""
    numbered = list(enumerate(photos, start=1))
    images = [{"id": number, **image} for number, (image, _) in numbered]
    annotations = [{"image_id": number, **each} for number, (_, of_photo) in numbered for each in of_photo]
    write_whole(path, lambda partial_path: write_coco(partial_path, images, annotations, category="leaf"))
