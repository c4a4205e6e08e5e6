"""Which masks that cover two leaves are found, and how they are cut: `python benchmarks/merged_masks.py --cache DIR`

Degraded masks. By the truth, a mask shows two leaves when a fifth of its pixels or more show either. The lists are
those of the matcher (`Matching.merged`), and of the matcher and the surfaces (`mvseg.verification.checked_ids`). Of
each, for the masks that do show two leaves: the share of their pixels (of those that show a leaf) that the cut puts
on the right one, and that one id for the whole mask does. An instance's leaf is the one that most of its masks show.
"""

from __future__ import annotations

import argparse
import sys
import warnings
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

sys.path.insert(0, str(Path(__file__).parents[1]))

from benchmarks.label_maps import add_scene_options, chosen_scenes, load_maps
from mvseg.errors import InputWarning
from mvseg.matching.match import match_regions
from mvseg.matching.result import Matching
from mvseg.reconstruction.surface.fit_surfaces import fit_surfaces
from mvseg.regions import Regions
from mvseg.verification.checked_ids import check_ids

EACH = 0.2  # of a mask's pixels


def shown_leaves(regions: Regions, true: np.ndarray) -> list[np.ndarray]:
    """Of each region, the leaf that each of its pixels shows, 0 = none."""
    shown = []
    for region, (view, box) in enumerate(zip(regions.view_index.tolist(), regions.boxes.tolist(), strict=True)):
        x1, y1, x2, y2 = box
        shown.append(true[view, y1:y2, x1:x2][regions.crop(region).numpy()].astype(np.int64))
    return shown


def shows_two(pixels: np.ndarray) -> bool:
    counts = np.sort(np.bincount(pixels[pixels > 0], minlength=2))
    return bool(counts[-2] >= EACH * len(pixels))


def judge_list(regions: Regions, leaf: Tensor, matching: Matching, *, shown: list[np.ndarray]) -> np.ndarray:
    """Masks listed; of these, those that show two leaves; of their pixels: right when cut, with one id, and all."""
    ids = matching.instance_ids
    main = [0, *(int(leaf[(ids == number) & (leaf > 0)].mode()[0]) for number in range(1, matching.num_instances + 1))]
    counts = np.zeros(5, np.int64)
    for mask in matching.merged:
        pixels = shown[mask.region]
        counts[0] += 1
        if shows_two(pixels):
            part = mask.part.numpy()[regions.crop(mask.region).numpy()]
            is_right = np.where(part, main[mask.other], main[mask.own]) == pixels
            on_leaf = pixels > 0
            counts[1:] += 1, is_right[on_leaf].sum(), (pixels[on_leaf] == main[mask.own]).sum(), on_leaf.sum()
    return counts


def count_scene(regions: Regions, leaf: Tensor, lists: tuple[Matching, Matching], *, true: np.ndarray) -> np.ndarray:
    """(12,) masks, those that show two leaves, and `judge_list` of both lists."""
    shown = shown_leaves(regions, true)
    num_two = sum(shows_two(pixels) for pixels in shown)
    judged = [judge_list(regions, leaf, matching, shown=shown) for matching in lists]
    return np.concatenate([[len(regions), num_two], *judged])


def print_row(name: str, counts: np.ndarray) -> None:
    cells = "".join(f"{count:8}" for count in counts[:2])
    for listed, num_two, cut, one_id, pixels in counts[2:].reshape(2, 5):
        shares = (f"{count / pixels:8.3f}" if pixels else f"{'-':>8}" for count in (cut, one_id))
        cells += f"{listed:8}{num_two:8}" + "".join(shares)
    print(f"{name:24}{cells}", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add_scene_options(parser)
    args = parser.parse_args()
    torch.set_num_threads(1)
    warnings.simplefilter("ignore", InputWarning)
    header = ("masks", "two", *("listed", "two", "cut", "one id") * 2)
    print(f"{'scene':24}" + "".join(f"{name:>8}" for name in header))
    total = np.zeros(12, np.int64)
    for spec in chosen_scenes(args):
        scene = load_maps(spec, args.cache)
        regions, leaf = scene.masks("degraded")
        matching = match_regions(regions, scene.cameras)
        surfaces = fit_surfaces(regions, matching.instance_ids, scene.cameras)
        checked = matching.with_masks(check_ids(matching.masks, surfaces, cameras=scene.cameras))
        counts = count_scene(regions, leaf, (matching, checked), true=scene.true)
        print_row(f"{spec.num_leaves}x{spec.num_views} {spec.family}", counts)
        total += counts
    print_row("all", total)


if __name__ == "__main__":
    main()
