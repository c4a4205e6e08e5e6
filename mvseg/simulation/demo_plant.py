"""Renders the scene that ships with mvseg: `python -m mvseg.simulation.demo_plant OUT`.

A basil-like plant of 12 curved leaves, seen by 9 cameras. `mvseg/demo_plant/` is its output.
"""

from __future__ import annotations

import sys
from pathlib import Path

from mvseg.simulation.cameras import arc_cameras
from mvseg.simulation.growth import grow_plant
from mvseg.simulation.scene_writer import write_scene

NUM_LEAVES = 12
NUM_VIEWS = 9
SEED = 6


def write_demo_plant(folder: Path) -> None:
    """Write the shipped scene: rig file, photos, masks with shuffled numbers, true ids, leaf meshes and traits."""
    plant = grow_plant("ovate", NUM_LEAVES, seed=SEED)
    cameras = arc_cameras(NUM_VIEWS, plant, width=640, height=480)
    write_scene(folder, plant, cameras, seed=SEED)


if __name__ == "__main__":
    write_demo_plant(Path(sys.argv[1]))
