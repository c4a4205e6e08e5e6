"""MVS-based matching (Sec. 4.2): regions correspond where the dense points of multi-view stereo project."""

from __future__ import annotations

import torch
from torch import Tensor

from benchmarks.baselines.edges import edge_graph, match_graph
from mvseg.errors import InputError
from mvseg.matching.affinity import Affinity
from mvseg.matching.match import check_views
from mvseg.matching.result import Matching
from mvseg.regions import Regions
from mvseg.scene import Cameras, Scene

MVS = "mvs (sgbm)"  # name of the method, with that of the stereo (see `dense_points`)
NEAREST_SHARE = 0.1  # of the points in a region; their centroid stands for the region


def match_mvs(regions: Regions, scene: Scene, points: Tensor) -> Matching:
    """Match regions by dense world points (P, 3) (Sec. 4.2, "MVS-based matching"). A region that no point projects into
    has edges only from the points of other regions; a region without any edge is -1. Raises InputError: no points at
    all ("N/A" in the paper's tables), or see `check_views`."""
    check_views(regions, scene.cameras)
    if not len(points):
        raise InputError(f"multi-view stereo (sgbm) found no points in scene '{scene.name}': no matching")
    graph = projection_graph(regions, scene.cameras.to(regions.device), points.to(regions.device))
    return match_graph(graph, regions, method=MVS)


def projection_graph(regions: Regions, cameras: Cameras, points: Tensor) -> Affinity:
    """An edge from each region to every region of another view that its 3D position projects into.

    Args:
        regions: D regions; where they overlap the smallest counts.
        cameras: V cameras, on the device of the regions.
        points: (P, 3) world positions.
    """
    anchors = region_points(regions, cameras, points)
    pixels, depth = cameras.project(anchors)
    index = torch.arange(len(regions), device=regions.device)
    pairs = [torch.zeros(0, 2, dtype=torch.int64, device=regions.device)]
    for view in range(len(cameras)):
        width, height = cameras.sizes[view].tolist()
        frame = regions.label_map(view, index + 1, (width, height))
        is_inside = (depth[view] > 0) & (pixels[view] >= 0).all(1) & (pixels[view] < cameras.sizes[view]).all(1)
        senders = index[is_inside & (regions.view_index != view)]
        column, row = pixels[view, senders].long().unbind(1)
        hit = frame[row, column] - 1
        pairs.append(torch.stack((senders, hit), 1)[hit >= 0])
    return edge_graph(torch.cat(pairs), len(regions))


def region_points(regions: Regions, cameras: Cameras, points: Tensor) -> Tensor:
    """The 3D position that stands for each region: the centroid of the nearest 10 % of the points that project into it.

    Nearest to the camera's centre; at least one point. Points behind other surfaces are not recognised as such, as in
    the paper: taking the nearest points is what keeps them out.

    Args:
        regions: D regions.
        cameras: V cameras.
        points: (P, 3) world positions.

    Returns:
        (D, 3) float64 world positions; NaN for a region that no point projects into.
    """
    anchors = torch.full((len(regions), 3), torch.nan, dtype=torch.float64, device=regions.device)
    for view in range(len(cameras)):
        members = (regions.view_index == view).nonzero()[:, 0].tolist()
        pixels, depth = cameras[[view]].project(points) if members else (points[None], points[None])
        for index in members:
            x1, y1, x2, y2 = regions.boxes[index].tolist()
            u, v = pixels[0].unbind(1)
            in_box = ((depth[0] > 0) & (u >= x1) & (u < x2) & (v >= y1) & (v < y2)).nonzero()[:, 0]
            column, row = pixels[0, in_box].long().unbind(1)
            inside = points[in_box[regions.crop(index)[row - y1, column - x1]]]
            if len(inside):
                distance = torch.linalg.vector_norm(inside - cameras.centers[view], dim=1)
                count = -(-len(inside) // round(1 / NEAREST_SHARE))
                anchors[index] = inside[distance.argsort(stable=True)[:count]].mean(0)
    return anchors
