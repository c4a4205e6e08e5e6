"""What stands beside mvseg in the table: the paper's lines and clustering, and a hull with libraries alone."""

from __future__ import annotations

import sys
import time
from pathlib import Path

import numpy as np
import torch
import trimesh
from skimage.measure import marching_cubes

from mvseg.matching.affinity import region_affinity
from mvseg.matching.symnmf import cluster_affinity
from mvseg.regions import Regions
from mvseg.scene import Cameras

sys.path.insert(0, str(Path(__file__).parents[2] / "tests"))

from reference import affinity_reference

SENDERS = 3  # regions that the drawn lines are timed on
CELLS = 64  # along each side of the library hull's box


def measure_rivals(regions: Regions, cameras: Cameras) -> dict[str, float]:
    """CPU seconds of drawn lines (of a few regions, scaled up to all), the paper's clustering, and one leaf's hull."""
    senders = torch.linspace(0, len(regions) - 1, SENDERS).long().tolist()
    start = time.process_time()
    affinity_reference(regions, cameras, senders=senders)
    drawn = (time.process_time() - start) * len(regions) / SENDERS
    affinity = region_affinity(regions, cameras)
    start = time.process_time()
    cluster_affinity(affinity, regions.num_per_view)
    clustered = time.process_time()
    carve_hull(regions, cameras, label=int(regions.labels[0]))
    return {
        "drawn lines": drawn,
        "the paper's clustering": clustered - start,
        "library hull of a leaf": time.process_time() - clustered,
    }


def carve_hull(regions: Regions, cameras: Cameras, *, label: int) -> trimesh.Trimesh:
    """One leaf, known by its true number, carved from a dense grid around the point that its rays come closest to."""
    members = [index for index, number in enumerate(regions.labels.tolist()) if number == label]
    masks = {int(regions.view_index[m]): m for m in members}
    sizes = cameras.sizes.tolist()
    A, b = np.zeros((3, 3)), np.zeros(3)
    for view, member in masks.items():
        box = regions.boxes[member].double()
        pixel = torch.tensor([(box[0] + box[2]) / 2, (box[1] + box[3]) / 2, 1], dtype=torch.float64)
        ray = (cameras.world_from_px[view] @ pixel).numpy()
        across = np.eye(3) - np.outer(ray, ray) / (ray @ ray)
        A, b = A + across, b + across @ cameras.centers[view].numpy()
    center = np.linalg.solve(A + 1e-9 * np.eye(3), b)
    view, member = next(iter(masks.items()))
    distance = np.linalg.norm(cameras.centers[view].numpy() - center)
    side = 1.5 * float(regions.crop_sizes[member].max()) * distance / float(cameras.K[view, 0, 0])
    line = np.linspace(-side / 2, side / 2, CELLS)
    points = np.stack(np.meshgrid(line, line, line, indexing="ij"), -1).reshape(-1, 3) + center
    px, depth = cameras.project(torch.from_numpy(points))
    inside = np.ones(len(points), bool)
    for view, member in masks.items():
        mask = regions.mask(member, *sizes[view]).numpy()
        column, row = px[view].floor().long().numpy().T
        height, width = mask.shape
        shown = (depth[view].numpy() > 0) & (column >= 0) & (row >= 0) & (column < width) & (row < height)
        inside[~shown] = False
        inside[shown] &= mask[row[shown], column[shown]]
    volume = np.pad(inside.reshape(CELLS, CELLS, CELLS), 1).astype(np.float32)
    if not volume.any():
        return trimesh.Trimesh()
    vertices, faces, _, _ = marching_cubes(volume, 0.5)
    return trimesh.Trimesh(vertices, faces)
