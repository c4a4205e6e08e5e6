"""An easy scene for matchers that look at photos: a few large, strongly textured leaves from closely spaced views."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from mvseg.formats.image_file import write_png
from mvseg.regions import Regions, regions_from_label_maps
from mvseg.scene import Scene, View
from mvseg.simulation.cameras import arc_cameras
from mvseg.simulation.growth import grow_plant
from mvseg.simulation.ray_cast import build_stage, render_stage


@dataclass(frozen=True, eq=False)
class LeafyScene:
    """A scene with its photos on disk, the true masks (`regions.labels` are the true ids), depths and leaf vertices."""

    scene: Scene
    regions: Regions
    depths: list[np.ndarray]
    vertices: Tensor


def write_leafy_scene(
    folder: Path, *, num_leaves: int = 4, num_views: int = 10, size: int = 320, span_deg: float = 45
) -> LeafyScene:
    """Views evenly spread over so many degrees of azimuth, at one height; `folder` must be there."""
    plant = grow_plant("ovate", num_leaves, 18)  # hardly any leaf hides another
    cameras = arc_cameras(num_views, plant, span_deg=span_deg, elevations_deg=(40,), width=size, height=size)
    stage = build_stage(plant, seed=12)
    stage = replace(stage, look=replace(stage.look, spots=2.0, quilting=0.15, gloss=0.0, noise=0.004))
    views, labels, depths = [], [], []
    for view in range(num_views):
        shot = render_stage(stage, cameras, view)
        views.append(View(f"{view:03d}", folder / f"{view:03d}.png"))
        write_png(views[-1].path, shot.rgb)
        labels.append(shot.ids)
        depths.append(shot.depth)
    vertices = np.concatenate([leaf.vertices for leaf in plant.leaves])
    scene = Scene("leafy", tuple(views), cameras)
    return LeafyScene(scene, regions_from_label_maps(labels), depths, torch.from_numpy(vertices).double())
