"""Matching by sparse feature correspondences (Sec. 4.2): keypoints matched between photos, counted inside regions."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import torch
from torch import Tensor

from benchmarks.baselines.edges import edge_graph, match_graph
from mvseg.formats.photos import read_photo
from mvseg.matching.affinity import Affinity
from mvseg.matching.match import check_views
from mvseg.matching.result import Matching
from mvseg.regions import Regions
from mvseg.scene import Cameras, Scene

MAX_RATIO = 0.8  # of the distances to the nearest and to the second nearest descriptor


@dataclass(frozen=True, eq=False)
class Keypoints:
    """The P keypoints of one photo.

    Attributes:
        xy: (P, 2) float64, pixels.
        descriptors: (P, C) float32 integers, so that distances are exact; a binary descriptor has one column per bit,
            and its squared distance is the Hamming distance.
    """

    xy: Tensor
    descriptors: Tensor


def match_sparse(regions: Regions, scene: Scene) -> Matching:
    """Match regions by the keypoints that they share (Sec. 4.2, "sparse feature correspondences").

    The paper's AKAZE is used where OpenCV has it: 4.x, or 5 with its contributed modules. Plain OpenCV 5 has only SIFT
    left, which then takes its place. The method, "sparse (akaze)" or "sparse (sift)", says which one ran: tables must
    not mix the two. Regions that share no keypoint with any are -1. Raises InputError: fewer than two views, regions
    and cameras of different numbers of views, or a photo that is missing or broken.
    """
    check_views(regions, scene.cameras)
    detector, name = keypoint_detector()
    keypoints = [find_keypoints(read_photo(scene, view), detector) for view in range(len(scene.views))]
    graph = keypoint_graph(regions, scene.cameras, keypoints)
    return match_graph(graph, regions, method=f"sparse ({name})")


def keypoint_detector() -> tuple[Any, str]:
    """OpenCV's AKAZE with its default settings where this OpenCV has it, else SIFT; and its name."""
    for module in (cv2, getattr(cv2, "xfeatures2d", None)):
        create = getattr(module, "AKAZE_create", None)
        if create is not None:
            return create(), "akaze"
    return cv2.SIFT.create(enable_precise_upscale=True), "sift"  # else a quarter of a pixel off


def find_keypoints(photo: np.ndarray, detector: Any) -> Keypoints:
    """The keypoints of a photo (H, W, 3) uint8 RGB; OpenCV counts from the centre of the first pixel."""
    points, descriptors = detector.detectAndCompute(cv2.cvtColor(photo, cv2.COLOR_RGB2GRAY), None)
    if not points:
        return Keypoints(torch.zeros(0, 2, dtype=torch.float64), torch.zeros(0, 1))
    if descriptors.dtype == np.uint8:
        descriptors = np.unpackbits(descriptors, axis=1)
    xy = torch.tensor([point.pt for point in points], dtype=torch.float64) + 0.5
    return Keypoints(xy, torch.from_numpy(descriptors.astype(np.float32)))


def match_keypoints(first: Keypoints, second: Keypoints) -> Tensor:
    """(T, 2) int64: pairs of keypoints that are each other's nearest, and much nearer than the second nearest.

    A photo with fewer than two keypoints has no second nearest, and so no match.
    """
    if min(len(first.xy), len(second.xy)) < 2:
        return torch.zeros(0, 2, dtype=torch.int64)
    a, b = first.descriptors, second.descriptors
    squared = a.square().sum(1)[:, None] + b.square().sum(1) - 2 * a @ b.T
    # The ratio is between Hamming distances for bits, and between Euclidean ones otherwise.
    distance = squared if a.max() <= 1 else squared.clamp(min=0).sqrt()
    forth, back = distance.topk(2, 1, largest=False), distance.topk(2, 0, largest=False)
    here, there = torch.arange(len(a)), forth.indices[:, 0]
    is_clear = forth.values[:, 0] < MAX_RATIO * forth.values[:, 1]
    is_clear &= back.values[0, there] < MAX_RATIO * back.values[1, there]
    keep = is_clear & (back.indices[0, there] == here)
    return torch.stack((here, there), 1)[keep]


def keypoint_graph(regions: Regions, cameras: Cameras, keypoints: list[Keypoints]) -> Affinity:
    """An edge from each region to the region of each other view that it shares most keypoints with, if any.

    Where regions overlap a keypoint belongs to the smallest. Where several regions share equally many, each gets an
    edge: the order of the regions must not matter.
    """
    sizes = cameras.sizes.tolist()
    owners = [keypoint_owners(regions, points, view=view, size=sizes[view]) for view, points in enumerate(keypoints)]
    chosen = [torch.zeros(0, 2, dtype=torch.int64)]
    num_regions = len(regions)
    for i in range(len(keypoints)):
        for j in range(i + 1, len(keypoints)):
            matches = match_keypoints(keypoints[i], keypoints[j])
            n, m = owners[i][matches[:, 0]], owners[j][matches[:, 1]]
            inside = (n >= 0) & (m >= 0)
            shared, count = (n * num_regions + m)[inside].unique(return_counts=True)
            n, m = shared // max(num_regions, 1), shared % max(num_regions, 1)
            for chooser in (n, m):
                most = torch.zeros(num_regions, dtype=torch.int64).scatter_reduce(0, chooser, count, "amax")
                chosen.append(torch.stack((n, m), 1)[count == most[chooser]])
    return edge_graph(torch.cat(chosen).to(regions.device), num_regions)


def keypoint_owners(regions: Regions, keypoints: Keypoints, *, view: int, size: list[int]) -> Tensor:
    """(P,) int64: the region that each keypoint of a view lies in, -1 for none; `size` is the photo's width, height."""
    width, height = size
    numbers = torch.arange(1, len(regions) + 1, device=regions.device)
    frame = regions.label_map(view, numbers, (width, height)).cpu()
    column, row = keypoints.xy.long().unbind(1)
    return frame[row.clamp(0, height - 1), column.clamp(0, width - 1)] - 1
