"""Label maps of the simulated evaluation scenes, true and with a segmenter's faults; rendered once, then cached.

The 16 cells of the evaluation are {4, 8, 16, 32} leaves x {3, 5, 10, 20} views, on the simulated plants of the preset
"paper-eval" (480 x 480, cameras on a 200 degree arc, exact poses).
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import torch
from torch import Tensor

from benchmarks.faults import Faults, degrade_labels
from mvseg.detection.config import DetectConfig
from mvseg.detectors.zoo import load_detector
from mvseg.evaluation.truth import true_instances
from mvseg.formats.image_file import read_rgb
from mvseg.pipeline.mask_rcnn import MultiViewMaskRCNN
from mvseg.regions import Regions, regions_from_label_maps
from mvseg.scene import Cameras
from mvseg.simulation.dataset import PRESETS, SceneSpec, list_specs, scene_cameras
from mvseg.simulation.growth import SimulatedPlant, grow_plant
from mvseg.simulation.ray_cast import build_bvh, build_stage, merge_meshes, render_stage
from mvseg.simulation.scene_writer import drop_small, write_jpeg
from mvseg.system.atomic import write_whole

MIN_PIXELS = 30
KINDS = ("true", "degraded")


@dataclass(frozen=True, eq=False)
class LabelledScene:
    """One scene without photos.

    Attributes:
        true: (V, H, W) uint16, the leaf that each pixel shows, 0 = none.
        degraded: (V, H, W) uint16, the masks of a faulty segmenter; their numbers mean nothing across views.
        cameras: V cameras.
    """

    true: np.ndarray
    degraded: np.ndarray
    cameras: Cameras

    def masks(self, kind: str) -> tuple[Regions, Tensor]:
        """The D regions of one of `KINDS`, and (D,) int64, the leaf that each of them shows."""
        regions = regions_from_label_maps(list(self.true if kind == "true" else self.degraded))
        return regions, true_instances(regions, list(self.true), count_background=False)


def load_maps(spec: SceneSpec, cache: Path) -> LabelledScene:
    """A scene of the preset "paper-eval"; rendered when it is not in the cache."""

    def render() -> dict[str, np.ndarray]:
        scene = render_maps(spec)
        poses = {name: getattr(scene.cameras, name).numpy() for name in ("K", "R", "t", "sizes")}
        return {"true": scene.true, "degraded": scene.degraded, **poses}

    arrays = _load_arrays(cache / "maps", spec, render)
    cameras = Cameras(**{name: torch.from_numpy(arrays[name]) for name in ("K", "R", "t", "sizes")})
    return LabelledScene(arrays["true"], arrays["degraded"], cameras)


def _load_arrays(folder: Path, spec: SceneSpec, make: Callable[[], dict[str, np.ndarray]]) -> dict[str, np.ndarray]:
    """Load the arrays of a scene, and make them first if they are not there."""
    path = folder / f"{spec.folder.replace('/', '_')}_{spec.seed}.npz"
    if not path.exists():
        arrays = make()
        folder.mkdir(parents=True, exist_ok=True)

        def save(partial: Path) -> None:
            with partial.open("wb") as file:
                np.savez_compressed(file, allow_pickle=False, **arrays)

        write_whole(path, save)
    with np.load(path) as saved:
        return dict(saved)


def render_maps(spec: SceneSpec) -> LabelledScene:
    plant = grow_plant(spec.family, spec.num_leaves, spec.seed)
    cameras = scene_cameras(spec, plant, PRESETS["paper-eval"])
    true = visible_ids(plant, cameras)
    seeds = np.random.SeedSequence([spec.seed, spec.num_views]).generate_state(len(true))
    degraded = [degrade_labels(ids, Faults(), seed=int(seed)) for ids, seed in zip(true, seeds, strict=True)]
    return LabelledScene(true, np.stack(degraded), cameras)


def load_photos(spec: SceneSpec, cache: Path) -> np.ndarray:
    """(V, H, W, 3) uint8, the photos of a scene as `write_scene` writes them; rendered when not in the cache."""

    def render() -> dict[str, np.ndarray]:
        plant = grow_plant(spec.family, spec.num_leaves, spec.seed)
        cameras = scene_cameras(spec, plant, PRESETS["paper-eval"])
        stage = build_stage(plant, seed=spec.seed)
        photos = []
        with TemporaryDirectory() as folder:
            for view in range(len(cameras)):
                write_jpeg(Path(folder) / "photo.jpg", render_stage(stage, cameras, view).rgb)
                photos.append(read_rgb(Path(folder) / "photo.jpg"))
        return {"photos": np.stack(photos)}

    return _load_arrays(cache / "photos", spec, render)["photos"]


def load_detected(spec: SceneSpec, cache: Path) -> Regions:
    """What the shipped detector finds in a scene with exact poses, loop included; detected when not in the cache."""
    names = ("view_index", "boxes", "crops", "labels")

    def detect() -> dict[str, np.ndarray]:
        photos = [torch.from_numpy(photo).permute(2, 0, 1).float() / 255 for photo in load_photos(spec, cache)]
        model = MultiViewMaskRCNN(load_detector("leaf-lite", min_score=DetectConfig.min_score))
        regions = model.find_regions(photos, load_maps(spec, cache).cameras).masks.regions
        return {name: getattr(regions, name).numpy() for name in names}

    arrays = _load_arrays(cache / "detected", spec, detect)
    return Regions(**{name: torch.from_numpy(arrays[name]) for name in names}, num_views=spec.num_views)


def visible_ids(plant: SimulatedPlant, cameras: Cameras) -> np.ndarray:
    """(V, H, W) uint16 ids of the leaves, 0 elsewhere: one ray through each pixel's centre, and no light."""
    mesh = merge_meshes(plant)
    bvh = build_bvh(mesh)
    maps = []
    for view, (width, height) in enumerate(cameras.sizes.tolist()):
        v, u = np.mgrid[:height, :width] + 0.5
        pixels = np.stack([u.ravel(), v.ravel(), np.ones(u.size)], 1)
        rays = (pixels @ cameras.world_from_px[view].numpy().T).astype(np.float32)
        face = bvh.run(np.tile(cameras.centers[view].numpy().astype(np.float32), (len(rays), 1)), rays)
        maps.append(np.where(face >= 0, mesh.owner[face], 0).reshape(height, width).astype(np.uint16))
    return np.stack([drop_small(ids, MIN_PIXELS) for ids in maps])


def add_scene_options(parser: argparse.ArgumentParser) -> None:
    """The options that say which scenes to run on; see `chosen_scenes`."""
    parser.add_argument("--cache", type=Path, required=True, help="folder for rendered label maps")
    parser.add_argument("--split", choices=("dev", "test"), default="dev")
    parser.add_argument("--seed", type=int, default=0, help="of the plants; another one gives plants never seen before")
    preset = PRESETS["paper-eval"]
    parser.add_argument("--leaves", nargs="+", type=int, choices=preset.leaves, default=preset.leaves)
    parser.add_argument("--views", nargs="+", type=int, choices=preset.views, default=preset.views)
    parser.add_argument("--plants", type=int, default=6, help="at most this many per number of leaves")
    parser.add_argument("--workers", type=int, default=2, help="scenes at once")


def chosen_scenes(args: argparse.Namespace) -> list[SceneSpec]:
    """The scenes that the options of `add_scene_options` ask for."""
    return [
        spec
        for spec in list_specs(PRESETS["paper-eval"], args.seed)
        if spec.split == args.split and spec.num_leaves in args.leaves and spec.num_views in args.views
        if plant_index(spec) < args.plants
    ]


def plant_index(scene: SceneSpec) -> int:
    """Index of the plant of a scene among those of its split and number of leaves."""
    return int(scene.folder.split("-")[1].split("_")[0])
