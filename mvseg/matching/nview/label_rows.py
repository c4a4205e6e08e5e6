"""Stage 5b: what the other views show along the ray of a pixel, as rows of region labels (a plane sweep of label maps).

Every hypothesis about a pixel's depth makes one statement per view: there the point shows this region, or no region, or
it is outside of the image. Such a tuple is a row. Most depths make the same statement as their neighbours, so that few
distinct rows are left per pixel and per region; everything later works on those. Rows alone already tell, without any
cluster, how likely two regions are one instance (`em_affinities`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mvseg.regions import Regions
from mvseg.scene import Cameras

EMPTY, OUTSIDE = -1, -2  # labels of a row: no region there; outside of the image, behind the camera, or the own view
PIXELS = 24  # at most so many per region cast a ray, and
PLENTY = 10  # with more views than this, fewer: there is more to be seen along each ray
DEPTHS = 96  # along a ray
NEAREST = 0.05  # no depth below this fraction of the longest baseline
MAX_EMPTY = 0.5  # share of the other views that may show no region
DOMINANCE_PASSES = 3
SHARPNESS = (8.0, 12.0, 16.0, 24.0, 32.0, 32.0)  # of the soft maximum over the rows of a pixel, one per iteration
EMPTY_COST = 0.7  # of a row in which all views show no region
EM_PIXELS = 12  # at most so many per region
CHUNK = 512  # rays at a time: their samples fit into the cache

Floats = NDArray[np.float32]
Ints = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class RowTable:
    """Rows of the sampled pixels of D regions.

    Attributes:
        labels: (I, V) int16 or int32, the rows: region index, EMPTY or OUTSIDE; by pixel, then from far to near.
        pixel: (I,) int64, the pixel in [0, Q) whose ray each row lies on.
        inverse_depth: (I,) float32, 1 / depth of the row in the pixel's own camera, mean over its samples.
        pixel_region: (Q,) int64, ordered: the region of each pixel; some pixels have no row.
        pixel_xy: (Q, 2) float32, centres.
        view_index: (D,) int64, ordered.
        num_views: V.
    """

    labels: NDArray[np.integer]
    pixel: Ints
    inverse_depth: Floats
    pixel_region: Ints
    pixel_xy: Floats
    view_index: Ints
    num_views: int


def row_table(regions: Regions, cameras: Cameras, *, widen_px: int = 1) -> RowTable:
    """Sweep the rays of all regions through the label maps of all other views.

    Args:
        regions: D regions ordered by view (int64 `view_index` must not decrease).
        cameras: V cameras.
        widen_px: labels also count this far into unlabelled pixels; about the reprojection error to expect.

    Returns:
        The table. A row is kept when at least one view shows a region, and at most half of the views that the point
        lies in (but always one) show none; and when its neighbours on the ray do not say the same and more.
    """
    maps = [_padded_labels(regions, view, cameras.sizes[view].tolist(), widen_px) for view in range(len(cameras))]
    frames = [_label_box(labels) for labels in maps]
    xy, region = sample_pixels(regions, max(1, round(PIXELS * min(1, PLENTY / len(cameras)))))
    pixels = [torch.zeros(0, dtype=torch.int64)]
    labels = [torch.zeros(0, len(cameras), dtype=maps[0].dtype)]
    inverse = [torch.zeros(0)]
    for view in range(len(cameras)):
        here = (regions.view_index[region] == view).nonzero()[:, 0]
        for chunk in torch.split(here, CHUNK) if len(here) else ():
            found = _join_equal(*_sweep(view, xy[chunk], cameras, maps, frames))
            pixels.append((found[0] + chunk[0]).cpu())
            labels.append(found[1].cpu())
            inverse.append(found[2].cpu())
    return RowTable(
        torch.cat(labels).numpy(),
        torch.cat(pixels).numpy(),
        torch.cat(inverse).numpy(),
        region.cpu().numpy(),
        xy.cpu().numpy(),
        regions.view_index.cpu().numpy(),
        len(cameras),
    )


def sample_pixels(regions: Regions, most: int) -> tuple[Tensor, Tensor]:
    """At most `most` pixels of each region, evenly spread over its pixels in reading order.

    Returns:
        xy (Q, 2) float32, pixel centres; region (Q,) int64, ordered.
    """
    xy, owner, _ = regions.pixels()
    count = torch.bincount(owner, minlength=len(regions))
    taken = count.clamp(max=most)
    region = torch.repeat_interleave(torch.arange(len(regions), device=xy.device), taken)
    rank = torch.arange(len(region), device=xy.device) - (taken.cumsum(0) - taken)[region]
    place = ((2 * rank + 1) * count[region]) // (2 * taken[region])
    return xy[(count.cumsum(0) - count)[region] + place], region


def _padded_labels(regions: Regions, view: int, size: list[int], widen_px: int) -> Tensor:
    """(H + 2, W + 2) int16 or int32 region index per pixel, EMPTY elsewhere, in a frame of OUTSIDE."""
    width, height = size
    index = torch.arange(1, len(regions) + 1, device=regions.device)
    kind = torch.int16 if len(regions) < 2**15 else torch.int32
    labels = (regions.label_map(view, index, width, height) - 1).to(kind)
    for _ in range(widen_px):
        grown = labels.clone()
        for axis in (0, 1):
            for start in (0, 1):
                target, source = (labels.narrow(axis, k, labels.shape[axis] - 1) for k in (start, 1 - start))
                patch = grown.narrow(axis, start, labels.shape[axis] - 1)
                patch.copy_(torch.where((target < 0) & (patch < 0), source, patch))
        labels = grown
    return torch.nn.functional.pad(labels, (1, 1, 1, 1), value=OUTSIDE)


def _label_box(labels: Tensor) -> tuple[float, float, float, float] | None:
    """x1, y1, x2, y2 of all regions of a padded label map in pixels; None without any.

    Where a region touches the border of the image its instance may go on, so that the box does so without end.
    """
    inner = labels[1:-1, 1:-1] >= 0
    ends = []
    for axis in (0, 1):
        found = inner.any(axis).nonzero()[:, 0].tolist()
        if not found:
            return None
        low = -torch.inf if found[0] == 0 else float(found[0])
        ends.append((low, torch.inf if found[-1] + 1 == inner.shape[1 - axis] else float(found[-1] + 1)))
    return ends[0][0], ends[1][0], ends[0][1], ends[1][1]


def _sweep(
    view: int, xy: Tensor, cameras: Cameras, maps: list[Tensor], frames: list[tuple[float, float, float, float] | None]
) -> tuple[Tensor, Tensor, Tensor]:
    """Rows along the rays of P pixels of one view: pixel (I,) in [0, P), labels (I, V), inverse depth (I,)."""
    ones = torch.ones(len(xy), 1).to(xy)
    rays = torch.cat((xy, ones), 1).double() @ cameras.world_from_px[view].T
    others = [other for other in range(len(cameras)) if other != view]
    # A point at inverse depth w along a ray projects to base + w * offset, homogeneous.
    bases = {other: (rays @ (cameras.K[other] @ cameras.R[other]).T).float() for other in others}
    offsets = {
        other: (cameras.K[other] @ (cameras.R[other] @ cameras.centers[view] + cameras.t[other])).tolist()
        for other in others
    }
    low, high = _inverse_range(bases, offsets, frames, cameras)
    steps = (torch.arange(DEPTHS, device=xy.device) + 0.5) / DEPTHS
    is_seen = low < high
    low, high = torch.where(is_seen, low, 0), torch.where(is_seen, high, 0)
    inverse = low[:, None] + (high - low)[:, None] * steps
    found = torch.full((len(cameras), *inverse.shape), OUTSIDE, dtype=maps[0].dtype, device=xy.device)
    for other in others:
        found[other] = _look_up(inverse, bases[other], offsets[other], maps[other])
    num_empty = (found == EMPTY).sum(0, dtype=torch.int16)
    num_labels = (found >= 0).sum(0, dtype=torch.int16)
    most_empty = (MAX_EMPTY * (num_empty + num_labels)).floor().clamp(min=1)
    keep = (num_labels > 0) & (num_empty <= most_empty) & is_seen[:, None]
    pixel = keep.nonzero()[:, 0]
    return pixel, found[:, keep].T.contiguous(), inverse[keep]


def _inverse_range(
    bases: dict[int, Tensor],
    offsets: dict[int, list[float]],
    frames: list[tuple[float, float, float, float] | None],
    cameras: Cameras,
) -> tuple[Tensor, Tensor]:
    """(P,) smallest and largest inverse depth at which half of the other views may see a region."""
    distance = torch.cdist(cameras.centers, cameras.centers).max()
    nearest = float(1 / (NEAREST * distance)) if distance > 0 else 0.0
    lows, highs = [], []
    for other, base in bases.items():
        frame = frames[other]
        if frame is None:
            continue
        e = offsets[other]
        low, high = torch.zeros(len(base)).to(base), torch.full((len(base),), nearest).to(base)
        for edge, axis, sign in zip(frame, (0, 1, 0, 1), (1, 1, -1, -1), strict=True):
            if abs(edge) == torch.inf:
                continue
            slope, start = sign * (e[axis] - edge * e[2]), sign * (base[:, axis] - edge * base[:, 2])
            low, high = _cut(low, high, slope, start)
        low, high = _cut(low, high, e[2], base[:, 2])
        lows.append(torch.where(low < high, low, torch.inf))
        highs.append(torch.where(low < high, high, 0.0))
    if not lows:
        nothing = torch.zeros_like(next(iter(bases.values()))[:, 0])
        return nothing, nothing
    needed = (len(lows) + 1) // 2
    low = torch.stack(lows).sort(0).values[needed - 1]
    return low, torch.stack(highs).sort(0, descending=True).values[needed - 1]


def _cut(low: Tensor, high: Tensor, slope: float, start: Tensor) -> tuple[Tensor, Tensor]:
    """The part of the intervals in which start + slope * w >= 0."""
    if slope == 0:
        return low, torch.where(start >= 0, high, -1.0)
    root = -start / slope
    return (torch.maximum(low, root), high) if slope > 0 else (low, torch.minimum(high, root))


def _look_up(inverse: Tensor, base: Tensor, offset: list[float], labels: Tensor) -> Tensor:
    """(P, DEPTHS) label at the projection of each sample."""
    height, width = labels.shape
    depth = inverse * offset[2] + base[:, 2:]
    scale = 1 / depth
    column = ((inverse * offset[0] + base[:, :1]) * scale + 1).clamp_(0, width - 1).int()
    row = ((inverse * offset[1] + base[:, 1:2]) * scale + 1).clamp_(0, height - 1).int()
    place = torch.where(depth > 0, row * width + column, 0)
    return labels.flatten()[place]


def _join_equal(pixel: Tensor, labels: Tensor, inverse: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Join runs of equal rows on a ray, and drop rows that only miss regions which a neighbour on the ray shows."""
    if not len(pixel):
        return pixel, labels, inverse
    is_new = torch.ones(len(pixel), dtype=torch.bool, device=pixel.device)
    is_new[1:] = (labels[1:] != labels[:-1]).any(1) | (pixel[1:] != pixel[:-1])
    run = is_new.cumsum(0) - 1
    total = torch.zeros(int(run[-1]) + 1).to(inverse).index_add_(0, run, inverse)
    inverse = total / torch.bincount(run)
    pixel, labels = pixel[is_new], labels[is_new]
    for _ in range(DOMINANCE_PASSES):
        same_ray = pixel[1:] == pixel[:-1]
        differs = labels[1:] != labels[:-1]
        less = ~(differs & (labels[1:] != EMPTY)).any(1) & same_ray
        more = ~(differs & (labels[:-1] != EMPTY)).any(1) & same_ray
        keep = torch.ones(len(pixel), dtype=torch.bool, device=pixel.device)
        keep[1:] &= ~less
        keep[:-1] &= ~(more & ~less)
        pixel, labels, inverse = pixel[keep], labels[keep], inverse[keep]
    return pixel, labels, inverse


def run_starts(values: NDArray[np.integer]) -> Ints:
    """(R,) int64: where the runs of equal values start."""
    return np.flatnonzero(np.append(True, values[1:] != values[:-1])) if len(values) else np.zeros(0, np.int64)


def em_affinities(table: RowTable) -> list[NDArray[np.floating]]:
    """How likely two regions are one instance, from the rows alone.

    E step: the rows of a pixel share one unit of belief by a soft maximum of their mean affinity between all regions
    that they name (the pixel's own included), less EMPTY_COST for views that show nothing. M step: the affinity of
    region n to m is the belief in rows with m, averaged over the pixels of n, and made symmetric.

    Args:
        table: rows of D regions.

    Returns:
        After each iteration (D, D) float64 in [0, 1], symmetric, 0 for regions of one view.
    """
    num, owner_of = len(table.view_index), table.pixel_region
    most = max(1, round(EM_PIXELS * min(1, PLENTY / table.num_views)))
    counts = np.bincount(owner_of, minlength=num)
    rank = np.arange(len(owner_of)) - np.searchsorted(owner_of, owner_of)
    is_used = rank % np.maximum(1, -(-counts // most))[owner_of] == 0
    rows = is_used[table.pixel]
    pixel, owner = table.pixel[rows], torch.from_numpy(owner_of[table.pixel[rows]])
    labels = torch.from_numpy(table.labels[rows].astype(np.int64))
    num_empty, num_inside = (labels == EMPTY).sum(1), (labels >= EMPTY).sum(1)
    labels = torch.where(labels < 0, num, labels).T.contiguous()  # column `num` collects what is no region
    pixels = torch.from_numpy(np.maximum(np.bincount(owner_of[is_used], minlength=num), 1))[:, None]
    start = run_starts(pixel)
    run = torch.from_numpy(np.repeat(np.arange(len(start)), np.diff(np.append(start, len(pixel)))))
    cell = owner * (num + 1) + labels
    if not len(start):
        return [np.zeros((num, num))] * len(SHARPNESS)
    seen = torch.unique(run * (num + 1) + labels)
    first = owner[torch.from_numpy(start)][seen // (num + 1)] * (num + 1) + seen % (num + 1)
    A = torch.bincount(first, minlength=num * (num + 1)).reshape(num, num + 1)[:, :num] / pixels
    history = []
    for beta in SHARPNESS:
        flat = torch.nn.functional.pad((A + A.T).float() / 2, (0, 1, 0, 1)).flatten()
        score = flat[cell].sum(0)
        for view, base in enumerate(labels * (num + 1)):
            for other in range(view + 1, len(labels)):
                score += flat[base + labels[other]]
        score = 2 * score / (num_inside * (num_inside + 1)) - EMPTY_COST * num_empty / num_inside
        best = torch.from_numpy(np.maximum.reduceat(score.numpy(), start))
        belief = torch.exp(beta * (score - best[run])).double()
        belief /= torch.bincount(run, belief)[run]
        mass = torch.bincount(cell.flatten(), belief.expand(cell.shape).flatten(), minlength=num * (num + 1))
        A = mass.reshape(num, num + 1)[:, :num] / pixels
        history.append(((A + A.T) / 2).double().numpy())
    return history
