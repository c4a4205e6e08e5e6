"""What surfaces correct in the ids: `python benchmarks/checked_ids.py --cache DIR [--masks degraded true pieces]`

For each scene: ARI and e_k of the ids found and of those that the surfaces correct
(`mvseg.verification.checked_ids`), how many masks are moved, how many of the moved were right before and are right
afterwards, and CPU seconds of matching, of surfaces, of the check and of the surfaces that are fitted again.
"degraded" and "true" are the masks of the evaluation scenes, "pieces" those of `straps.py`, whose numbers of leaves do
not depend on --leaves.
"""

from __future__ import annotations

import argparse
import sys
import time
import warnings
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import torch
from torch import Tensor

sys.path.insert(0, str(Path(__file__).parents[1]))

from benchmarks.confidence import has_right_id
from benchmarks.label_maps import KINDS, add_scene_options, chosen_scenes, load_maps, visible_ids
from benchmarks.straps import FIRST_SEED, cut_pieces, strap_cameras
from mvseg.errors import InputWarning
from mvseg.evaluation.id_metrics import matching_metrics
from mvseg.evaluation.truth import shown_instances
from mvseg.matching.match import match_regions
from mvseg.reconstruction.surface.fit_surfaces import fit_surfaces
from mvseg.regions import Regions, regions_from_label_maps
from mvseg.scene import Cameras
from mvseg.simulation.growth import grow_plant
from mvseg.verification.checked_ids import check_ids, unchanged_surfaces

KINDS_HERE = (*KINDS, "pieces")
STRAPS = 8, 12  # leaves


def list_masks(args: argparse.Namespace) -> Iterator[tuple[str, Regions, Tensor, Cameras]]:
    """Name, regions, the leaf that each of them shows, and cameras of each scene."""
    for kind in args.masks:
        if kind != "pieces":
            for spec in chosen_scenes(args):
                scene = load_maps(spec, args.cache)
                regions, leaf = scene.masks(kind)
                yield f"{kind} {spec.num_leaves}x{spec.num_views} {spec.family}", regions, leaf, scene.cameras
            continue
        for num_leaves in STRAPS:
            for number in range(args.plants):
                plant = grow_plant("strap", num_leaves, FIRST_SEED + number)
                cameras = strap_cameras(plant)
                true = visible_ids(plant, cameras)
                regions = regions_from_label_maps([cut_pieces(labels) for labels in true])
                leaf = shown_instances(regions, list(true), count_background=False)
                yield f"pieces {num_leaves}x{len(cameras)} {number}", regions, leaf, cameras


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add_scene_options(parser)
    parser.add_argument("--masks", nargs="+", choices=KINDS_HERE, default=KINDS_HERE)
    args = parser.parse_args()
    torch.set_num_threads(1)
    warnings.simplefilter("ignore", InputWarning)
    header = ("ARI", "then", "e_k", "then", "moved", "right", "then", "match s", "fit s", "check s", "again s")
    print(f"{'masks':26}" + "".join(f"{name:>9}" for name in header))
    for name, regions, leaf, cameras in list_masks(args):
        times = [time.process_time()]
        matching = match_regions(regions, cameras)
        times.append(time.process_time())
        surfaces = fit_surfaces(regions, matching.instance_ids, cameras)
        times.append(time.process_time())
        checked = check_ids(matching.masks, surfaces, cameras=cameras)
        is_moved = matching.instance_ids != checked.instance_ids
        times.append(time.process_time())
        if is_moved.any():
            known = unchanged_surfaces(matching.masks, checked, surfaces)
            fit_surfaces(regions, checked.instance_ids, cameras, known=known)
        times.append(time.process_time())
        both = matching.instance_ids, checked.instance_ids
        before, after = (matching_metrics(ids, leaf) for ids in both)
        right = [int(has_right_id(ids.numpy(), leaf.numpy())[is_moved.numpy()].sum()) for ids in both]
        cells = f"{before.ari:9.3f}{after.ari:9.3f}{before.e_k:9.0f}{after.e_k:9.0f}{int(is_moved.sum()):9}"
        cells += "".join(f"{count:9}" for count in right)
        cells += "".join(f"{end - start:9.1f}" for start, end in pairwise(times))
        print(f"{name:26}{cells}", flush=True)


if __name__ == "__main__":
    main()
