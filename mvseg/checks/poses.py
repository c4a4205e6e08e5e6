"""Agreement of masks with poses, judged by the epipolar lines tangent to the masks, without any matching.

A leaf that is fully visible in two photos is tangent to the same two half-planes of the views' pencil: its mask begins
and ends at the same angles in both. So with correct poses many masks of a view have a mask in another view with the
same tangents, to the pixel. With wrong poses this happens by chance only, and its frequency is measured by shifting the
masks of the other view along the angles. The shift at which most masks agree is the error of the epipolar lines: 0 for
correct poses. Missing, merged and partly hidden masks reduce the agreement, but do not shift it.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mvseg.arrays import Floats
from mvseg.checks.masks import touches_border, without_small_components
from mvseg.checks.numbers import AGREEMENT
from mvseg.findings.finding import Finding, Level, Rule, list_findings
from mvseg.matching.pencil import Pencil, epipolar_pencil, is_coincident
from mvseg.regions import Regions
from mvseg.scene import Cameras
from mvseg.system.running import progress_bar


@dataclass(frozen=True, eq=False)
class PoseAgreement:
    """How the masks of each pair of V views agree; symmetric, nan for pairs that were not compared.

    Attributes:
        fitting: (V, V) share of the masks of both views whose best partner in the other view fits better than under any
            move of the other view's masks; by chance it is about 0.06.
        num_masks: (V, V) int64, masks of both views that were compared.
        offset: (V, V) units; distance by which the epipolar lines miss: the shift at which most masks agree.
        unit_px: pixels per unit of `offset`; the offset is not known more exactly.
    """

    fitting: Floats
    num_masks: NDArray[np.int64]
    offset: Floats
    unit_px: float


@dataclass(frozen=True, eq=False)
class ViewAgreement:
    """How each view agrees with those that agree among each other.

    Attributes:
        fitting: (V,) as in `PoseAgreement`, over all of these; nan for a view that was compared with none.
        offset_px: (V,) by how much epipolar lines miss in at least 70 % of these, pixels.
        off: views that agree with none of them.
        agree: whether most of the views agree; if not, `off` is empty.
    """

    fitting: Floats
    offset_px: Floats
    off: tuple[int, ...]
    agree: bool


@dataclass(frozen=True, eq=False)
class _Spans:
    """Ends of N masks in a pencil: (N, 2) radians, and (N, 2) radians per pixel there."""

    ends: Tensor
    pitch: Tensor


def pairwise_agreement(regions: Regions, cameras: Cameras) -> PoseAgreement:
    """How the masks of each pair of views agree with the poses. Masks that touch the border are left out: where they
    would end is not known. With more than 20 other views, each is compared with 20 or more of them."""
    num_views = len(cameras)
    regions, cameras = regions.to("cpu"), cameras.to("cpu")
    regions = regions.select(~touches_border(regions, cameras))
    corners = _hull_corners(regions)
    hulls = [corners[regions.view_index == view] for view in range(num_views)]
    fitting, offset = np.full((2, num_views, num_views), np.nan)
    num_masks = np.zeros((num_views, num_views), np.int64)
    unit_px = cameras.unit_px
    skip = is_coincident(cameras).tolist()
    pairs = [(i, j) for i, j in _chosen_pairs(num_views) if len(hulls[i]) and len(hulls[j]) and not skip[i][j]]
    for i, j in progress_bar(pairs, name="checking cameras", unit="pair"):
        pencil = epipolar_pencil(cameras, i, j)
        first, second = _spans(pencil, 0, hulls[i]), _spans(pencil, 1, hulls[j])
        if len(first.ends) and len(second.ends):
            is_fitting = torch.cat(_beats_chance(first, second))
            num_masks[i, j] = num_masks[j, i] = len(is_fitting)
            fitting[i, j] = fitting[j, i] = float(is_fitting.double().mean())
            offset[i, j] = offset[j, i] = _offset(first, second, unit_px)
    return PoseAgreement(fitting=fitting, num_masks=num_masks, offset=offset, unit_px=unit_px)


def view_agreement(pairs: PoseAgreement) -> ViewAgreement:
    """Find the views that agree: the worst one that agrees with none is set apart, again and again, until the others
    agree. A view agrees with none if hardly more of its masks fit than by chance, and the lines miss in most other
    views. The rest must be more than half of the views, and at least two."""
    num_views = len(pairs.fitting)
    agreeing, off = list(range(num_views)), []
    while len(agreeing) > 1:
        fitting, offset = _against(pairs, agreeing)
        is_off = [view for view in agreeing if fitting[view] < AGREEMENT.off and offset[view] >= AGREEMENT.offset]
        if not is_off:
            break
        worst = min(is_off, key=lambda view: (fitting[view], -offset[view]))
        agreeing.remove(worst)
        off.append(worst)
    agree = len(agreeing) > max(1, num_views / 2)
    fitting, offset = _against(pairs, agreeing if agree else list(range(num_views)))
    alone = tuple(sorted(off)) if agree else ()
    return ViewAgreement(fitting=fitting, offset_px=offset * pairs.unit_px, off=alone, agree=agree)


def pose_findings(pairs: PoseAgreement, names: tuple[str, ...]) -> list[Finding]:
    """Views whose poses and masks contradict the others. An error for each view that agrees with none, or one for the
    whole scene if most do not (warnings where views or masks are few); a warning for lines that miss a little. Nothing
    where there are no masks to compare."""
    view = view_agreement(pairs)
    if not (pairs.num_masks > 0).any():
        return []
    level: Level = "error" if is_sure(pairs) else "warning"
    if not view.agree:
        share, px = float(np.nanmedian(view.fitting)), float(np.nanmedian(view.offset_px))
        return list_findings([("poses_disagree", level, None, {"share": share, "px": px})], names)
    share_of, px_of = view.fitting.tolist(), view.offset_px.tolist()
    rules: list[Rule] = [("view_off", level, (n,), {"share": share_of[n], "px": px_of[n]}) for n in view.off]
    missed = np.flatnonzero(view.offset_px >= AGREEMENT.offset * pairs.unit_px).tolist()
    missing = [index for index in missed if index not in view.off] if len(names) >= AGREEMENT.few_views else []
    most = float(view.offset_px[missing].max(initial=0))
    return list_findings([*rules, ("lines_miss", "warning", missing, {"px": most})], names)


def is_sure(pairs: PoseAgreement) -> bool:
    """Whether views and masks are enough for an error; there must be masks to compare."""
    enough = np.median(pairs.num_masks[pairs.num_masks > 0]) >= AGREEMENT.few_masks
    return bool(enough and len(pairs.fitting) >= AGREEMENT.few_views)


def _against(pairs: PoseAgreement, agreeing: list[int]) -> tuple[Floats, Floats]:
    fitting, offset = np.full((2, len(pairs.fitting)), np.nan)
    for view in range(len(fitting)):
        others = [other for other in agreeing if other != view and pairs.num_masks[view, other]]
        if others:
            fitting[view] = np.average(pairs.fitting[view, others], weights=pairs.num_masks[view, others])
            offset[view] = np.quantile(pairs.offset[view, others], AGREEMENT.most_agree)
    return fitting, offset


def _chosen_pairs(num_views: int) -> list[tuple[int, int]]:
    """Neighbours, far views, and some between. A step of the list reaches one view on either side."""
    steps = np.linspace(1, num_views - 1, min(num_views - 1, AGREEMENT.most_partners)).round().astype(int)
    return [(i, i + step) for step in dict.fromkeys(steps.tolist()) for i in range(num_views - step)]


def _hull_corners(regions: Regions) -> Tensor:
    """(D, P, 2) float64 corners of the regions' hulls, pixel centres; the first is repeated where there are fewer."""
    whole = (cv2.findNonZero(without_small_components(regions.crop(index).numpy())) for index in range(len(regions)))
    corners = zip(map(cv2.convexHull, whole), regions.boxes[:, None, :2].numpy(), strict=True)
    hulls = [torch.from_numpy(hull[:, 0] + corner + 0.5) for hull, corner in corners]
    most = max((len(hull) for hull in hulls), default=1)
    padded = [torch.cat((hull, hull[:1].expand(most - len(hull), 2))) for hull in hulls]
    return torch.stack(padded) if hulls else torch.zeros(0, most, 2).double()


def _spans(pencil: Pencil, side: int, corners: Tensor) -> _Spans:
    plane = pencil.plane_from_px[side]
    x, y = (corners @ plane[:, :2].T + plane[:, 2]).unbind(2)
    angle = torch.atan2(y, x)
    across = x[..., None] * plane[1, :2] - y[..., None] * plane[0, :2]
    pitch = across.norm(dim=2) / (x.square() + y.square()).clamp(min=torch.finfo(x.dtype).tiny)
    at_ends = torch.stack((angle.argmin(1), angle.argmax(1)), 1)
    spans, pitches = angle.gather(1, at_ends), pitch.gather(1, at_ends)
    is_span = (spans[:, 1] - spans[:, 0] < AGREEMENT.widest) & (pitches > 0).all(1)
    return _Spans(spans[is_span], pitches[is_span])


def _residuals(first: _Spans, second: _Spans, moves: Tensor) -> Tensor:
    """(S, N, M) pixels between the ends of two views' masks, after S moves (S, M) of the second's, radians."""
    apart = first.ends[:, None] - second.ends
    return ((apart - moves[:, None, :, None]) / torch.hypot(first.pitch[:, None], second.pitch)).abs().amax(3)


def _beats_chance(first: _Spans, second: _Spans) -> tuple[Tensor, Tensor]:
    """(N,) and (M,) bool: the best partner fits better than under any move; moves stay where masks are."""
    middle = second.ends.mean(1)
    reach = torch.maximum(middle.max() - middle.min(), (second.ends[:, 1] - second.ends[:, 0]).mean())
    low = (middle.max() + middle.min() - reach) / 2
    steps = torch.arange(AGREEMENT.num_moves + 1).double()[:, None] / (AGREEMENT.num_moves + 1)
    moves = low + (middle - low + steps * reach) % reach.clamp(min=1e-12) - middle
    moves[0] = 0
    residuals = _residuals(first, second, moves)
    best = residuals.amin(2), residuals.amin(1)
    return best[0][0] < best[0][1:].amin(0), best[1][0] < best[1][1:].amin(0)


def _offset(first: _Spans, second: _Spans, unit_px: float) -> float:
    """The move, in units and without sign, at which most masks of two views begin and end together."""
    units = torch.arange(-AGREEMENT.most_offset, AGREEMENT.most_offset + 1).double()
    apart = (first.ends[:, None] - second.ends) / torch.hypot(first.pitch[:, None], second.pitch) / unit_px
    residuals = (apart - units[:, None, None, None]).abs().amax(3)
    one, other = (torch.exp(-((residuals.amin(axis) / AGREEMENT.sharpness) ** 2)).sum(1) for axis in (1, 2))
    votes = one + other
    return float(units[votes == votes.max()].abs().min())
