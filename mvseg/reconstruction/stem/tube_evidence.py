"""Tube against patch: evidence that a candidate is a stem, not a leaf.

A leaf changes its apparent width as one walks round it; a stem does not. And a flat patch explains the masks of a stem
worse than a tube does.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from torch import Tensor

from mvseg.arrays import Floats
from mvseg.reconstruction.numbers import FIT, TUBE
from mvseg.reconstruction.spread_views import spread_views
from mvseg.reconstruction.stem.fit_tube import apparent_widths, believe_offsets, fit_tube, midrib_of
from mvseg.reconstruction.stem.tube import Tube
from mvseg.reconstruction.surface.fit_surfaces import instance_frames, stack_instance
from mvseg.reconstruction.surface.leaf_surface import LeafSurface
from mvseg.reconstruction.surface.mask_errors import learn_mask_errors
from mvseg.reconstruction.surface.mask_stack import MaskStack
from mvseg.reconstruction.surface.patch_image import view_ious
from mvseg.regions import Regions
from mvseg.scene import Cameras

WEIGHTS = (40.82, -8.21, 1.88, 0.38)  # fitted: python benchmarks/stems.py --cache DIR --evidence
UNKNOWN = (-1.0, 0.3)  # chosen: gain and width change where the views do not tell


@dataclass(frozen=True, eq=False)
class TubeEvidence:
    """Evidence that a candidate is a stem; NaN where the views do not tell.

    Attributes:
        gain: median IoU by which the tube explains the masks better than the surface does, on the same pixels; negative
            for leaves.
        width_change: by how much views differ in the width of the same place: standard deviation of logarithms, median
            along the tube, minus the effect of pixels and of masks too large or small. About 0 for stems.
        relative_aspect: length over width of its surface, over the median of the plant's surfaces. Leaves that are long
            and narrow are so on the whole plant.
    """

    tube: Tube
    gain: float
    width_change: float
    relative_aspect: float

    @property
    def features(self) -> tuple[float, float, float, float]:
        """Gain, width change, logarithm of the relative aspect, and 1: `WEIGHTS` weigh them."""
        gain, change = (
            value if np.isfinite(value) else default
            for value, default in zip((self.gain, self.width_change), UNKNOWN, strict=True)
        )
        return gain, change, float(np.log(self.relative_aspect)), 1.0

    @property
    def probability(self) -> float:
        """How likely the candidate is a stem, where there are eight leaves to a stem."""
        return float(1 / (1 + np.exp(-np.dot(WEIGHTS, self.features))))


def tube_evidence(
    regions: Regions,
    instance_ids: Tensor,
    cameras: Cameras,
    *,
    surfaces: Mapping[int, LeafSurface],
    least_aspect: float = 0.0,
) -> dict[int, TubeEvidence]:
    """Fit a tube to every instance whose surface is long enough, and compare the two.

    Args:
        regions: D regions. Those matched to nothing hide others as well.
        instance_ids: (D,) int64, from 1 on; -1 = no instance.
        surfaces: {instance id: surface}; rough ones will do.
        least_aspect: min. `TubeEvidence.relative_aspect`; stems have more than `TUBE.least_aspect`.
    """
    if not any(surface.exists for surface in surfaces.values()):
        return {}
    regions, cameras, instance_ids = regions.to("cpu"), cameras.to("cpu"), instance_ids.cpu()
    frames = instance_frames(regions, instance_ids, cameras)
    offsets = [each.offsets_px[each.offsets_px.isfinite()].numpy() for each in surfaces.values() if each.exists]
    errors = learn_mask_errors([each for each in offsets if len(each) > 1])
    sd_px, evidence = 0.0 if errors is None else errors.sd_px, {}
    usual_aspect = float(np.median([each.length / each.width for each in surfaces.values() if each.exists]))
    for instance, surface in sorted(surfaces.items()):
        if not surface.exists or surface.length < least_aspect * usual_aspect * surface.width:
            continue
        members = regions.select((instance_ids == instance) & (regions.areas > 0))
        views = members.view_index.unique()
        if len(views) < 2:
            continue
        chosen = views[spread_views(cameras[views], TUBE.most_views)]
        members = members.select((members.view_index[:, None] == chosen).any(1))
        masks = stack_instance(members, cameras, frames, instance=instance)
        evidence[instance] = compare_tube(masks, surface, usual_aspect=usual_aspect, mask_sd_px=sd_px)
    return evidence


def compare_tube(
    masks: MaskStack, surface: LeafSurface, *, usual_aspect: float, mask_sd_px: float = 0.0
) -> TubeEvidence:
    """The evidence of the masks of one candidate with a surface, which must exist. `usual_aspect` is the median length
    over width of the plant's surfaces; `mask_sd_px` as in `fit_tube`."""
    relative_aspect = surface.length / surface.width / usual_aspect
    tube = fit_tube(masks, midrib_of(surface.coefficients.numpy()), mask_sd_px=mask_sd_px)
    if not tube.exists:
        return TubeEvidence(tube, float("nan"), float("nan"), relative_aspect)
    gain = float(np.median(tube.iou) - np.median(patch_ious(masks, surface, mask_sd_px=mask_sd_px)))
    return TubeEvidence(tube, gain, width_change(masks, tube, mask_sd_px=mask_sd_px), relative_aspect)


def patch_ious(masks: MaskStack, surface: LeafSurface, *, mask_sd_px: float) -> Floats:
    """(S,) IoU of a surface and the mask in each view, drawn too large or small as the mask is believed to be."""
    offsets_of = dict(zip(surface.views.tolist(), surface.offsets_px.tolist(), strict=False))
    measured = np.array([offsets_of.get(view, np.nan) for view in masks.views.tolist()])
    offsets = believe_offsets(measured, mask_sd_px / masks.pixel_size)
    return view_ious(masks, surface.points(*FIT.grid).numpy(), offsets=offsets)


def width_change(masks: MaskStack, tube: Tube, *, mask_sd_px: float) -> float:
    """How much the apparent width differs between views (see `TubeEvidence`). NaN where no place is seen by
    `TUBE.least_views` views."""
    widths, pixels = apparent_widths(masks, tube.axis)
    is_seen = np.isfinite(widths)
    places = is_seen.sum(0) >= TUBE.least_views
    if not places.any():
        return float("nan")
    logs = np.log(widths[:, places])
    # Masks that are too large as a whole are so on both sides.
    sd_px = max(TUBE.width_noise_px, 2 * mask_sd_px / masks.pixel_size)
    noise = (sd_px / np.maximum(pixels[:, places], 1)) ** 2
    change = np.nanvar(logs, axis=0, ddof=1) - np.nanmean(np.where(is_seen[:, places], noise, np.nan), axis=0)
    return float(np.sqrt(max(np.median(change), 0)))
