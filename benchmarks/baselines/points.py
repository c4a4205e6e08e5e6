"""Point-based matching (Sec. 4.2): epipolar lines of centroids in place of epipolar bands of regions."""

from __future__ import annotations

import torch
from torch import Tensor

from benchmarks.baselines.edges import edge_graph, match_graph
from mvseg.matching.affinity import Affinity
from mvseg.matching.match import check_views
from mvseg.matching.pencil import is_coincident
from mvseg.matching.result import Matching
from mvseg.regions import Regions
from mvseg.scene import Cameras, Scene

PARALLEL = 1e-12  # squared sine of the angle of two rays below which they have no nearest points


def match_points(regions: Regions, scene: Scene) -> Matching:
    """Match regions by the rays through their centroids (Sec. 4.2, "Point-based matching"). Raises InputError: see
    `check_views`."""
    check_views(regions, scene.cameras)
    graph = nearest_ray_graph(regions, scene.cameras.to(regions.device))
    return match_graph(graph, regions, method="points")


def nearest_ray_graph(regions: Regions, cameras: Cameras) -> Affinity:
    """An edge from each region to the region of each other view whose ray passes nearest in 3D.

    The epipolar line of a centroid is the image of its viewing ray, so the "nearest epipolar lines in 3D space" of the
    paper are the nearest rays. The distance is in world units and without a limit, as in the paper: every region has
    an edge to every other view that has regions. Exceptions: two views with the same centre have no edges (all their
    rays meet), and neither do regions whose rays come nearest behind a camera.

    Args:
        regions: D regions; of two that are equally near the first is taken.
        cameras: V cameras, on the device of the regions.
    """
    centers, rays = centroid_rays(regions, cameras)
    skip = is_coincident(cameras)
    members = [(regions.view_index == view).nonzero()[:, 0] for view in range(len(cameras))]
    pairs = [torch.zeros(0, 2, dtype=torch.int64, device=regions.device)]
    for i, here in enumerate(members):
        for j, there in enumerate(members):
            if skip[i, j] or not len(here) or not len(there):
                continue
            distance = pairwise_ray_distance((centers[here], rays[here]), (centers[there], rays[there]))
            least, nearest = distance.min(1)
            pairs.append(torch.stack((here, there[nearest]), 1)[least.isfinite()])
    return edge_graph(torch.cat(pairs), len(regions))


def centroid_rays(regions: Regions, cameras: Cameras) -> tuple[Tensor, Tensor]:
    """The viewing rays through the centroids of D masks: their origins (D, 3) and unit directions (D, 3), float64,
    world frame. A mask without pixels has no ray (NaN)."""
    xy, owner = regions.pixels()
    total = torch.zeros(len(regions), 2, dtype=torch.float64, device=regions.device).index_add_(0, owner, xy.double())
    centroids = total / regions.areas[:, None]
    homogeneous = torch.nn.functional.pad(centroids, (0, 1), value=1.0)
    rays = (cameras.world_from_px[regions.view_index] @ homogeneous[:, :, None])[:, :, 0]
    return cameras.centers[regions.view_index], rays / torch.linalg.vector_norm(rays, dim=1, keepdim=True)


def pairwise_ray_distance(first: tuple[Tensor, Tensor], second: tuple[Tensor, Tensor]) -> Tensor:
    """Distance between the rays of two views where they come nearest.

    Args:
        first: origins (N, 3) and unit directions (N, 3) of the rays of one view.
        second: (M, 3) and (M, 3) of the other.

    Returns:
        (N, M), world units; for parallel rays the distance between their lines; infinite where the nearest points lie
        behind an origin, or a ray is NaN.
    """
    shift = second[0] - first[0][:, None]
    u, v = first[1][:, None].expand_as(shift), second[1].expand_as(shift)
    cosine, along_u, along_v = (u * v).sum(2), (shift * u).sum(2), (shift * v).sum(2)
    sine_sq = torch.linalg.cross(u, v).square().sum(2)  # of tiny angles 1 - cosine^2 would be noise
    is_parallel = sine_sq <= PARALLEL
    scale = 1 / sine_sq.clamp(min=PARALLEL)
    s, t = (along_u - cosine * along_v) * scale, (cosine * along_u - along_v) * scale  # how far along each ray
    across = shift - along_u[..., None] * u
    gap = torch.where(is_parallel[..., None], across, s[..., None] * u - shift - t[..., None] * v)
    is_ahead = is_parallel & (cosine > 0) | ~is_parallel & (s > 0) & (t > 0)
    return torch.where(is_ahead, torch.linalg.vector_norm(gap, dim=2), torch.inf)
