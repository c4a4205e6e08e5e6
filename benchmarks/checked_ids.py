"""What surfaces correct in the ids: `python -m benchmarks.checked_ids --cache DIR [--real FOLDER ...]`

For each scene: ARI and e_k of the ids found and of those that the surfaces correct
(`mvseg.verification.choose`), how many masks are moved, how many of the moved were right before and are right
afterwards, and CPU seconds of matching, and of surfaces and the check. "degraded" and "true" are the masks of the
evaluation scenes, "pieces" those of `straps.py`, whose numbers of leaves do not depend on --leaves; "real" are those of
the folders with `masks/` and `truth/`.
"""

from __future__ import annotations

import argparse
import time
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import torch
from torch import Tensor

from benchmarks.choice import true_maps
from benchmarks.confidence import has_right_id
from benchmarks.label_maps import KINDS, add_scene_options, chosen_scenes, load_maps
from benchmarks.straps import FIRST_SEED, draw_straps
from benchmarks.straps import list_masks as list_straps
from mvseg.errors import InputWarning
from mvseg.evaluation.id_metrics import matching_metrics
from mvseg.evaluation.truth import true_instances
from mvseg.formats.scene_folder import load_masks, load_scene
from mvseg.masks import Masks
from mvseg.matching.config import MatchConfig
from mvseg.matching.match import match_regions
from mvseg.regions import Regions
from mvseg.scene import Cameras
from mvseg.verification.choose import Judges, choose_leaves, find_again

KINDS_HERE = (*KINDS, "pieces")
STRAPS = 8, 12  # leaves


@dataclass(frozen=True, eq=False)
class Given:
    """Masks of one scene: D regions and (D,) the leaf that each shows."""

    name: str
    regions: Regions
    leaf: Tensor
    cameras: Cameras


def read_given(folder: Path) -> Given:
    """The `masks/` of a real plant."""
    scene = load_scene(folder)
    regions = load_masks(scene, folder / "masks")
    leaf = true_instances(regions, true_maps(folder, scene))
    return Given(folder.name, regions, leaf, scene.cameras)


def choose_given(matched: Masks, cameras: Cameras) -> Masks:
    """The masks with the ids that hold once surfaces checked them."""
    judges = Judges(cameras.to("cpu"), holds=True, cache={})
    again = find_again(matched, judges, MatchConfig())
    tables = {"matched": matched} | ({} if again is None else {"matched again": again})
    return choose_leaves(matched, tables, judges).masks


def list_masks(args: argparse.Namespace) -> Iterator[Given]:
    yield from map(read_given, args.real)
    for kind in args.masks:
        if kind != "pieces":
            for spec in chosen_scenes(args):
                maps_of = load_maps(spec, args.cache)
                regions, leaf = maps_of.masks(kind)
                name = f"{kind} {spec.num_leaves}x{spec.num_views} {spec.family}"
                yield Given(name, regions, leaf, maps_of.cameras)
            continue
        for num_leaves in STRAPS:
            for number in range(args.plants):
                true, cameras = draw_straps(num_leaves, FIRST_SEED + number)
                yield Given(f"pieces {num_leaves}x{len(cameras)} {number}", *list_straps(true)["pieces"], cameras)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add_scene_options(parser)
    parser.add_argument("--masks", nargs="*", choices=KINDS_HERE, default=KINDS_HERE)
    parser.add_argument("--real", type=Path, nargs="*", default=[], help="folders of real plants")
    args = parser.parse_args()
    torch.set_num_threads(1)
    warnings.simplefilter("ignore", InputWarning)
    header = ("ARI", "then", "e_k", "then", "moved", "right", "then", "match s", "check s")
    print(f"{'masks':26}" + "".join(f"{name:>9}" for name in header))
    for given in list_masks(args):
        times = [time.process_time()]
        matched = match_regions(given.regions, given.cameras).masks
        times.append(time.process_time())
        checked = choose_given(matched, given.cameras)
        times.append(time.process_time())
        is_moved = (matched.instance_ids != checked.instance_ids).numpy()
        both = matched.instance_ids, checked.instance_ids
        before, after = (matching_metrics(ids, given.leaf) for ids in both)
        right = [int(has_right_id(ids.numpy(), given.leaf.numpy())[is_moved].sum()) for ids in both]
        cells = f"{before.ari:9.3f}{after.ari:9.3f}{before.e_k:9.0f}{after.e_k:9.0f}{int(is_moved.sum()):9}"
        cells += "".join(f"{count:9}" for count in right)
        cells += "".join(f"{end - start:9.1f}" for start, end in pairwise(times))
        print(f"{given.name:26}{cells}", flush=True)


if __name__ == "__main__":
    main()
