"""Simulated plants as unruly as real ones: `python -m benchmarks.unruly_plants OUT [SKINS]`.

Blades are curled and wavy, plants wild (`make_wild`), leaves move from photo to photo as in a draught, and the poses
that the scene states are wrong by about 1.5 px. Four plants with truth, to judge on them what is chosen for real
plants; and, with SKINS, a folder of leaves that were cut out, twelve more that look like other species (`dress`), and
four of these seen from so near that leaves fill the photos, as somebody with a phone does; and the next plants of two
of these species, on which to see what learned weights bring.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.camera_faults import rotate_cameras
from benchmarks.skins import dress, list_skins
from mvseg.formats.label_png import write_label_png
from mvseg.formats.rig import write_rig
from mvseg.scene import Scene, View
from mvseg.simulation.blades import BLADE_COLUMNS, Leaf, leaf_from_blade
from mvseg.simulation.cameras import arc_cameras
from mvseg.simulation.growth import SimulatedPlant, grow_plant
from mvseg.simulation.look import Floats
from mvseg.simulation.ray_cast import build_stage, render_stage
from mvseg.simulation.scene_writer import drop_small, shuffle_labels, write_jpeg
from mvseg.simulation.wild import make_wild, roll_up

PLANTS = (("ovate", 18, 10, 71), ("leggy", 12, 12, 72), ("lanceolate", 16, 10, 73), ("compound", 20, 8, 74))
DRESSED = (
    ("ovate", 24, 16, 81), ("lanceolate", 28, 16, 82), ("ovate", 14, 12, 83), ("leggy", 20, 10, 84),
    ("leggy", 10, 12, 85), ("rosette", 14, 10, 86), ("lobed", 10, 10, 87), ("compound", 16, 10, 88),
    ("strap", 12, 10, 89), ("ovate", 32, 10, 90), ("lanceolate", 12, 8, 91), ("leggy", 16, 12, 92),
)  # fmt: skip
CLOSE = (
    ("ovate", 20, 14, 181), ("lanceolate", 18, 14, 182), ("rosette", 16, 12, 186), ("lobed", 12, 12, 187),
)  # fmt: skip
NEXT = {"lobed-187": ("lobed", 14, 12, 188), "lanceolate-182": ("lanceolate", 16, 12, 183)}  # from as near
ZOOM = 2.2  # of these, over the focal length that fills the photo with the plant
SIZE = 800
CURL, WAVE = 0.7, 0.035  # radians from midrib to edge; of a leaf's length
SWAY_DEG = 1.2  # from photo to photo: some 2 px at the tip of a leaf of 100 px
POSE_PX = 1.5


def make_unruly(plant: SimulatedPlant, seed: int) -> SimulatedPlant:
    """A wild plant with curled and wavy blades."""
    rng = np.random.default_rng([seed, 3])
    return replace(make_wild(plant, seed), leaves=tuple(curl(leaf, rng) for leaf in make_wild(plant, seed).leaves))


def curl(leaf: Leaf, rng: np.random.Generator) -> Leaf:
    """The leaf rolled around its midrib, and with two waves or so along it."""
    vertices = roll_up(leaf.vertices, rng.normal(0, CURL))
    rows = (len(vertices) - 2) // BLADE_COLUMNS
    along = np.concatenate([[0.0], np.repeat(np.linspace(0, 1, rows), BLADE_COLUMNS), [1.0]])
    height = WAVE * leaf.length * rng.normal() * np.sin(2 * np.pi * (rng.uniform(0.7, 2) * along + rng.random()))
    waved = vertices + (height - height[0])[:, None] * rng.normal(0, 0.3, 3) + (height - height[0])[:, None] * [0, 0, 1]
    return replace(leaf_from_blade(leaf.leaf_id, waved), dryness=leaf.dryness)


def sway(plant: SimulatedPlant, rng: np.random.Generator) -> SimulatedPlant:
    """The plant a moment later: every leaf turned a little around its base."""
    turns = [Rotation.from_rotvec(np.radians(rng.normal(0, SWAY_DEG, 3))) for _ in plant.leaves]
    moved = [
        replace(leaf, vertices=leaf.vertices[0] + turn.apply(leaf.vertices - leaf.vertices[0]))
        for leaf, turn in zip(plant.leaves, turns, strict=True)
    ]
    return replace(plant, leaves=tuple(moved))


def write_unruly(
    folder: Path,
    family: str,
    num_leaves: int,
    *,
    num_views: int,
    seed: int,
    skins: tuple[Floats, ...] = (),
    zoom: float = 1.0,
    worn: int | None = None,
) -> None:
    """A scene as `mvseg simulate` writes it, without leaf meshes: no one shape is the truth of all photos. It looks as
    the plant of seed `worn` does, if that is given."""
    plant, rng = make_unruly(grow_plant(family, num_leaves, seed), seed), np.random.default_rng([seed, 4])
    cameras = arc_cameras(
        num_views, plant, span_deg=360, start_deg=seed, elevations_deg=(15.0, 45.0, 30.0), width=SIZE, height=SIZE
    )
    K = cameras.K.clone()
    K[:, :2, :2] *= zoom
    cameras = replace(cameras, K=K)
    for part in ("images", "masks", "truth"):
        (folder / part).mkdir(parents=True)
    names = [f"{view:03d}" for view in range(num_views)]
    for view, name in enumerate(names):
        stage = build_stage(sway(plant, rng), seed=seed)
        if skins:
            look = stage.look if worn is None else build_stage(plant, seed=worn).look
            stage = replace(stage, look=dress(look, skins, np.random.default_rng([worn or seed, 5])))
        shot = render_stage(stage, cameras, view)
        truth = drop_small(shot.ids, 30)
        write_jpeg(folder / "images" / f"{name}.jpg", shot.rgb)
        write_label_png(folder / "truth" / f"{name}.png", truth)
        write_label_png(folder / "masks" / f"{name}.png", shuffle_labels(truth, np.random.default_rng([seed, view])))
    files = [f"images/{name}.jpg" for name in names]
    views = tuple(View(name, folder / file) for name, file in zip(names, files, strict=True))
    stated = rotate_cameras(cameras, POSE_PX, rng)
    scene = Scene(name=folder.name, views=views, cameras=stated, unit="mm", up=(0.0, 0.0, 1.0))
    write_rig(folder / "cameras.json", scene, files)


def main() -> None:
    out, *folders = map(Path, sys.argv[1:])
    skins = list_skins(*folders) if folders else ()
    for plants, worn, zoom in ((PLANTS, (), 1.0), (DRESSED, skins, 1.0), (CLOSE, skins, ZOOM)):
        for family, num_leaves, num_views, seed in plants if skins or plants is PLANTS else ():
            folder = out / f"{family}-{seed}"
            write_unruly(folder, family, num_leaves, num_views=num_views, seed=seed, skins=worn, zoom=zoom)
    for name, (family, num_leaves, num_views, seed) in NEXT.items() if skins else ():
        worn_by, folder = int(name.rpartition("-")[2]), out / f"{family}-{seed}"
        write_unruly(folder, family, num_leaves, num_views=num_views, seed=seed, skins=skins, zoom=ZOOM, worn=worn_by)


if __name__ == "__main__":
    main()
