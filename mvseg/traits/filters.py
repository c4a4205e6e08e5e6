"""Instances that are no leaves to be measured, and why."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Literal

from mvseg.reconstruction.surface.leaf_surface import LeafSurface
from mvseg.traits.config import TraitsConfig

# The first ones are the gravest.
Kind = Literal["few_sure_views", "low_quality", "hardly_visible", "stem"]

SURELY_STEM = 0.9  # chosen: probability from which an instance is a stem, see `stem_chances`


@dataclass(frozen=True)
class Rejection:
    """Why an instance is not measured: the kind, which is counted, and a sentence."""

    kind: Kind
    reason: str


def find_rejected(
    surfaces: Mapping[int, LeafSurface],
    *,
    config: TraitsConfig,
    sure_views: Mapping[int, int] = MappingProxyType({}),
    visible_shares: Mapping[int, float] = MappingProxyType({}),
    stems: Mapping[int, float] = MappingProxyType({}),
) -> dict[int, Rejection]:
    """The instances that are not measured as leaves, {instance id: the gravest of its reasons, see `Kind`}.

    Args:
        sure_views: {instance id: views with a sure match}; empty where the matcher gives no probabilities.
        visible_shares: {instance id: share of its surface, over all photos, that its masks cover}.
        stems: {instance id of a long instance: probability that it is a stem}.
    """
    ious = {instance: median_iou(surface) for instance, surface in surfaces.items()}
    share = "its masks cover a share of {:.2f} of its surface, asked for is {:g}"
    limits: tuple[tuple[Kind, Mapping[int, float], float, str], ...] = (
        ("hardly_visible", visible_shares, config.min_visible_share, share),
        ("low_quality", ious, config.min_quality, "median IoU {:.2f} with its masks, asked for is {:g}"),
        ("few_sure_views", sure_views, config.min_sure_views, "{} sure views, asked for are {}"),
    )
    slender = "looks like a stem: it is slender for its plant, probability {:.2f}"
    sure = {n: chance for n, chance in stems.items() if chance >= SURELY_STEM and config.leaves_only}
    rejections = {instance: Rejection("stem", slender.format(chance)) for instance, chance in sure.items()}
    for kind, values, least, reason in limits:
        below = {instance: value for instance, value in values.items() if value < least}
        rejections |= {instance: Rejection(kind, reason.format(value, least)) for instance, value in below.items()}
    return dict(sorted(rejections.items()))


def median_iou(surface: LeafSurface) -> float:
    """Median IoU of a surface with its masks; 0 where that is not known."""
    iou = surface.iou[surface.iou.isfinite()]
    return float(iou.median()) if len(iou) else 0.0
