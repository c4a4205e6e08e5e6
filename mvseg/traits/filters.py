"""Which instances are no leaves to be measured, and why."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from types import MappingProxyType
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from mvseg.reconstruction.surface.leaf_surface import LeafSurface
from mvseg.reconstruction.voxels import VoxelGrid
from mvseg.traits.config import TraitsConfig

Floats = NDArray[np.float64]
# The first ones are the gravest.
Kind = Literal["few_sure_views", "low_quality", "hardly_visible", "stem", "floor", "beside_the_plant"]

SURELY_STEM = 0.9  # chosen: probability from which an instance is a stem, see `TubeEvidence`
# Found on simulated plants with masks of a tape on the floor, and on a real basil; see docs/traits.md.
FLOOR_AREA = 1.8  # chosen: times that of the largest other instance
FAR = 2.0  # chosen: lengths of the longest instance but one, from instance to instance
FEWEST = 3  # chosen: instances, for floor and distance to be told
NUM_POINTS = 400  # limit: of a shape, for distances


@dataclass(frozen=True)
class Rejection:
    """Why an instance is not measured: the kind, which is counted, and a sentence."""

    kind: Kind
    reason: str


@dataclass(frozen=True, eq=False)
class _Body:
    """Place and size of an instance.

    Attributes:
        points: (P, 3) on it.
        deviations: (3,) standard deviations along its principal axes, the largest first.
        area: one-sided.
    """

    points: Floats
    deviations: Floats
    area: float

    @staticmethod
    def of(shape: LeafSurface | VoxelGrid) -> _Body:
        every = shape.points().reshape(-1, 3) if isinstance(shape, LeafSurface) else shape.points
        points = every.cpu().numpy()
        variances = np.linalg.eigvalsh(np.cov(points.T, bias=True))
        deviations = np.sqrt(np.maximum(variances[::-1], 0))
        few = points[:: max(1, len(points) // NUM_POINTS)]
        area = shape.area if isinstance(shape, LeafSurface) else 12 * float(deviations[0] * deviations[1])
        return _Body(few, deviations, area=area)

    @property
    def length(self) -> float:
        """Roughly from end to end."""
        return float(np.sqrt(12) * self.deviations[0])


def find_rejected(
    shapes: Mapping[int, LeafSurface | VoxelGrid],
    up: Floats | None,
    *,
    config: TraitsConfig,
    sure_views: Mapping[int, int] = MappingProxyType({}),
    visible_shares: Mapping[int, float] = MappingProxyType({}),
    stems: Mapping[int, float] = MappingProxyType({}),
) -> dict[int, Rejection]:
    """The instances that are not measured as leaves.

    Args:
        shapes: {instance id: its shape}, instances without one left out.
        up: (3,) unit vector; None: not known, so that the floor is not told.
        config: what is asked of a leaf.
        sure_views: {instance id: views with a sure match}; empty where the matcher gives no probabilities.
        visible_shares: {instance id: share of its surface, over all photos, that its masks cover}, of those with a
            surface.
        stems: {instance id of a long instance: probability that it is a stem}.

    Returns:
        {instance id: why}: the gravest of several reasons, see `Kind`.
    """
    ious = {instance: median_iou(shape) for instance, shape in shapes.items() if isinstance(shape, LeafSurface)}
    share = "its masks cover a share of {:.2f} of its surface, asked for is {:g}"
    limits: tuple[tuple[Kind, Mapping[int, float], float, str], ...] = (
        ("hardly_visible", visible_shares, config.min_visible_share, share),
        ("low_quality", ious, config.min_quality, "median IoU {:.2f} with its masks, asked for is {:g}"),
        ("few_sure_views", sure_views, config.min_sure_views, "{} sure views, asked for are {}"),
    )
    rejections: dict[int, Rejection] = {}
    for kind, values, least, reason in limits:
        below = {instance: value for instance, value in values.items() if value < least}
        rejections |= {instance: Rejection(kind, reason.format(value, least)) for instance, value in below.items()}
    if not config.leaves_only:
        return rejections
    for instance, chance in stems.items():
        if chance >= SURELY_STEM and instance not in rejections:
            reason = f"looks like a stem: a tube explains its masks, probability {chance:.2f}"
            rejections[instance] = Rejection("stem", reason)
    bodies = {instance: _Body.of(shape) for instance, shape in shapes.items() if instance not in rejections}
    rules: list[Callable[[dict[int, _Body]], dict[int, Rejection]]] = [find_distant]
    if up is not None:
        rules = [partial(find_floor, up=up), *rules]
    for rule in rules:
        rejections |= rule({instance: body for instance, body in bodies.items() if instance not in rejections})
    return dict(sorted(rejections.items()))


def median_iou(surface: LeafSurface) -> float:
    """Median IoU of a surface with its masks; 0 where that is not known."""
    iou = surface.iou[surface.iou.isfinite()]
    return float(iou.median()) if len(iou) else 0.0


def find_floor(bodies: Mapping[int, _Body], up: Floats) -> dict[int, Rejection]:
    """Find the floor: it lies below everything else, and is far larger."""
    if len(bodies) < FEWEST:
        return {}
    tops = {instance: float((body.points @ up).max()) for instance, body in bodies.items()}
    lowest = min(tops, key=lambda instance: tops[instance])
    others = [body for instance, body in bodies.items() if instance != lowest]
    if tops[lowest] >= min(float((body.points @ up).min()) for body in others):
        return {}
    ratio = bodies[lowest].area / max(max(body.area for body in others), 1e-300)
    if ratio <= FLOOR_AREA:
        return {}
    reason = f"looks like the floor: below everything else, and {ratio:.1f} times the largest leaf"
    return {lowest: Rejection("floor", reason)}


def find_distant(bodies: Mapping[int, _Body]) -> dict[int, Rejection]:
    """Find instances that no chain of short steps, from instance to instance, joins with most of the others."""
    if len(bodies) < FEWEST:
        return {}
    length = sorted(body.length for body in bodies.values())[-2]  # the longest one may be what lies beside the plant
    trees = [cKDTree(body.points) for body in bodies.values()]
    gaps = np.array([[tree.query(body.points)[0].min() for tree in trees] for body in bodies.values()])
    _, group = connected_components(gaps <= FAR * length, directed=False)
    sizes = np.bincount(group)
    if sizes.max() <= len(bodies) / 2:
        return {}
    plant = group == sizes.argmax()
    away, rejections = gaps[:, plant].min(1) / length, {}
    for instance, steps, is_plant in zip(bodies, away, plant, strict=True):
        if not is_plant:
            reason = f"lies beside the plant: {steps:.1f} lengths of a large leaf away from it"
            rejections[instance] = Rejection("beside_the_plant", reason)
    return rejections
