"""Matching of long, thin leaves that cross: `python -m benchmarks.straps [--leaves 8 12] [--plants 3]`

Straps, as maize on a turntable: twelve views around at 10 degrees of elevation and one from the top
(80 degrees), 480 x 480. "whole" masks are the visible parts of the leaves, "pieces" are their connected parts of 30
pixels or more, each with a number of its own, and "degraded" pieces have the faults of a segmenter besides.
Of the masks with a wrong id, or none, the last columns say how many are pieces of a leaf with several in their view,
and how many are smaller than 200 pixels.
"""

from __future__ import annotations

import argparse

import numpy as np
import torch
from scipy import ndimage

from benchmarks.confidence import has_right_id
from benchmarks.faults import Faults, degrade_labels
from benchmarks.label_maps import MIN_PIXELS, visible_ids
from mvseg.evaluation.id_metrics import matching_metrics
from mvseg.evaluation.truth import true_instances
from mvseg.matching.match import match_regions
from mvseg.regions import Regions, regions_from_label_maps
from mvseg.scene import Cameras
from mvseg.simulation.cameras import arc_cameras
from mvseg.simulation.growth import SimulatedPlant, grow_plant

VIEWS, SIDE, TOP = 12, 10.0, 80.0  # views around; degrees of elevation
SMALL = 200  # pixels
FIRST_SEED = 7000  # of plants that are in no other set
KINDS = ("whole", "pieces", "degraded")


def strap_cameras(plant: SimulatedPlant) -> Cameras:
    around = arc_cameras(VIEWS, plant, span_deg=360, elevations_deg=(SIDE,))
    top = arc_cameras(1, plant, elevations_deg=(TOP,))
    parts = {name: torch.cat((getattr(around, name), getattr(top, name))) for name in ("K", "R", "t", "sizes")}
    return Cameras(**parts)


def cut_pieces(labels: np.ndarray) -> np.ndarray:
    """(H, W) uint16, the connected parts of every leaf with numbers of their own; small ones are left out."""
    pieces, count = np.zeros_like(labels), 0
    for leaf in np.unique(labels[labels > 0]):
        parts, _ = ndimage.label(labels == leaf, np.ones((3, 3)))
        for number in np.flatnonzero(np.bincount(parts.ravel())[1:] >= MIN_PIXELS) + 1:
            count += 1
            pieces[parts == number] = count
    return pieces


def draw_straps(num_leaves: int, seed: int) -> tuple[list[np.ndarray], Cameras]:
    """V true label maps of a plant, and its cameras."""
    plant = grow_plant("strap", num_leaves, seed)
    cameras = strap_cameras(plant)
    return list(visible_ids(plant, cameras)), cameras


def list_masks(true: list[np.ndarray]) -> dict[str, tuple[Regions, torch.Tensor]]:
    """Masks and the leaf that each shows: whole, in pieces, and with the faults of a segmenter besides."""
    pieces = [cut_pieces(labels) for labels in true]
    faulty = [degrade_labels(labels, Faults(), seed=view) for view, labels in enumerate(pieces)]
    regions = {name: regions_from_label_maps(maps) for name, maps in zip(KINDS, (true, pieces, faulty), strict=True)}
    return {name: (each, true_instances(each, true, count_background=False)) for name, each in regions.items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--leaves", nargs="+", type=int, default=(8, 12))
    parser.add_argument("--plants", type=int, default=3)
    args = parser.parse_args()
    header = ("masks", "leaves", "plant", "regions", "ARI", "e_k", "wrong", "of pieces", "small")
    print("".join(f"{name:>11}" for name in header))
    for num_leaves in args.leaves:
        for number in range(args.plants):
            true, cameras = draw_straps(num_leaves, FIRST_SEED + number)
            for kind, (regions, leaf) in list_masks(true).items():
                ids = match_regions(regions, cameras).instance_ids
                metrics = matching_metrics(ids, leaf)
                is_wrong = ~torch.from_numpy(has_right_id(ids.numpy(), leaf.numpy()))
                place = regions.view_index * (num_leaves + 1) + leaf
                is_piece = torch.bincount(place)[place] > 1
                counts = (is_wrong.sum(), (is_wrong & is_piece).sum(), (is_wrong & (regions.areas < SMALL)).sum())
                cells = f"{kind:>11}{num_leaves:11}{number:11}{len(regions):11}{metrics.ari:11.3f}{metrics.e_k:11.0f}"
                print(cells + "".join(f"{int(count):11}" for count in counts), flush=True)


if __name__ == "__main__":
    main()
