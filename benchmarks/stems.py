"""How good are nodes? `python benchmarks/stems.py --cache ~/mvseg-cells [--plants 6]`

Simulated plants of 8 leaves with true ids, 480 x 480, 10 views on a 200 degree arc. Masks are exact, or have the faults
of a segmenter (`faults.py`); no photos are used. By family and kind of masks: plants whose leaves agree about a stem;
leaves with a node, of all; median / 90th percentile of the error of node heights in % of the plant's height, above its
lowest node that was found, and of divergence angles in degrees, in the true order; shares inside 95 % intervals, of
heights and azimuths; pairs of neighbours in the right order; plants whose phyllotaxis is right; processor time in that
of the surfaces.

`--up` asks the stem which way is up, where only the photos say roughly so: plants that
answer, median / 90th percentile and root mean square of degrees to the true up.
"""

from __future__ import annotations

import argparse
import itertools
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).parents[1]))

from benchmarks.label_maps import KINDS, load_maps
from mvseg.reconstruction.stem.leaf_bases import axes_of_bases
from mvseg.reconstruction.surface.fit_surfaces import fit_surfaces
from mvseg.simulation.dataset import SceneSpec
from mvseg.simulation.growth import grow_plant
from mvseg.traits.nodes import measure_stem
from mvseg.traits.stems import find_upward, up_of_stem
from mvseg.traits.up import level_frame

NUM_LEAVES, NUM_VIEWS = 8, 10
PHYLLOTAXIS = {
    "ovate": "decussate", "lanceolate": "spiral", "lobed": "spiral", "strap": "distichous", "leggy": "decussate"
}  # fmt: skip


def measure_nodes(spec: SceneSpec, kind: str, cache: Path) -> dict[str, Any]:
    """The errors of one plant."""
    scene, plant = load_maps(spec, cache), grow_plant(spec.family, spec.num_leaves, spec.seed)
    regions, ids = scene.masks(kind)
    start = time.process_time()
    surfaces = fit_surfaces(regions, torch.where(ids > 0, ids, -1), scene.cameras)
    fitted = time.process_time()
    blades = {leaf: surface for leaf, surface in surfaces.items() if surface.is_credible}
    up = np.array([0.0, 0.0, 1.0])
    stems = [measure_stem(axis.axis, axis.bases.select(axis.is_near), frame=level_frame(up), source="leaf bases")
             for axis in axes_of_bases(blades, up)]  # fmt: skip
    share = (time.process_time() - fitted) / (fitted - start)
    tall = np.ptp(np.concatenate([*(leaf.vertices for leaf in plant.leaves), *plant.stems])[:, 2])
    errors: list[tuple[float, float, float, float]] = []
    divergence: list[float] = []
    ordered: list[bool] = []
    for stem in stems:
        petioles = [plant.petioles[node.leaf - 1] for node in stem.nodes]
        height = np.array([each[0, 2] for each in petioles])
        azimuth = np.degrees([np.arctan2(*(each[1] - each[0])[[1, 0]]) for each in petioles])
        measured = np.array([node.node_azimuth.value for node in stem.nodes])
        for node, true, turned in zip(stem.nodes[1:], height[1:] - height[0], azimuth[1:], strict=True):
            apart = (node.node_azimuth.value - turned + 180) % 360 - 180
            height_error, height_sd = (100 * each / tall for each in (node.height.value - true, node.height.sd))
            errors.append((height_error, height_sd, apart, node.node_azimuth.sd))
        steps = [np.abs((np.diff(each) + 180) % 360 - 180) for each in (measured, azimuth)]
        divergence += np.abs(steps[0] - steps[1]).tolist()
        ordered += (np.diff(height) > -0.01 * tall).tolist()
    right = [stem.phyllotaxis.name == PHYLLOTAXIS[spec.family] for stem in stems]
    about = {"share": share, "stems": len(stems), "leaves": len(plant.leaves), "phyllotaxis": right[:1]}
    return {**about, "errors": errors, "divergence": divergence, "ordered": ordered}


def print_nodes(cache: Path, num_plants: int) -> None:
    print("| family | masks | stem | nodes | height, % | divergence | inside | order | phyllotaxis | time, % |")
    for kind in KINDS:
        every: list[dict[str, Any]] = []
        for family in PHYLLOTAXIS:
            specs = [SceneSpec(f"stems/{family}_{seed}", "dev", family, NUM_LEAVES, NUM_VIEWS, seed)
                     for seed in range(1, num_plants + 1)]  # fmt: skip
            rows = [measure_nodes(spec, kind, cache) for spec in specs]
            print(f"| {family} | {kind} | {summarise(rows)} |", flush=True)
            every += rows
        print(f"| all | {kind} | {summarise(every)} |", flush=True)


def summarise(rows: list[dict[str, Any]]) -> str:
    errors = np.array([each for row in rows for each in row["errors"]]).reshape(-1, 4)
    divergence = np.array([each for row in rows for each in row["divergence"]])
    height, height_sd, azimuth, azimuth_sd = errors.T
    inside = [np.mean(np.abs(each) <= 1.96 * sd) for each, sd in ((height, height_sd), (azimuth, azimuth_sd))]
    nodes = (len(errors) + sum(row["stems"] for row in rows)) / sum(row["leaves"] for row in rows)
    right = [each for row in rows for each in row["phyllotaxis"]]
    cells = [
        f"{sum(row['stems'] > 0 for row in rows)} of {len(rows)}", f"{nodes:.2f}",
        *("{:.1f} / {:.1f}".format(*np.quantile(np.abs(each), (0.5, 0.9))) for each in (height, divergence)),
        f"{inside[0]:.2f}, {inside[1]:.2f}", f"{np.mean([each for row in rows for each in row['ordered']]):.2f}",
        f"{sum(right)} of {len(right)}", f"{100 * np.mean([row['share'] for row in rows]):.1f}",
    ]  # fmt: skip
    return " | ".join(cells)


def print_up(cache: Path, num_plants: int) -> None:
    print("| family | masks | told | degrees | RMS |")
    every: list[float] = []
    for family, kind in itertools.product(PHYLLOTAXIS, KINDS):
        found = []
        for seed in range(1, num_plants + 1):
            scene = load_maps(SceneSpec(f"stems/{family}_{seed}", "dev", family, NUM_LEAVES, NUM_VIEWS, seed), cache)
            regions, ids = scene.masks(kind)
            surfaces = fit_surfaces(regions, torch.where(ids > 0, ids, -1), scene.cameras)
            blades = {leaf: surface for leaf, surface in surfaces.items() if surface.is_credible}
            stems = [measure_stem(axis.axis, axis.bases.select(axis.is_near), frame=None, source="leaf bases")
                     for axis in axes_of_bases(blades, find_upward(scene.cameras))]  # fmt: skip
            up = up_of_stem(stems, blades, scene.cameras)
            found += [] if up is None else [float(np.degrees(np.arccos(np.clip(up[2], -1, 1))))]
        every += found
        print(f"| {family} | {kind} | {len(found)} of {num_plants} | {_spread(found)} |", flush=True)
    print(f"| all | both | {len(every)} of {2 * len(PHYLLOTAXIS) * num_plants} | {_spread(every)} |")


def _spread(degrees: list[float]) -> str:
    shown = np.array(degrees or [np.nan])
    return "{:.1f} / {:.1f} | {:.1f}".format(*np.quantile(shown, (0.5, 0.9)), np.sqrt((shown**2).mean()))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cache", type=Path, required=True, help="folder for rendered label maps")
    parser.add_argument("--plants", type=int, default=6, help="of each family")
    parser.add_argument("--up", action="store_true", help="which way is up")
    args = parser.parse_args()
    torch.set_num_threads(1)
    if args.up:
        print_up(args.cache, args.plants)
    else:
        print_nodes(args.cache, args.plants)


if __name__ == "__main__":
    main()
