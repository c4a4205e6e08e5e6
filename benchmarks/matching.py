"""How well are regions matched? `python benchmarks/matching.py --cache ~/mvseg-cells [--split dev] [--methods ...]`

The 16 cells of the evaluation, {4, 8, 16, 32} leaves x {3, 5, 10, 20} views, on simulated plants: those of the preset
"paper-eval" (480 x 480, cameras on a 200 degree arc, exact poses). "true" masks are the visible parts of at least 30
pixels, "degraded" ones have the faults of a segmenter. Label maps are rendered once and kept in the cache folder. The
split "dev" is for choosing parameters, "test" for looking at once, at the end. `--ablate` leaves out one part of the
N-view matcher after another.
"""

from __future__ import annotations

import argparse
import json
import math
import multiprocessing
import os
import time
from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene

from mvseg.evaluation.id_metrics import matching_metrics
from mvseg.evaluation.truth import shown_instances
from mvseg.matching.affinity import Affinity, region_affinity
from mvseg.matching.nview.config import Gains, NViewConfig, RowCosts, Thresholds
from mvseg.matching.nview.match_nview import match_nview
from mvseg.matching.one_per_view import one_per_view_clusters
from mvseg.matching.symnmf import cluster_affinity
from mvseg.regions import Regions, regions_from_label_maps
from mvseg.scene import Cameras
from mvseg.simulation.dataset import PRESETS, SceneSpec, drop_small, list_scenes, scene_cameras
from mvseg.simulation.faults import Faults, degrade_labels
from mvseg.simulation.growth import Plant, grow_plant

MIN_PIXELS = 30
Maps = np.ndarray
Method = Callable[[Regions, Cameras, Affinity], torch.Tensor]


def symnmf_ids(regions: Regions, cameras: Cameras, affinity: Affinity) -> torch.Tensor:
    return cluster_affinity(affinity, regions.num_per_view).instance_ids


def one_per_view_ids(regions: Regions, cameras: Cameras, affinity: Affinity) -> torch.Tensor:
    return one_per_view_clusters(affinity, regions.view_index, len(cameras))


def nview_ids(
    regions: Regions, cameras: Cameras, affinity: Affinity, *, config: NViewConfig = NViewConfig()
) -> torch.Tensor:
    return match_nview(regions, cameras, affinity, config=config).instance_ids


METHODS: dict[str, Method] = {"symnmf": symnmf_ids, "one-per-view": one_per_view_ids, "nview": nview_ids}
ABLATIONS = {
    "no weights": NViewConfig(gains=Gains(weight=0, weight_few=0)),
    "no landing": NViewConfig(gains=Gains(landing=0)),
    "missed=absent": NViewConfig(costs=RowCosts(absent=RowCosts.missing)),
    "hidden is free": NViewConfig(costs=RowCosts(hidden=0)),
    "pieces alone": NViewConfig(thresholds=Thresholds(piece_landing=math.inf)),
    "few views kept": NViewConfig(thresholds=Thresholds(few_landing=math.inf)),
}
METHODS |= {name: partial(nview_ids, config=config) for name, config in ABLATIONS.items()}


def visible_ids(plant: Plant, cameras: Cameras) -> Maps:
    """(V, H, W) uint16 ids of the leaves, 0 elsewhere: one ray through each pixel's centre, and no light."""
    meshes = [(leaf.vertices, leaf.faces, leaf.leaf_id) for leaf in plant.leaves]
    meshes += [(part.vertices, part.faces, 0) for part in plant.parts]
    first = np.cumsum([0] + [len(vertices) for vertices, _, _ in meshes])
    faces = np.concatenate([f + start for (_, f, _), start in zip(meshes, first[:-1], strict=True)]).astype(np.int32)
    owner = np.repeat(np.array([i for _, _, i in meshes], np.uint16), [len(f) for _, f, _ in meshes])
    bvh = EmbreeScene(robust=True)
    TriangleMesh(bvh, np.concatenate([vertices for vertices, _, _ in meshes]).astype(np.float32), faces)
    maps = []
    for view, (width, height) in enumerate(cameras.sizes.tolist()):
        v, u = np.mgrid[:height, :width] + 0.5
        pixels = np.stack([u.ravel(), v.ravel(), np.ones(u.size)], 1)
        rays = (pixels @ cameras.world_from_px[view].numpy().T).astype(np.float32)
        face = bvh.run(np.tile(cameras.centers[view].numpy().astype(np.float32), (len(rays), 1)), rays)
        maps.append(np.where(face >= 0, owner[face], 0).reshape(height, width).astype(np.uint16))
    return np.stack([drop_small(ids, MIN_PIXELS) for ids in maps])


def load_maps(spec: SceneSpec, cache: Path) -> tuple[Maps, Maps, Cameras]:
    """True and degraded label maps, (V, H, W) each, and the cameras of a scene; rendered when not in the cache."""
    path = cache / "maps" / f"{spec.folder.replace('/', '_')}_{spec.seed}.npz"
    if not path.exists():
        plant = grow_plant(spec.family, spec.num_leaves, spec.seed)
        cameras = scene_cameras(spec, plant, PRESETS["paper-eval"])
        true = visible_ids(plant, cameras)
        seeds = np.random.SeedSequence([spec.seed, spec.num_views]).generate_state(len(true))
        degraded = [degrade_labels(ids, Faults(), seed=int(seed)) for ids, seed in zip(true, seeds, strict=True)]
        path.parent.mkdir(parents=True, exist_ok=True)
        unfinished = path.with_suffix(f".{os.getpid()}.npz")
        poses = {name: getattr(cameras, name).numpy() for name in ("K", "R", "t", "sizes")}
        np.savez_compressed(unfinished, true=true, degraded=np.stack(degraded), **poses)
        os.replace(unfinished, path)
    with np.load(path) as saved:
        cameras = Cameras(*(torch.from_numpy(saved[name]) for name in ("K", "R", "t", "sizes")))
        return saved["true"], saved["degraded"], cameras


def run_scene(spec: SceneSpec, cache: Path, methods: Iterable[str], masks: Iterable[str]) -> list[dict[str, Any]]:
    """One record per kind of masks and method."""
    torch.set_num_threads(1)
    true, degraded, cameras = load_maps(spec, cache)
    records = []
    for kind in masks:
        regions = regions_from_label_maps(list(true if kind == "true" else degraded))
        truth = shown_instances(regions, true, count_background=False)
        start = time.perf_counter()
        affinity = region_affinity(regions, cameras)
        weights_s = time.perf_counter() - start
        for method in methods:
            start = time.perf_counter()
            ids = METHODS[method](regions, cameras, affinity)
            seconds = time.perf_counter() - start + weights_s
            found = matching_metrics(ids, truth)
            record = {"ari": found.ari, "e_k": found.e_k, "s_match": found.s_match, "f1": found.pair_f1}
            cell = {"leaves": spec.num_leaves, "views": spec.num_views, "family": spec.family, "scene": spec.folder}
            records.append({"method": method, "masks": kind, **cell, "seconds": seconds, **record})
    return records


def print_tables(records: list[dict[str, Any]]) -> None:
    """Per method and kind of masks, averages over the cells, one row per measure."""
    keys = sorted({(r["masks"], r["method"]) for r in records}, reverse=True)
    columns = [("views", n) for n in (20, 10, 5, 3)] + [("leaves", n) for n in (32, 16, 8, 4)]
    print(f"{'masks':9}{'method':16}{'':8}" + "".join(f"{n:>6} {axis[0]}" for axis, n in columns) + "     all")
    for masks, method in keys:
        own = [r for r in records if r["masks"] == masks and r["method"] == method]
        for measure in ("ari", "e_k", "s_match", "f1", "seconds"):
            picks = [[r[measure] for r in own if r[axis] == n] for axis, n in columns] + [[r[measure] for r in own]]
            figures = "".join(f"{np.mean(pick):8.3f}" if pick else "       -" for pick in picks)
            print(f"{masks:9}{method:16}{measure:8}{figures}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cache", type=Path, required=True, help="folder for label maps and records")
    parser.add_argument("--split", choices=("dev", "test"), default="dev")
    parser.add_argument("--seed", type=int, default=0, help="of the plants; another one for plants never looked at")
    parser.add_argument("--methods", nargs="+", choices=list(METHODS), default=["symnmf", "one-per-view", "nview"])
    parser.add_argument("--ablate", action="store_true", help="nview whole, and without one of its parts at a time")
    parser.add_argument("--masks", nargs="+", choices=("true", "degraded"), default=("true", "degraded"))
    parser.add_argument("--leaves", nargs="+", type=int, default=(4, 8, 16, 32))
    parser.add_argument("--views", nargs="+", type=int, default=(3, 5, 10, 20))
    parser.add_argument("--plants", type=int, default=6, help="at most so many per number of leaves")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--json", type=Path, help="write the records here")
    args = parser.parse_args()
    scenes = [
        spec
        for spec in list_scenes(PRESETS["paper-eval"], args.seed)
        if spec.split == args.split and spec.num_leaves in args.leaves and spec.num_views in args.views
        if int(spec.folder.split("-")[1].split("_")[0]) < args.plants
    ]
    methods = ["one-per-view", "nview", *ABLATIONS] if args.ablate else args.methods
    work = partial(run_scene, cache=args.cache, methods=methods, masks=args.masks)
    with multiprocessing.get_context("spawn").Pool(args.workers) as pool:
        records = [record for found in pool.imap(work, scenes) for record in found]
    if args.json:
        args.json.write_text(json.dumps(records, indent=1), encoding="utf-8")
    print_tables(records)


if __name__ == "__main__":
    main()
