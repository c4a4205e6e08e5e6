"""How good are areas, lengths and widths? `python -m benchmarks.traits --cache ~/mvseg-cells [--views 10] [--plants 6]`

Surfaces of simulated leaves against their meshes, by family, number of views and kind of masks ("true": the visible
parts; "degraded": with the faults of a segmenter; "detected": what the shipped detector finds in the photos; ids are
those of the leaves that the masks show); and areas by the code of the reason to doubt them. Plants of 8 leaves, 480 x
480, cameras on a 200 degree arc, as in the preset "paper-eval". Rows are median / 90th percentile of |error| over all
leaves, also those that the quality flag doubts; leaves without a surface are counted, not averaged. Width is the
simulator's without the teeth of the edge. "distance" is the symmetric mean distance of the two surfaces in % of the
length, "inside" the share of true areas, lengths and widths inside their 95 % intervals, "base" the share of oriented
leaves whose base is right, "CPU s" the processor seconds of `fit_surfaces` for each leaf.

`--real FOLDER` is a scene with true label images in `truth/`: every view is left out in turn, the surfaces of the
others are projected into it, and the mean IoU with the true masks is printed: with all that the surface covers, and
without the pixels that show other instances or are ignored.

`--areas FOLDER` is a plant on several dates with true label images in `truth/` and the true area of each leaf in
`areas.csv`: errors of areas, by what they were measured on and by `use`, and the share inside 95 % intervals.
"""

from __future__ import annotations

import argparse
import csv
import time
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
import trimesh
from scipy.spatial import cKDTree
from torch import Tensor

from benchmarks.choice import true_maps
from benchmarks.label_maps import KINDS, LabelledScene, load_maps, load_photos
from benchmarks.paper_tables.masks import find_masks
from mvseg.formats.scene_folder import load_scene
from mvseg.reconstruction.surface.fit_surfaces import fit_surfaces
from mvseg.reconstruction.surface.leaf_surface import LeafSurface
from mvseg.regions import Regions, regions_from_label_maps
from mvseg.simulation.blades import Leaf
from mvseg.simulation.dataset import EVALUATED_FAMILIES, Preset, SceneSpec, list_specs
from mvseg.simulation.families import FAMILIES
from mvseg.simulation.growth import grow_plant
from mvseg.system.worker_pool import run_all

MEASURES = ("area", "length", "width", "inclination", "distance")
NUM_LEAVES = 8


def run_scene(spec: SceneSpec, *, cache: Path, kinds: list[str]) -> list[dict[str, Any]]:
    """One record per kind of masks and leaf of a plant that at least one view shows."""
    torch.set_num_threads(1)
    scene = load_maps(spec, cache)
    plant = grow_plant(spec.family, spec.num_leaves, spec.seed)
    records = []
    for kind in kinds:
        regions, ids = scene.masks(kind) if kind in KINDS else detect_masks(spec, scene, cache)
        start = time.process_time()
        surfaces = fit_surfaces(regions, torch.where(ids > 0, ids, -1), scene.cameras)
        seconds = (time.process_time() - start) / max(len(surfaces), 1)
        cell = {"family": spec.family, "views": spec.num_views, "masks": kind, "scene": spec.folder}
        for leaf in plant.leaves:
            if leaf.leaf_id in surfaces:
                errors = compare(surfaces[leaf.leaf_id], leaf, FAMILIES[spec.family].teeth)
                records.append({**cell, "leaf": leaf.leaf_id, "seconds": seconds, **errors})
    return records


def detect_masks(spec: SceneSpec, scene: LabelledScene, cache: Path) -> tuple[Regions, Tensor]:
    """The D masks of the shipped detector, and (D,) the leaf that each of them shows, 0 = none."""
    photos = torch.from_numpy(load_photos(spec, cache)).permute(0, 3, 1, 2)
    found = find_masks((photo.float() / 255 for photo in photos), list(scene.true), detector="leaf-lite")
    return found.regions, found.true_ids


def compare(surface: LeafSurface, leaf: Leaf, teeth: float) -> dict[str, Any]:
    """Signed errors in %, degrees and % of the length; what the surface says of itself."""
    record: dict[str, Any] = {"exists": surface.exists, "reasons": [*surface.reasons]}
    if not surface.exists:
        return record
    truth = (leaf.area, leaf.length, leaf.width / (1 + teeth))
    for name, deviation, value in zip(("area", "length", "width"), surface.deviations, truth, strict=True):
        error = getattr(surface, name) - value
        record |= {name: 100 * error / value, f"{name}_inside": bool(abs(error) <= 1.96 * deviation)}
    mesh = trimesh.Trimesh(leaf.vertices, leaf.faces, process=False)
    record["inclination"] = tilt(surface.mesh()) - tilt(mesh)
    record["distance"] = 100 * surface_distance(surface.mesh(), mesh) / leaf.length
    record["oriented"] = surface.is_oriented
    ends = np.linalg.norm(surface.midrib[[0, -1]].numpy() - leaf.vertices[0], axis=1)
    record["base"] = bool(ends[0] < ends[1])
    return record


def tilt(mesh: trimesh.Trimesh) -> float:
    """Degrees between the mean normal of a blade and the vertical."""
    corners = mesh.vertices[mesh.faces]
    mean = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]).sum(0)
    return float(np.degrees(np.arccos(min(1.0, abs(mean[2]) / np.linalg.norm(mean)))))


def surface_distance(first: trimesh.Trimesh, second: trimesh.Trimesh) -> float:
    """Mean of the two mean distances from points of one surface to the other, by dense samples."""
    distances = []
    for here, there in ((first, second), (second, first)):
        few, _ = trimesh.sample.sample_surface(here, 2000, seed=0)
        many, _ = trimesh.sample.sample_surface(there, 40_000, seed=1)
        distances.append(cKDTree(many).query(few)[0].mean())
    return float(np.mean(distances))


def print_table(records: list[dict[str, Any]]) -> None:
    """One row per kind of masks, number of views and family; the last of each group is over all but the straps."""
    columns = "".join(f"{name:>16}" for name in MEASURES)
    print(f"{'masks':10}views {'family':16}   n none{columns} flagged inside  base CPU s")
    for kind, views in sorted({(r["masks"], r["views"]) for r in records}, key=lambda key: (key[0] != "true", key[1])):
        group = [r for r in records if r["masks"] == kind and r["views"] == views]
        for family in [*sorted({r["family"] for r in group}), "all but strap"]:
            rows = [r for r in group if r["family"] == family or (family == "all but strap" and r["family"] != "strap")]
            fitted = [r for r in rows if r["exists"]]
            if not fitted:
                continue
            cells = ""
            for name in MEASURES:
                errors = np.abs([r[name] for r in fitted])
                cells += f"{np.median(errors):9.2f} /{np.quantile(errors, 0.9):5.1f}"
            inside = np.mean([[r[f"{name}_inside"] for name in ("area", "length", "width")] for r in fitted])
            oriented = [r["base"] for r in fitted if r["oriented"]]
            base = f"{np.mean(oriented):6.2f}" if oriented else "     -"
            flagged = np.mean([bool(r["reasons"]) for r in rows])
            seconds = np.mean([r["seconds"] for r in rows])
            print(
                f"{kind:10}{views:5} {family:16}{len(fitted):4}{len(rows) - len(fitted):5}{cells}"
                f"{flagged:8.2f}{inside:7.2f}{base}{seconds:6.2f}"
            )


def print_doubts(records: list[dict[str, Any]]) -> None:
    """Errors of areas of leaves with no reason to doubt them, and with one."""
    print(f"{'masks':10}{'doubt':16}   n{'area':>16}  inside")
    for kind in sorted({r["masks"] for r in records}):
        fitted = [r for r in records if r["masks"] == kind and r["exists"]]
        for code in sorted({"; ".join(r["reasons"]) for r in fitted if len(r["reasons"]) < 2} | {"several"}):
            rows = [r for r in fitted if (";".join(r["reasons"]) if len(r["reasons"]) < 2 else "several") == code]
            if rows:
                errors, inside = np.abs([r["area"] for r in rows]), np.mean([r["area_inside"] for r in rows])
                area = f"{np.median(errors):9.2f} /{np.quantile(errors, 0.9):5.1f}"
                print(f"{kind:10}{code or 'none':16}{len(rows):4}{area}{inside:8.2f}")


def leave_one_out(folder: Path) -> None:
    """IoU of surfaces with the masks of a view that they were not fitted to."""
    torch.set_num_threads(1)
    scene = load_scene(folder)
    maps = true_maps(folder, scene)
    regions = regions_from_label_maps(maps)
    records = []
    for view, labels in enumerate(maps):
        others = regions.select(regions.view_index != view)
        surfaces = fit_surfaces(others, others.labels, scene.cameras)
        for instance in regions.labels[regions.view_index == view].tolist():
            if instance not in surfaces or not surfaces[instance].exists:
                continue
            seen = surfaces[instance].project(scene.cameras[[view]])[0].numpy()
            mask = labels == instance
            free = mask | (labels == 0)
            records.append([(part & mask).sum() / max((part | mask).sum(), 1) for part in (seen, seen & free)])
    for name, ious in zip(("all that is covered", "without other instances"), np.array(records).T, strict=True):
        print(f"{folder.name}: leave one view out, IoU {name}: {ious.mean():.3f}, {len(ious)} masks")


def measure_areas(folder: Path) -> None:
    """Errors of the areas of one plant on several dates, with true ids."""
    torch.set_num_threads(1)
    with (folder / "areas.csv").open(encoding="utf-8") as file:
        true = {(row["date"], int(row["leaf"])): float(row["mesh_mm2"]) for row in csv.DictReader(file)}
        file.seek(0)
        meter = {(row["date"], int(row["leaf"])): row["meter_mm2"] for row in csv.DictReader(file)}
    rows, metered = dict[str, list[tuple[float, bool]]](), list[tuple[float, float]]()
    for date in sorted({date for date, _ in true}):
        scene = load_scene(folder / date)
        regions = regions_from_label_maps(true_maps(folder / date, scene))
        for leaf, surface in fit_surfaces(regions, regions.labels, scene.cameras).items():
            error, reasons = surface.area - true[date, leaf], surface.reasons
            use = "look" if reasons or not surface.is_credible else "yes"
            form = "occupancy" if surface.occupancy is not None else "whole sheet"
            errors = 100 * abs(error) / true[date, leaf], abs(error) <= 1.96 * surface.deviations[0]
            metered += [(surface.area, float(meter[date, leaf]))] if meter[date, leaf] else []
            for name in ("all", form, f"use {use}"):
                rows.setdefault(name, []).append(errors)
    for name, pairs in rows.items():
        percent, inside = np.array(pairs).T
        spread = "{:.1f} / {:.1f} %".format(*np.quantile(percent, (0.5, 0.9)))
        print(f"{name:12}{len(pairs):4} {spread}, {(percent <= 20).mean():.2f} within 20 %, {inside.mean():.2f} inside")
    ours, theirs = np.array(metered).reshape(-1, 2).T
    agreement = np.corrcoef(ours, theirs)[0, 1] ** 2, np.median(ours / theirs)
    print("against a meter: {} leaves, R2 {:.2f}, median ratio {:.2f}".format(len(ours), *agreement))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cache", type=Path, help="folder for label maps")
    parser.add_argument("--split", choices=("dev", "test"), default="dev")
    parser.add_argument("--seed", type=int, default=0, help="of the plants; another one for plants never looked at")
    parser.add_argument("--families", nargs="+", choices=[*FAMILIES], default=EVALUATED_FAMILIES)
    parser.add_argument("--views", nargs="+", type=int, default=(5, 10, 20))
    parser.add_argument("--masks", nargs="+", choices=(*KINDS, "detected"), default=KINDS)
    parser.add_argument("--plants", type=int, default=1, help="per family")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--real", type=Path, help="leave-one-view-out IoU on this scene folder, and nothing else")
    parser.add_argument("--areas", type=Path, help="errors of the areas of this plant, and nothing else")
    args = parser.parse_args()
    if args.areas:
        measure_areas(args.areas)
        return
    if args.real:
        leave_one_out(args.real)
        return
    if args.cache is None:
        parser.error("expected --cache DIR, --real FOLDER or --areas FOLDER")
    families = (*EVALUATED_FAMILIES, *(each for each in args.families if each not in EVALUATED_FAMILIES))
    plants = ((args.split, args.plants * len(families)),)
    preset = Preset(plants=plants, leaves=(NUM_LEAVES,), views=tuple(args.views), families=families)
    scenes = [spec for spec in list_specs(preset, args.seed) if spec.family in args.families]
    work = partial(run_scene, cache=args.cache, kinds=args.masks)
    records = [record for found in run_all(work, scenes, num_workers=args.workers) for record in found]
    print_table(records)
    print_doubts(records)


if __name__ == "__main__":
    main()
