"""Simulated scenes on disk, as mvseg reads them, and whole data sets.

A scene folder holds

    cameras.json              rig: poses cam_from_world, pixel centres at half integers
    images/000.jpg            photos
    masks/000.png             uint16 labels, 0 = not a leaf; shuffled numbers, which mean nothing across views
    truth/000.png             the same pixels with the true leaf ids
    truth/leaves/leaf_001.ply one mesh per leaf
    truth/traits.csv          leaf_id, length, width, area in the scene's unit

and appears whole or not at all.
"""

from __future__ import annotations

import csv
import io
import json
import multiprocessing
import os
import shutil
import threading
from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass, fields
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import trimesh
from numpy.typing import NDArray
from pycocotools import mask as coco_mask
from tqdm import tqdm

from mvseg.errors import InputError
from mvseg.scene import Cameras
from mvseg.simulation.cameras import arc_cameras
from mvseg.simulation.growth import Plant, grow_plant
from mvseg.simulation.ray_cast import build_stage, render_stage

JPEG_QUALITY = 90


# --- one scene


def write_scene(folder: Path | str, plant: Plant, cameras: Cameras, *, seed: int, min_pixels: int = 30) -> None:
    """Photograph a plant and write the scene folder described at the top of this module.

    Args:
        folder: must not exist; its parent is made. A failure leaves nothing behind.
        plant: seen by the cameras in its own world units.
        cameras: V views of any sizes.
        seed: of light, materials, noise and of the numbers in `masks/`; the truth does not depend on it.
        min_pixels: a leaf with fewer visible pixels in a view is left out of that view's masks and truth.

    Raises:
        InputError: the folder exists.
    """
    folder = Path(folder)
    if folder.exists():
        raise InputError(f"{folder} exists already, expected a new folder for the scene")
    unfinished = folder.with_name(f".{folder.name}.unfinished")
    shutil.rmtree(unfinished, ignore_errors=True)  # of a process that was killed
    try:
        write_views(unfinished, plant, cameras, seed, min_pixels)
        write_truth(unfinished / "truth", plant)
        os.replace(unfinished, folder)
    except BaseException:
        shutil.rmtree(unfinished, ignore_errors=True)
        raise


def write_views(folder: Path, plant: Plant, cameras: Cameras, seed: int, min_pixels: int) -> None:
    """Write rig file, photos, masks and true label images."""
    for name in ("images", "masks", "truth"):
        (folder / name).mkdir(parents=True)
    stage = build_stage(plant, seed=seed)
    views: list[dict[str, Any]] = []
    for index in range(len(cameras)):
        K, R, t = (x[index].numpy() for x in (cameras.K, cameras.R, cameras.t))
        width, height = cameras.sizes[index].tolist()
        shot = render_stage(stage, K, R, t, width, height)
        truth = drop_small(shot.ids, min_pixels)
        name = f"{index:03d}"
        photo = cv2.cvtColor(shot.rgb, cv2.COLOR_RGB2BGR)
        write_image(folder / "images" / f"{name}.jpg", photo, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
        write_image(folder / "truth" / f"{name}.png", truth)
        write_image(folder / "masks" / f"{name}.png", shuffle_labels(truth, np.random.default_rng([seed, index])))
        rig = {"file": f"images/{name}.jpg", "width": width, "height": height}
        views.append({**rig, "K": K.tolist(), "R": R.tolist(), "t": t.tolist()})
    write_text(folder / "cameras.json", json.dumps({"format": "mvseg-rig/1", "unit": plant.unit, "views": views}))


def write_truth(folder: Path, plant: Plant) -> None:
    """Write the leaf meshes and the table of traits."""
    (folder / "leaves").mkdir()
    sizes = [(f"{leaf.length:.6f}", f"{leaf.width:.6f}", f"{leaf.area:.6f}") for leaf in plant.leaves]
    rows = [(leaf.leaf_id, *size) for leaf, size in zip(plant.leaves, sizes, strict=True)]
    write_table(folder / "traits.csv", ["leaf_id", "length", "width", "area"], rows)
    for leaf in plant.leaves:
        mesh = trimesh.Trimesh(leaf.vertices, leaf.faces, process=False)
        mesh.export(folder / "leaves" / f"leaf_{leaf.leaf_id:03d}.ply")


def drop_small(labels: NDArray[np.uint16], min_pixels: int) -> NDArray[np.uint16]:
    """(H, W) labels without those that cover fewer than `min_pixels` pixels."""
    return np.where(np.bincount(labels.ravel())[labels] >= min_pixels, labels, 0).astype(np.uint16)


def shuffle_labels(labels: NDArray[np.uint16], rng: np.random.Generator) -> NDArray[np.uint16]:
    """(H, W) the same regions, numbered from 1 in random order."""
    numbers, places = np.unique(labels, return_inverse=True)
    shuffled = np.zeros(len(numbers), np.uint16)
    shuffled[numbers > 0] = rng.permutation(np.count_nonzero(numbers)) + 1
    return shuffled[places.reshape(labels.shape)]


def write_image(path: Path, image: NDArray[Any], options: Iterable[int] = ()) -> None:
    """Write an image in the format of the suffix; OpenCV's own writer does not report a full disk."""
    path.write_bytes(cv2.imencode(path.suffix, image, list(options))[1].tobytes())


def write_text(path: Path, text: str) -> None:
    """Write a file whole or not at all."""
    unfinished = path.with_name(f".{path.name}.unfinished")
    unfinished.write_text(text, encoding="utf-8", newline="\n")
    os.replace(unfinished, path)


def write_table(path: Path, columns: list[str], rows: list[tuple[Any, ...]]) -> None:
    """Write a CSV file with a header, whole or not at all."""
    table = io.StringIO()
    csv.writer(table, lineterminator="\n").writerows([columns, *rows])
    write_text(path, table.getvalue())


# --- data sets


# Without "leggy", which is there to be learnt: so published figures stay comparable.
EVALUATED_FAMILIES = ("ovate", "lanceolate", "rosette", "strap", "lobed", "compound")


@dataclass(frozen=True)
class Preset:
    """What a data set consists of: for every split, number of leaves and number of views, that many plants.

    A plant is the same for every number of views, and different from every plant of another split.

    Attributes:
        plants: (split, plants per number of leaves) pairs.
        leaves, views: the numbers that are crossed with each other.
        size: image width and height in pixels.
        families: the plants of a cell have these in turn, each cell starting one further on.
        has_free_cameras: all around the plant, at any height and zoom, instead of the 200 degree arc.
        has_coco: write `<split>.json` with the leaves of all photos, category "leaf".
    """

    plants: tuple[tuple[str, int], ...]
    leaves: tuple[int, ...]
    views: tuple[int, ...]
    size: tuple[int, int] = (480, 480)
    families: tuple[str, ...] = EVALUATED_FAMILIES
    has_free_cameras: bool = False
    has_coco: bool = False


PRESETS = {
    "paper-eval": Preset(plants=(("dev", 3), ("test", 6)), leaves=(4, 8, 16, 32), views=(3, 5, 10, 20)),
    "train": Preset(
        plants=(("train", 70), ("val", 4)),
        leaves=(2, 4, 6, 8, 10, 12, 16, 20, 24, 32, 40, 48),
        views=(9,),
        families=EVALUATED_FAMILIES * 10 + ("leggy",) * 10,  # to learn that bare stems are no leaves
        has_free_cameras=True,
        has_coco=True,
    ),
}


@dataclass(frozen=True)
class SceneSpec:
    """One scene of a data set: its folder below the data set's, and all that it is made from."""

    folder: str
    split: str
    family: str
    num_leaves: int
    num_views: int
    seed: int


def list_scenes(preset: Preset, seed: int) -> list[SceneSpec]:
    """Every scene of the data set, in a fixed order."""
    scenes = []
    for split, num_plants in preset.plants:
        for cell, num_leaves in enumerate(preset.leaves):
            for index in range(num_plants):
                family = preset.families[(index + cell) % len(preset.families)]
                entropy = [seed, num_leaves, index, *split.encode()]
                own_seed = int(np.random.SeedSequence(entropy).generate_state(1)[0])
                for num_views in preset.views:
                    name = f"{split}/{family}-{index:03d}_leaves-{num_leaves:02d}_views-{num_views:02d}"
                    scenes.append(SceneSpec(name, split, family, num_leaves, num_views, own_seed))
    return scenes


def write_dataset(preset: Preset | str, folder: Path | str, *, seed: int = 0, num_workers: int = 1) -> None:
    """Write the scenes of a preset, their list `scenes.csv`, and COCO files where the preset asks for them.

    A finished scene is skipped, so the same call goes on after an interruption. The files do not depend on the number
    of workers.

    Args:
        preset: a key of `PRESETS` or a `Preset` of your own.
        folder: made when missing.
        seed: >= 0; other seeds give other plants.
        num_workers: processes, >= 1.

    Raises:
        InputError: an unknown preset, a number out of range, or a folder with a data set of another preset or seed.
    """
    if isinstance(preset, str):
        if preset not in PRESETS:
            raise InputError(f"unknown preset '{preset}', expected one of {', '.join(PRESETS)}")
        preset = PRESETS[preset]
    if num_workers < 1:
        raise InputError(f"{num_workers} workers asked for, expected at least 1")
    if seed < 0:
        raise InputError(f"the seed is {seed}, expected 0 or more")
    folder = Path(folder)
    if folder.is_dir() and any(folder.iterdir()) and not (folder / "dataset.json").is_file():
        raise InputError(f"{folder}: holds files that are no data set, expected a new or an empty folder")
    folder.mkdir(parents=True, exist_ok=True)
    recipe = json.dumps({"preset": asdict(preset), "seed": seed}, indent=1)
    made_from = folder / "dataset.json"
    if made_from.exists() and made_from.read_text(encoding="utf-8") != recipe:
        raise InputError(f"{folder} holds a data set of another preset or seed, expected an empty folder")
    write_text(made_from, recipe)
    scenes = list_scenes(preset, seed)
    work = partial(finish_scene, folder, preset)
    results = tqdm(run_all(work, scenes, num_workers), total=len(scenes), unit="scene", desc=str(folder))
    annotated = list(zip(scenes, results, strict=True))
    if preset.has_coco:
        for split, _ in preset.plants:
            photos = [photo for scene, found in annotated if scene.split == split for photo in found]
            write_text(folder / f"{split}.json", json.dumps(coco_document(photos)))
    columns = [field.name for field in fields(SceneSpec)]
    write_table(folder / "scenes.csv", columns, [tuple(asdict(scene).values()) for scene in scenes])


Photo = tuple[dict[str, Any], list[dict[str, Any]]]  # COCO image and its annotations, still without ids


def run_all(work: partial[list[Photo]], scenes: list[SceneSpec], num_workers: int) -> Iterator[list[Photo]]:
    """The results of `work` for each scene in order, from this process or from a pool."""
    if num_workers == 1:
        yield from map(work, scenes)
        return
    with multiprocessing.get_context("spawn").Pool(num_workers, start_worker) as pool:
        yield from pool.imap(work, scenes)


def start_worker() -> None:
    """Prepare a process of the pool: OpenCV on one thread, and an end as soon as the parent is gone.

    A worker that outlives a killed parent would go on with the scenes in its queue and get in the way of the next run.
    """
    cv2.setNumThreads(1)
    threading.Thread(target=end_with_parent, daemon=True).start()


def end_with_parent() -> None:
    """Wait until the parent process is gone, then end this one at once."""
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)


def finish_scene(dataset: Path, preset: Preset, scene: SceneSpec) -> list[Photo]:
    """Write a scene unless it is there, and read back its annotations when the preset wants them."""
    folder = dataset / scene.folder
    if not folder.exists():
        plant = grow_plant(scene.family, scene.num_leaves, scene.seed)
        write_scene(folder, plant, scene_cameras(scene, plant, preset), seed=scene.seed)
    return [read_photo(dataset, scene, index) for index in range(scene.num_views)] if preset.has_coco else []


def scene_cameras(scene: SceneSpec, plant: Plant, preset: Preset) -> Cameras:
    """The arc of the evaluation, or cameras all around, at heights and a zoom of the scene's own."""
    rng = np.random.default_rng([scene.seed, *b"cameras"])  # not the numbers that the look is drawn from
    width, height = preset.size
    start = rng.uniform(0, 360)
    if not preset.has_free_cameras:
        return arc_cameras(scene.num_views, plant, start_deg=start, width=width, height=height)
    heights = tuple(rng.uniform(5, 85, 5))
    cameras = arc_cameras(
        scene.num_views, plant, span_deg=360, start_deg=start, elevations_deg=heights, width=width, height=height
    )
    K = cameras.K.clone()
    K[:, :2, :2] *= rng.uniform(0.6, 1.5)
    return Cameras(K, cameras.R, cameras.t, cameras.sizes)


def read_photo(dataset: Path, scene: SceneSpec, index: int) -> Photo:
    """The COCO image and annotations of one view, with compressed RLE masks."""
    name = f"{scene.folder}/images/{index:03d}.jpg"
    packed = np.fromfile(dataset / scene.folder / "truth" / f"{index:03d}.png", np.uint8)
    labels = np.asarray(cv2.imdecode(packed, cv2.IMREAD_UNCHANGED))
    annotations = []
    for leaf_id in np.unique(labels[labels > 0]).tolist():
        rle = coco_mask.encode(np.asfortranarray(labels == leaf_id).astype(np.uint8))
        annotations.append(
            {
                "category_id": 1,
                "iscrowd": 0,
                "area": int(coco_mask.area(rle)),
                "bbox": coco_mask.toBbox(rle).tolist(),
                "segmentation": {"size": rle["size"], "counts": rle["counts"].decode("ascii")},
                "instance_id": leaf_id,
            }
        )
    return {"file_name": name, "width": labels.shape[1], "height": labels.shape[0]}, annotations


def coco_document(photos: list[Photo]) -> dict[str, Any]:
    """One COCO file of photos and their annotations, ids from 1 in order."""
    images: list[dict[str, Any]] = []
    annotations: list[dict[str, Any]] = []
    for image, found in photos:
        images.append({"id": len(images) + 1, **image})
        for annotation in found:
            annotations.append({"id": len(annotations) + 1, "image_id": len(images), **annotation})
    return {"images": images, "annotations": annotations, "categories": [{"id": 1, "name": "leaf"}]}
