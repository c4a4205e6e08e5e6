"""How good are nodes? `python -m benchmarks.stems --cache ~/mvseg-cells [--plants 6] [--real FOLDER...]`

Simulated plants of 8 leaves with true ids, 480 x 480, 10 views on a 200 degree arc. Masks are exact, or have the faults
of a segmenter (`faults.py`); no photos are used. By family and kind of masks: plants whose leaves agree about a stem;
leaves with a node, of all; median / 90th percentile of the error of node heights in % of the plant's height, above its
lowest node that was found, and of divergence angles in degrees, in the true order; shares inside 95 % intervals, of
heights and azimuths; pairs of neighbours in the right order; plants whose phyllotaxis is right; processor time in that
of the surfaces.

`--up` asks the stem which way is up, where only the photos say roughly so: plants that answer, median / 90th percentile
and root mean square of degrees to the true up, and the share of leans to two sides inside 95 % intervals.

`--real` is for scenes whose label images in `truth/` number the leaves from below: leaves with a node, of all; pairs of
leaves of one stem in the right order, of all such pairs; quartiles of divergence angles; source and probability of each
stem, its phyllotaxis, and where `organs/` exists (1 = stem, 3 = leaf) the share of its axis on stem pixels, of what no
leaf hides. Holes of masks are closed there: such scenes are rendered from points.
"""

from __future__ import annotations

import argparse
import itertools
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy import ndimage
from torch import Tensor

from benchmarks.choice import true_maps
from benchmarks.label_maps import KINDS, load_maps
from mvseg.arrays import Floats, Ints
from mvseg.formats.photos import Photos
from mvseg.formats.scene_folder import load_scene
from mvseg.masks import Masks
from mvseg.reconstruction.stem.leaf_bases import axes_of_bases
from mvseg.reconstruction.surface.fit_surfaces import fit_surfaces
from mvseg.reconstruction.surface.leaf_surface import LeafSurface
from mvseg.regions import IGNORE_LABEL, Regions, regions_from_label_maps
from mvseg.scene import Cameras
from mvseg.simulation.dataset import SceneSpec
from mvseg.simulation.growth import grow_plant
from mvseg.traits.measure import TILT_DEG
from mvseg.traits.nodes import Stem, measure_stem
from mvseg.traits.stems import UP_LEAVES, find_stems, find_upward, up_of_stem
from mvseg.traits.up import level_frame

NUM_LEAVES, NUM_VIEWS = 8, 10
PHYLLOTAXIS = {
    "ovate": "decussate", "lanceolate": "spiral", "lobed": "spiral", "strap": "distichous", "leggy": "decussate"
}  # fmt: skip
UP = np.array([0.0, 0.0, 1.0])
STEM, LEAF = 1, 3  # in label images of organs
HOLE_PX = 4  # half of the widest gap that is closed


def fit_blades(regions: Regions, ids: Tensor, cameras: Cameras) -> dict[int, LeafSurface]:
    """Credible surfaces of masks with true ids."""
    surfaces = fit_surfaces(regions, torch.where(ids > 0, ids, -1), cameras)
    return {leaf: surface for leaf, surface in surfaces.items() if surface.is_credible}


def stems_of_bases(blades: dict[int, LeafSurface], upward: Floats | None, frame: Floats | None) -> list[Stem]:
    least = UP_LEAVES * len(blades)
    return [
        measure_stem(each.axis, each.bases, frame=frame, source="leaf bases", tells_up=len(each.bases) >= least)
        for each in axes_of_bases(blades, upward)
    ]


def list_plants(family: str, num_plants: int) -> list[SceneSpec]:
    seeds = range(1, num_plants + 1)
    return [SceneSpec(f"stems/{family}_{seed}", "dev", family, NUM_LEAVES, NUM_VIEWS, seed) for seed in seeds]


def measure_nodes(spec: SceneSpec, kind: str, cache: Path) -> dict[str, Any]:
    """The errors of one plant."""
    scene, plant = load_maps(spec, cache), grow_plant(spec.family, spec.num_leaves, spec.seed)
    start = time.process_time()
    blades = fit_blades(*scene.masks(kind), scene.cameras)
    fitted = time.process_time()
    stems = stems_of_bases(blades, UP, level_frame(UP))
    share = (time.process_time() - fitted) / (fitted - start)
    tall = np.ptp(np.concatenate([*(leaf.vertices for leaf in plant.leaves), *plant.stems])[:, 2])
    errors, divergence, ordered = [np.zeros((0, 4))], [], []
    for stem in stems:
        begins = np.array([plant.petioles[node.leaf - 1][:2] for node in stem.nodes])
        height, ahead = begins[:, 0, 2], begins[:, 1] - begins[:, 0]
        azimuth = np.degrees(np.arctan2(ahead[:, 1], ahead[:, 0]))
        numbers = [(node.height, node.node_azimuth) for node in stem.nodes]
        up, up_sd, turn, turn_sd = np.array([(up.value, up.sd, turn.value, turn.sd) for up, turn in numbers]).T
        of_node = [100 * (up - height + height[0]) / tall, 100 * up_sd / tall, wrap(turn - azimuth), turn_sd]
        errors.append(np.stack(of_node, 1)[1:])
        steps = [np.abs(wrap(np.diff(each))) for each in (turn, azimuth)]
        divergence += np.abs(steps[0] - steps[1]).tolist()
        ordered += (np.diff(height) > -0.01 * tall).tolist()
    right = [stem.phyllotaxis.name == PHYLLOTAXIS[spec.family] for stem in stems]
    about = {"share": share, "stems": len(stems), "leaves": len(plant.leaves), "phyllotaxis": right[:1]}
    return {**about, "errors": np.concatenate(errors), "divergence": divergence, "ordered": ordered}


def wrap(degrees: Floats) -> Floats:
    return (degrees + 180) % 360 - 180


def print_nodes(cache: Path, num_plants: int) -> None:
    print("| family | masks | stem | nodes | height, % | divergence | inside | order | phyllotaxis | time, % |")
    for kind in KINDS:
        every: list[dict[str, Any]] = []
        for family in PHYLLOTAXIS:
            rows = [measure_nodes(spec, kind, cache) for spec in list_plants(family, num_plants)]
            print(f"| {family} | {kind} | {summarise(rows)} |", flush=True)
            every += rows
        print(f"| all | {kind} | {summarise(every)} |", flush=True)


def summarise(rows: list[dict[str, Any]]) -> str:
    errors = np.concatenate([row["errors"] for row in rows])
    divergence, ordered, right = ([*itertools.chain(*(row[name] for row in rows))]
                                  for name in ("divergence", "ordered", "phyllotaxis"))  # fmt: skip
    height, height_sd, azimuth, azimuth_sd = errors.T
    inside = [np.mean(np.abs(each) <= 1.96 * sd) for each, sd in ((height, height_sd), (azimuth, azimuth_sd))]
    nodes = (len(errors) + sum(row["stems"] for row in rows)) / sum(row["leaves"] for row in rows)
    cells = [
        f"{sum(row['stems'] > 0 for row in rows)} of {len(rows)}", f"{nodes:.2f}",
        *("{:.1f} / {:.1f}".format(*np.quantile(np.abs(each), (0.5, 0.9))) for each in (height, divergence)),
        f"{inside[0]:.2f}, {inside[1]:.2f}", f"{np.mean(ordered):.2f}",
        f"{sum(right)} of {len(right)}", f"{100 * np.mean([row['share'] for row in rows]):.1f}",
    ]  # fmt: skip
    return " | ".join(cells)


def print_up(cache: Path, num_plants: int) -> None:
    print("| family | masks | told | degrees | RMS | inside |")
    every, leans = list[float](), list[float]()
    for family, kind in itertools.product(PHYLLOTAXIS, KINDS):
        angles = []
        for spec in list_plants(family, num_plants):
            scene = load_maps(spec, cache)
            blades = fit_blades(*scene.masks(kind), scene.cameras)
            up = up_of_stem(stems_of_bases(blades, find_upward(scene.cameras), None), blades, scene.cameras)
            leans += [] if up is None else np.degrees(np.arcsin(up[:2])).tolist()
            angles += [] if up is None else [float(np.degrees(np.arccos(np.clip(up[2], -1, 1))))]
        every += angles
        print(f"| {family} | {kind} | {len(angles)} of {num_plants} | {_spread(angles)} |", flush=True)
    inside = np.mean(np.abs(leans) <= 1.96 * TILT_DEG)
    print(f"| all | both | {len(every)} of {2 * len(PHYLLOTAXIS) * num_plants} | {_spread(every)} | {inside:.2f} |")


def _spread(degrees: list[float]) -> str:
    shown = np.array(degrees or [np.nan])
    return "{:.1f} / {:.1f} | {:.1f}".format(*np.quantile(shown, (0.5, 0.9)), np.sqrt((shown**2).mean()))


def measure_real(folder: Path) -> str:
    scene, has_organs = load_scene(folder), (folder / "organs").is_dir()
    maps = true_maps(folder, scene)
    regions = regions_from_label_maps([close_holes(each) for each in maps] if has_organs else maps)
    organs = [close_holes(each) for each in true_maps(folder, scene, "organs")] if has_organs else []
    blades = fit_blades(regions, regions.labels, scene.cameras)
    frame = None if scene.up is None else level_frame(scene.up)
    masks = Masks.of(regions, regions.labels)
    stems = find_stems(blades, masks, scene.cameras, frame=frame, photos=Photos(scene))
    pairs = [one.leaf < other.leaf for stem in stems for one, other in itertools.combinations(stem.nodes, 2)]
    turns = np.array([node.divergence.value for stem in stems for node in stem.nodes])
    turns = turns[np.isfinite(turns)]
    about = [
        (f"{stem.source}, {stem.probability:.2f}", f"{stem.phyllotaxis.name}, {stem.phyllotaxis.probability:.2f}",
         f"{share_on_stem(stem.axis.points, scene.cameras, organs):.2f}" if organs else "-")
        for stem in stems
    ]  # fmt: skip
    nodes = f"{sum(len(stem.nodes) for stem in stems)} of {len(regions.labels.unique())}"
    cells = ["; ".join(each) for each in zip(*about, strict=True)] or ["-"] * 3
    divergence = " / ".join(f"{each:.0f}" for each in np.quantile(turns, (0.25, 0.5, 0.75))) if len(turns) else "-"
    return " | ".join([nodes, f"{np.mean(pairs):.2f} of {len(pairs)}" if pairs else "-", divergence, *cells])


def close_holes(labels: Ints) -> Ints:
    """Close each mask of a label map where no other mask lies."""
    closed = labels.copy()
    for number in np.setdiff1d(labels, (0, IGNORE_LABEL)):
        mask = ndimage.binary_closing(np.pad(labels == number, HOLE_PX), iterations=HOLE_PX)
        closed[mask[HOLE_PX:-HOLE_PX, HOLE_PX:-HOLE_PX] & (labels == 0)] = number
    return closed


def share_on_stem(points: Floats, cameras: Cameras, organs: list[Ints]) -> float:
    """Share of the projections of an axis (P, 3) on pixels of the stem, of those that lie on no leaf, in all views."""
    cams = [points @ matrix[:, :3].T + matrix[:, 3] for matrix in cameras.px_from_world.numpy()]
    of_point = np.concatenate([
        ndimage.map_coordinates(labels, (cam[:, 1::-1] / cam[:, 2:] - 0.5).T, order=0, mode="nearest")
        for cam, labels in zip(cams, organs, strict=True)
    ])  # fmt: skip
    return float(np.mean(of_point[of_point != LEAF] == STEM))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cache", type=Path, help="folder for rendered label maps")
    parser.add_argument("--plants", type=int, default=6, help="of each family")
    parser.add_argument("--up", action="store_true", help="which way is up")
    parser.add_argument("--real", nargs="+", type=Path, help="measure these scene folders, and nothing else")
    args = parser.parse_args()
    torch.set_num_threads(1)
    if args.real:
        print("| plant | leaves with a node | right order | divergence | stem | phyllotaxis | on the stem |")
        for folder in args.real:
            print(f"| {folder.name} | {measure_real(folder)} |", flush=True)
    elif args.cache is None:
        parser.error("expected --cache DIR or --real FOLDER")
    else:
        (print_up if args.up else print_nodes)(args.cache, args.plants)


if __name__ == "__main__":
    main()
