"""Renders the scenes that ship with mvseg: `python -m benchmarks.demo_plant OUT OUT_LATER`.

A basil-like plant of 12 curved leaves, seen by 9 cameras: `mvseg/demo_plant/`. The same plant six days later, seen by
other cameras: `mvseg/demo_plant_later/`.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from mvseg.simulation.blades import Leaf, leaf_from_blade
from mvseg.simulation.cameras import arc_cameras
from mvseg.simulation.growth import SimulatedPlant, grow_plant
from mvseg.simulation.scene_writer import write_scene
from mvseg.simulation.series import PotPlace, move_plant

NUM_LEAVES = 12
NUM_VIEWS = 9
SEED = 6
LATER_POT = PotPlace(turn=140.0, lean=5.0, towards=60.0, x=40.0, y=-25.0)


def write_demo_plant(folder: Path) -> None:
    """Write the shipped scene: rig file, photos, masks with shuffled numbers, true ids, leaf meshes and traits."""
    plant = grow_plant("ovate", NUM_LEAVES, seed=SEED)
    cameras = arc_cameras(NUM_VIEWS, plant, width=640, height=480)
    write_scene(folder, plant, cameras, seed=SEED)


def write_demo_plant_later(folder: Path) -> None:
    """Write the shipped scene of six days later; the same leaf has the same true id."""
    plant = grow_later(grow_plant("ovate", NUM_LEAVES, seed=SEED))
    cameras = arc_cameras(NUM_VIEWS, plant, start_deg=20.0, elevations_deg=(15.0, 45.0), width=480, height=360)
    write_scene(folder, plant, cameras, seed=SEED)


def grow_later(plant: SimulatedPlant) -> SimulatedPlant:
    """The plant some days later: small leaves have grown, the lowest one has fallen, a new one (the next id) has
    unfolded at the tip of the stem, and the pot was turned, shifted and set down askew."""
    longest, tip = max(leaf.length for leaf in plant.leaves), plant.stems[0][-1]
    lowest = min(plant.leaves, key=lambda leaf: float(leaf.vertices[0, 2]))
    nearest = min(plant.leaves, key=lambda leaf: float(np.linalg.norm(leaf.vertices[0] - tip)))

    def grown(leaf: Leaf) -> Leaf:
        larger = leaf.vertices[0] + (1 + 0.6 * (1 - leaf.length / longest)) * (leaf.vertices - leaf.vertices[0])
        return leaf_from_blade(leaf.leaf_id, larger)

    turned = Rotation.from_euler("z", 90, degrees=True).apply(0.6 * (nearest.vertices - nearest.vertices[0]))
    new = leaf_from_blade(len(plant.leaves) + 1, tip + (0.0, 0.0, 3.0) + turned)
    leaves = (*(grown(leaf) for leaf in plant.leaves if leaf is not lowest), new)
    return move_plant(replace(plant, leaves=leaves), LATER_POT)


if __name__ == "__main__":
    write_demo_plant(Path(sys.argv[1]))
    write_demo_plant_later(Path(sys.argv[2]))
