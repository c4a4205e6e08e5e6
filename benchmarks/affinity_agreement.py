"""Affinity by plane angles against affinity by drawn lines: `python benchmarks/affinity_agreement.py`

The drawn twin (tests/reference.py: the epipolar lines of 200 points per region, drawn two pixels wide and counted
against the mask of every region) on the shipped scene, over four samplings. Takes a quarter of an hour.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import torch

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
sys.path.insert(0, str(Path(__file__).parents[1]))

from mvseg.demo import demo_scene
from mvseg.formats.scene_folder import load_masks, load_scene
from mvseg.matching.affinity import region_affinity
from reference import affinity_reference


def measure_agreement() -> dict[str, float]:
    """Differences of the affinities of all pairs of regions of different views."""
    scene = load_scene(demo_scene())
    regions = load_masks(scene, demo_scene() / "masks")
    drawn = torch.stack([affinity_reference(regions, scene.cameras, 200, seed) for seed in range(4)])
    drawn = (drawn + drawn.mT) / 2
    pairs = regions.view_index[:, None] != regions.view_index
    ours = (region_affinity(regions, scene.cameras).to_dense() - drawn.mean(0))[pairs].abs()
    between = torch.stack([(drawn[a] - drawn[b])[pairs].abs() for a in range(4) for b in range(a)])
    return {
        "mean": float(ours.mean()),
        "max": float(ours.max()),
        "mean_between_samplings": float(between.mean()),
        "max_between_samplings": float(between.max()),
    }


if __name__ == "__main__":
    torch.set_num_threads(1)
    print(json.dumps(measure_agreement(), indent=1))
