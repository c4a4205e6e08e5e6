"""How large are the leaves that detectors train on? `python benchmarks/training_leaves.py [--photos 200] [--size 448]`

Photos of new plants, as `mvseg train --new_plants` renders them, at the size that the shipped detector was trained at.
Prints quantiles of the root of the area of their visible leaves, in pixels; the 90 % quantile is `LARGE` of
`mvseg/detection/detect_scene.py`.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np
from tqdm import tqdm

sys.path.insert(0, str(Path(__file__).parents[1]))

from mvseg.training.new_plants import render_new_plant

QUANTILES = (0.1, 0.5, 0.75, 0.9, 0.95)


def leaf_sides(seed: int, size: int) -> list[float]:
    """The root of the area of each leaf in one photo, pixels."""
    labels = render_new_plant(seed, size).layers.numpy()
    _, areas = np.unique(labels[labels > 0], return_counts=True)
    return np.sqrt(areas).tolist()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--photos", type=int, default=200)
    parser.add_argument("--size", type=int, default=448)
    args = parser.parse_args()
    sides = [side for seed in tqdm(range(args.photos), disable=None) for side in leaf_sides(seed, args.size)]
    for quantile, side in zip(QUANTILES, np.quantile(sides, QUANTILES), strict=True):
        print(f"{quantile:.0%} of {len(sides)} leaves are smaller than {side:.0f} px")


if __name__ == "__main__":
    main()
