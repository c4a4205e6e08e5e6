"""What the other views show along the ray of a pixel, as rows of region labels (a plane sweep of label maps).

Every hypothesis about a pixel's depth predicts one label per view: the point projects onto this region, onto no region,
or outside the image. These labels form a row. Most depths give the same row as their neighbours, so that few distinct
rows are left per pixel; everything later works on those.

This is the one border between torch and NumPy in the N-view matcher: regions and cameras come in as tensors on any
device, everything from the table on is NumPy.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from tqdm import tqdm

from mvseg.regions import Regions
from mvseg.scene import Cameras

EMPTY, OUTSIDE = -1, -2  # labels of a row: no region there; outside the image, behind the camera, or the own view
PIXELS = 24  # rays per region, at most
PLENTY = 10  # with more views than this fewer rays are cast: each shows more
DEPTHS = 96  # along a ray
NEAREST = 0.05  # no depth below this fraction of the longest baseline
MAX_EMPTY = 0.5  # share of the other views that may show no region
DOMINANCE_PASSES = 3
CHUNK = 512  # rays at a time: their samples fit into the cache

Floats = NDArray[np.float32]
Ints = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class ViewBounds:
    """Where each view starts in a `RowTable`: (V + 1,) offsets of its regions, pixels and rows."""

    region_starts: Ints
    pixel_starts: Ints
    row_starts: Ints

    def regions(self, view: int) -> slice:
        """The regions of one view."""
        return slice(int(self.region_starts[view]), int(self.region_starts[view + 1]))

    def pixels(self, view: int) -> slice:
        """The sampled pixels of one view."""
        return slice(int(self.pixel_starts[view]), int(self.pixel_starts[view + 1]))

    def rows(self, view: int) -> slice:
        """The rows on rays of one view."""
        return slice(int(self.row_starts[view]), int(self.row_starts[view + 1]))


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

    @cached_property
    def bounds(self) -> ViewBounds:
        """Where each view starts in the table."""
        numbers = np.arange(self.num_views + 1)
        pixel_starts = np.searchsorted(self.view_index[self.pixel_region], numbers)
        return ViewBounds(
            region_starts=np.searchsorted(self.view_index, numbers),
            pixel_starts=pixel_starts,
            row_starts=np.searchsorted(self.pixel, pixel_starts),
        )


def row_table(regions: Regions, cameras: Cameras, *, widen_px: int = 1, progress: bool = False) -> RowTable:
    """Sweep the rays of all regions through the label maps of all other views.

    Args:
        regions: D regions ordered by view (int64 `view_index` must not decrease).
        cameras: V cameras.
        widen_px: regions grow this far into unlabelled pixels; about the expected reprojection error.
        progress: show a progress bar over the views.

    Returns:
        The table. A row is kept when at least one view shows a region, at most half of the views that the point lies in
        show none (one always may), and no neighbour on the ray shows the same regions and more.
    """
    sizes = cameras.sizes.tolist()
    maps = [_padded_labels(regions, view, size, widen_px=widen_px) for view, size in enumerate(sizes)]
    sweep = _Sweep(cameras, maps, [_label_box(labels) for labels in maps])
    xy, region = sample_pixels(regions, max(1, round(PIXELS * min(1, PLENTY / len(cameras)))))
    pixels = [torch.zeros(0, dtype=torch.int64)]
    labels = [torch.zeros(0, len(cameras), dtype=maps[0].dtype)]
    inverse = [torch.zeros(0)]
    for view in tqdm(range(len(cameras)), desc=f"rays, {widen_px} px", unit="view", disable=not progress):
        here = (regions.view_index[region] == view).nonzero()[:, 0]
        for chunk in torch.split(here, CHUNK) if len(here) else ():
            pixel, label, inverse_depth = _join_equal(*sweep.rows(view, xy[chunk]))
            pixels.append((pixel + chunk[0]).cpu())
            labels.append(label.cpu())
            inverse.append(inverse_depth.cpu())
    return RowTable(
        labels=torch.cat(labels).numpy(),
        pixel=torch.cat(pixels).numpy(),
        inverse_depth=torch.cat(inverse).numpy(),
        pixel_region=region.cpu().numpy(),
        pixel_xy=xy.cpu().numpy(),
        view_index=regions.view_index.cpu().numpy(),
        num_views=len(cameras),
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
    nth_pixel = ((2 * rank + 1) * count[region]) // (2 * taken[region])
    return xy[(count.cumsum(0) - count)[region] + nth_pixel], region


def _padded_labels(regions: Regions, view: int, size: list[int], *, widen_px: int) -> Tensor:
    """(H + 2, W + 2) int16 or int32 region index per pixel, EMPTY elsewhere, in a frame of OUTSIDE."""
    index = torch.arange(1, len(regions) + 1, device=regions.device)
    kind = torch.int16 if len(regions) < 2**15 else torch.int32
    labels = (regions.label_map(view, index, size) - 1).to(kind)
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

    Where a region touches the border of the image its instance may continue, so the box extends to infinity there.
    """
    inner = labels[1:-1, 1:-1] >= 0
    ends = []
    for axis in (0, 1):
        occupied = inner.any(axis).nonzero()[:, 0].tolist()
        if not occupied:
            return None
        low = -torch.inf if occupied[0] == 0 else float(occupied[0])
        ends.append((low, torch.inf if occupied[-1] + 1 == inner.shape[1 - axis] else float(occupied[-1] + 1)))
    return ends[0][0], ends[1][0], ends[0][1], ends[1][1]


@dataclass(frozen=True, eq=False)
class _Sweep:
    """The label maps of V views, ready to be looked up along rays.

    Attributes:
        cameras: V cameras.
        maps: V padded label maps, see `_padded_labels`.
        boxes: V boxes of their regions, see `_label_box`.
    """

    cameras: Cameras
    maps: list[Tensor]
    boxes: list[tuple[float, float, float, float] | None]

    def rows(self, view: int, xy: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Rows along the rays of P pixels of one view: pixel (I,) in [0, P), labels (I, V), inverse depth (I,)."""
        cameras = self.cameras
        ones = torch.ones(len(xy), 1).to(xy)
        rays = torch.cat((xy, ones), 1).double() @ cameras.world_from_px[view].T
        others = [other for other in range(len(cameras)) if other != view]
        # A point at inverse depth w along a ray projects to base + w * offset, homogeneous.
        bases = {other: (rays @ (cameras.K[other] @ cameras.R[other]).T).float() for other in others}
        offsets = {
            other: (cameras.K[other] @ (cameras.R[other] @ cameras.centers[view] + cameras.t[other])).tolist()
            for other in others
        }
        low, high = self._inverse_range(bases, offsets)
        steps = (torch.arange(DEPTHS, device=xy.device) + 0.5) / DEPTHS
        is_seen = low < high
        low, high = torch.where(is_seen, low, 0), torch.where(is_seen, high, 0)
        inverse = low[:, None] + (high - low)[:, None] * steps
        size = (len(cameras), *inverse.shape)
        labels = torch.full(size, OUTSIDE, dtype=self.maps[0].dtype, device=xy.device)
        for other in others:
            labels[other] = _look_up(inverse, bases[other], offsets[other], labels=self.maps[other])
        num_empty = (labels == EMPTY).sum(0, dtype=torch.int16)
        num_labels = (labels >= 0).sum(0, dtype=torch.int16)
        most_empty = (MAX_EMPTY * (num_empty + num_labels)).floor().clamp(min=1)
        keep = (num_labels > 0) & (num_empty <= most_empty) & is_seen[:, None]
        pixel = keep.nonzero()[:, 0]
        return pixel, labels[:, keep].T.contiguous(), inverse[keep]

    def _inverse_range(self, bases: dict[int, Tensor], offsets: dict[int, list[float]]) -> tuple[Tensor, Tensor]:
        """(P,) smallest and largest inverse depth at which half of the other views may see a region."""
        distance = torch.cdist(self.cameras.centers, self.cameras.centers).max()
        nearest = float(1 / (NEAREST * distance)) if distance > 0 else 0.0
        lows, highs = [], []
        for other, base in bases.items():
            box = self.boxes[other]
            if box is None:
                continue
            e = offsets[other]
            interval = torch.zeros(len(base)).to(base), torch.full((len(base),), nearest).to(base)
            for edge, axis, sign in zip(box, (0, 1, 0, 1), (1, 1, -1, -1), strict=True):
                if abs(edge) == torch.inf:
                    continue
                slope, start = sign * (e[axis] - edge * e[2]), sign * (base[:, axis] - edge * base[:, 2])
                interval = _cut(interval, slope, start)
            low, high = _cut(interval, e[2], base[:, 2])
            lows.append(torch.where(low < high, low, torch.inf))
            highs.append(torch.where(low < high, high, 0.0))
        if not lows:
            nothing = torch.zeros_like(next(iter(bases.values()))[:, 0])
            return nothing, nothing
        needed = (len(lows) + 1) // 2
        low = torch.stack(lows).sort(0).values[needed - 1]
        return low, torch.stack(highs).sort(0, descending=True).values[needed - 1]


def _cut(interval: tuple[Tensor, Tensor], slope: float, start: Tensor) -> tuple[Tensor, Tensor]:
    """The part of the intervals (P,), (P,) in which start + slope * w >= 0."""
    low, high = interval
    if slope == 0:
        return low, torch.where(start >= 0, high, -1.0)
    root = -start / slope
    return (torch.maximum(low, root), high) if slope > 0 else (low, torch.minimum(high, root))


def _look_up(inverse: Tensor, base: Tensor, offset: list[float], *, labels: Tensor) -> Tensor:
    """(P, DEPTHS) label at the projection of each sample."""
    height, width = labels.shape
    depth = inverse * offset[2] + base[:, 2:]
    scale = 1 / depth
    column = ((inverse * offset[0] + base[:, :1]) * scale + 1).clamp_(0, width - 1).int()
    row = ((inverse * offset[1] + base[:, 1:2]) * scale + 1).clamp_(0, height - 1).int()
    return labels.flatten()[torch.where(depth > 0, row * width + column, 0)]


def _join_equal(pixel: Tensor, labels: Tensor, inverse: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Join runs of equal rows on a ray; discard rows that equal a neighbour's but lack some of its regions."""
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
