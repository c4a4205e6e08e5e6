"""Distance of a shape from the true one: d(I, T) of Sec. 4.3."""

from __future__ import annotations

from scipy.spatial import cKDTree
from torch import Tensor


def shape_distance(points: Tensor, truth: Tensor) -> float:
    """d(I, T) of Sec. 4.3: mean of the two mean nearest-neighbour distances between two point sets.

    Args:
        points: (P, 3) reconstructed points, on any device.
        truth: (Q, 3) true points.

    Returns:
        The distance in world units (the paper divides it by the mean leaf length); NaN when a set is empty.
    """
    if not len(points) or not len(truth):
        return float("nan")
    first, second = points.double().cpu().numpy(), truth.double().cpu().numpy()
    to_truth = cKDTree(second).query(first)[0].mean()
    to_points = cKDTree(first).query(second)[0].mean()
    return float((to_truth + to_points) / 2)
