"""Labels of the other views along the ray of a pixel: a plane sweep of label maps.

Every hypothesis about a pixel's depth predicts one label per view: the point projects onto this region, onto no region,
or outside the image. Most depths predict the same labels as their neighbours, so few distinct ones remain per pixel.

This is the one border between torch and NumPy in the N-view matcher: regions and cameras come in as tensors on any
device, labels and everything from the sweep on are NumPy (which compares and looks up small integers much faster).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import chain, pairwise

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mvseg.arrays import Ints
from mvseg.matching.numbers import SWEEP
from mvseg.regions import Regions
from mvseg.scene import Cameras
from mvseg.system.running import progress_bar

# definition: labels of a hypothesis: no region there; outside the image, behind the camera, or the own view.
EMPTY, OUTSIDE = -1, -2


@dataclass(frozen=True, eq=False)
class HypothesesOfRegions:
    """Index of R hypotheses by the D regions that they name.

    Attributes:
        hypotheses: int32, the hypotheses of region 0, then those of region 1, ...
        offsets: D + 1 numbers: region d is named by `hypotheses[offsets[d]:offsets[d + 1]]`.
    """

    hypotheses: NDArray[np.int32]
    offsets: list[int]
    num_hypotheses: int

    def count(self, clusters: list[Ints]) -> tuple[Ints, Ints, Ints]:
        """Count the views that show a member of each of C clusters. Returns three int64 arrays with an entry per
        cluster and hypothesis in which any view does, in this order: cluster, hypothesis, views."""
        parts = [
            [self.hypotheses[self.offsets[region] : self.offsets[region + 1]] for region in members.tolist()]
            for members in clusters
        ]
        lengths = [sum(map(len, of_cluster)) for of_cluster in parts]
        kind: type[np.int32 | np.int64] = np.int32 if len(clusters) * self.num_hypotheses < 2**31 else np.int64
        first = np.arange(len(clusters)).astype(kind) * self.num_hypotheses  # of each cluster
        cell = np.repeat(first, lengths)
        if len(cell):
            cell += np.concatenate(list(chain.from_iterable(parts)))
        cell.sort()
        start = run_starts(cell)
        cell, views = cell[start], np.diff(start, append=len(cell))
        cluster = np.repeat(np.arange(len(clusters)), np.diff(np.searchsorted(cell, first), append=len(cell)))
        return cluster, cell - first[cluster], views


def index_hypotheses(labels: NDArray[np.integer], num_regions: int) -> HypothesesOfRegions:
    """The index of R hypotheses (R, V) by the regions that they name."""
    flat = labels.ravel()
    order = np.argsort(flat, kind="stable")  # of int16, a radix sort
    offsets = np.searchsorted(flat[order], np.arange(num_regions + 1)).tolist()
    hypotheses = (order // max(labels.shape[1], 1)).astype(np.int32)
    return HypothesesOfRegions(hypotheses=hypotheses, offsets=offsets, num_hypotheses=len(labels))


def pack_views(is_view: NDArray[np.bool_]) -> NDArray[np.uint64]:
    """(W, N): sets of views (N, V) as bits, 64 of them in a word."""
    packed = np.packbits(is_view, axis=1)
    return np.pad(packed, ((0, 0), (0, -packed.shape[1] % 8))).view(np.uint64).T.copy()


@dataclass(frozen=True, eq=False)
class PlaneSweep:
    """Hypotheses of the sampled pixels of D regions.

    Attributes:
        labels: (I, V) int16 or int32, the hypotheses: region index, EMPTY or OUTSIDE; by pixel, then from far to near.
        pixel: (I,) int64, the pixel in [0, Q) whose ray each hypothesis lies on.
        pixel_region: (Q,) int64, ordered: the region of each pixel; some pixels have no hypothesis.
        view_index: (D,) int64, ordered.
    """

    labels: NDArray[np.integer]
    pixel: Ints
    pixel_region: Ints
    view_index: Ints
    num_views: int

    @cached_property
    def regions_of(self) -> list[slice]:
        """The regions of each view."""
        return self._cut(self.view_index)

    @cached_property
    def pixels_of(self) -> list[slice]:
        """The sampled pixels of each view."""
        return self._cut(self.view_index[self.pixel_region])

    @cached_property
    def hypotheses_of(self) -> list[slice]:
        """The hypotheses on rays of each view."""
        return self._cut(self.view_index[self.pixel_region[self.pixel]])

    def _cut(self, views: Ints) -> list[slice]:
        ends = np.searchsorted(views, np.arange(self.num_views + 1)).tolist()
        return [slice(start, end) for start, end in pairwise(ends)]

    @cached_property
    def num_inside(self) -> NDArray[np.float32]:
        """(I,) float32, the number of views that the point of each hypothesis lies in; at least 1."""
        return (self.labels >= EMPTY).sum(1, dtype=np.float32)

    @cached_property
    def empty_views(self) -> NDArray[np.uint64]:
        """(W, I), which views show no region there, see `pack_views`."""
        return pack_views(self.labels == EMPTY)

    @cached_property
    def hypotheses_of_regions(self) -> list[HypothesesOfRegions]:
        """Hypotheses on rays of each view by the regions that they name."""
        return [index_hypotheses(self.labels[here], len(self.view_index)) for here in self.hypotheses_of]


def sweep_planes(regions: Regions, cameras: Cameras, *, dilation_px: int = 1) -> PlaneSweep:
    """Sweep the rays of all regions, ordered by view, through the label maps of all other views.

    Regions grow by `dilation_px` into unlabelled pixels; about the expected reprojection error. A hypothesis is kept
    when at least one view shows a region, at most half of the views that the point lies in show none (one always may),
    and no neighbour on the ray shows the same regions and more.
    """
    return next(sweep_dilated(regions, cameras, dilations=(dilation_px,)))


def sweep_dilated(
    regions: Regions, cameras: Cameras, *, dilations: Sequence[int], rays: int | None = None
) -> Iterator[PlaneSweep]:
    """The sweep of each of several dilations, in ascending order; see `sweep_planes`. `rays` of each region are swept,
    at most; None: `rays_per_region`."""
    regions, cameras = regions.to("cpu"), cameras.to("cpu")
    sizes = cameras.sizes.tolist()
    maps, grown_px = [_padded_labels(regions, view, size) for view, size in enumerate(sizes)], 0
    xy, region = regions.spread_pixels(rays_per_region(len(cameras)) if rays is None else rays)
    for dilation_px in dilations:
        for labels in maps:
            _dilate(labels, dilation_px - grown_px)
        grown_px = dilation_px
        label_maps = _LabelMaps(cameras, maps, [_label_box(labels) for labels in maps])
        yield _sweep_views(label_maps, regions, xy, region=region, title=f"matching, {dilation_px} px")


def rays_per_region(num_views: int) -> int:
    """How many rays of each region are swept, at most."""
    return max(1, round(SWEEP.rays * min(1, SWEEP.plenty / num_views)))


@torch.inference_mode()
def _sweep_views(label_maps: _LabelMaps, regions: Regions, xy: Tensor, *, region: Tensor, title: str) -> PlaneSweep:
    """The sweep of the rays through pixels `xy` (Q, 2) of `region` (Q,)."""
    num_views = len(label_maps.maps)
    pixels = [np.zeros(0, np.int64)]
    labels = [np.zeros((0, num_views), label_maps.maps[0].numpy().dtype)]
    for view in progress_bar(range(num_views), title, unit="view"):
        here = (regions.view_index[region] == view).nonzero()[:, 0]
        for chunk in torch.split(here, SWEEP.chunk) if len(here) else ():
            pixel, label = _join_equal(*label_maps.hypotheses(view, xy[chunk]))
            pixels.append(pixel + int(chunk[0]))
            labels.append(np.ascontiguousarray(label.T))
    pixel, owner, views = np.concatenate(pixels), region.numpy(), regions.view_index.numpy()
    every = np.concatenate(labels)
    return PlaneSweep(labels=every, pixel=pixel, pixel_region=owner, view_index=views, num_views=num_views)


def _padded_labels(regions: Regions, view: int, size: list[int]) -> Tensor:
    """(H + 2, W + 2) int16 or int32 region index per pixel, EMPTY elsewhere, in a frame of OUTSIDE."""
    index = torch.arange(1, len(regions) + 1, device=regions.device)
    kind = torch.int16 if len(regions) < 2**15 else torch.int32
    padded = torch.full((size[1] + 2, size[0] + 2), OUTSIDE, dtype=kind)
    padded[1:-1, 1:-1] = regions.label_map(view, index, size)
    padded[1:-1, 1:-1] -= 1
    return padded


def _dilate(padded: Tensor, num_px: int) -> None:
    """Grow the regions of a padded label map into EMPTY pixels, in place; from below first, then above, right, left."""
    flat, row = padded.numpy().ravel(), padded.shape[1]
    beside, tag = (row, -row, 1, -1), np.empty(flat.shape, np.int32)
    is_region, is_empty = flat >= 0, flat[row:-row] == EMPTY
    near = is_region[2 * row :] | is_region[: -2 * row]
    near |= is_region[row + 1 : 1 - row] | is_region[row - 1 : -row - 1]
    place = np.flatnonzero(near & is_empty) + row
    for _ in range(num_px):
        grown = flat.take(place + row)
        for step in beside[1:]:
            grown = np.where(grown < 0, flat.take(place + step), grown)
        flat[place] = grown
        place = np.concatenate([place + step for step in beside])
        place = place[flat.take(place) == EMPTY]
        tag[place] = np.arange(len(place))
        place = place[tag.take(place) == np.arange(len(place))]  # each once


def _label_box(labels: Tensor) -> tuple[float, float, float, float] | None:
    """x1, y1, x2, y2 of all regions of a padded label map; infinite where one touches the border; None without any."""
    inner = labels.numpy()[1:-1, 1:-1] >= 0
    height, width = inner.shape
    left, top, wide, high = cv2.boundingRect(inner.view(np.uint8))
    if not wide:
        return None
    low = [-torch.inf if first == 0 else float(first) for first in (left, top)]
    ends = (left + wide, width), (top + high, height)
    right, bottom = (torch.inf if end == whole else float(end) for end, whole in ends)
    return low[0], low[1], right, bottom


@dataclass(frozen=True, eq=False)
class _LabelMaps:
    """The label maps of V views, padded, on the CPU, with boxes of their regions, ready to be looked up along rays."""

    cameras: Cameras
    maps: list[Tensor]
    boxes: list[tuple[float, float, float, float] | None]

    def hypotheses(self, view: int, xy: Tensor) -> tuple[Ints, NDArray[np.integer]]:
        """Along the rays of P pixels of one view, from far to near: pixel (I,) in [0, P), labels (V, I)."""
        others = torch.tensor([other for other in range(len(self.maps)) if other != view])
        bases, offsets = self._project_rays(view, xy, others)
        low, high = self._inverse_range(bases, offsets, others)
        steps = (torch.arange(SWEEP.depths) + 0.5) / SWEEP.depths
        is_seen = low < high
        low, high = torch.where(is_seen, low, 0), torch.where(is_seen, high, 0)
        inverse = low[:, None] + (high - low)[:, None] * steps
        labels = np.full((len(self.maps), inverse.numel()), OUTSIDE, self.maps[0].numpy().dtype)
        num_empty, num_labels = np.zeros((2, inverse.numel()), np.int16)
        for other, base, offset in zip(others.tolist(), bases, offsets.tolist(), strict=True):
            labels[other] = _look_up(inverse, base, offset, labels=self.maps[other])
            num_empty += labels[other] == EMPTY
            num_labels += labels[other] >= 0
        most_empty = np.maximum(np.floor(SWEEP.max_empty * (num_empty + num_labels)), 1)
        keep = (num_labels > 0) & (num_empty <= most_empty) & np.repeat(is_seen.numpy(), SWEEP.depths)
        kept = np.flatnonzero(keep)
        return kept // SWEEP.depths, labels.take(kept, 1)

    def _project_rays(self, view: int, xy: Tensor, others: Tensor) -> tuple[Tensor, Tensor]:
        """Bases (O, P, 3) float32, offsets (O, 3) float64: inverse depth w projects to base + w * offset."""
        cameras = self.cameras
        ones = torch.ones(len(xy), 1).to(xy)
        rays = torch.cat((xy, ones), 1).double() @ cameras.world_from_px[view].T
        bases = rays @ (cameras.K[others] @ cameras.R[others]).mT
        shift = cameras.R[others] @ cameras.centers[view] + cameras.t[others]
        return bases.float(), (cameras.K[others] @ shift[..., None])[..., 0]

    def _inverse_range(self, bases: Tensor, offsets: Tensor, others: Tensor) -> tuple[Tensor, Tensor]:
        """(P,) smallest and largest inverse depth at which half of the other views may see a region."""
        distance = torch.cdist(self.cameras.centers, self.cameras.centers).max()
        nearest = float(1 / (SWEEP.nearest * distance)) if distance > 0 else 0.0
        boxed = [index for index, other in enumerate(others.tolist()) if self.boxes[other] is not None]
        if not boxed:
            nothing = torch.zeros_like(bases[0, :, 0])
            return nothing, nothing
        boxes = torch.tensor([self.boxes[other] for other in others[boxed].tolist()], device=bases.device)[..., None]
        base, e = bases[boxed].mT, offsets[boxed].float()[..., None]  # (S, 3, P) and (S, 3, 1)
        interval = torch.zeros_like(base[:, 0]), torch.full_like(base[:, 0], nearest)
        for side, (axis, sign) in enumerate(((0, 1), (1, 1), (0, -1), (1, -1))):
            edge = boxes[:, side]
            slope, start = sign * (e[:, axis] - edge * e[:, 2]), sign * (base[:, axis] - edge * base[:, 2])
            is_cut = edge.isfinite()
            interval = _cut(interval, torch.where(is_cut, slope, 0), torch.where(is_cut, start, 1))
        low, high = _cut(interval, e[:, 2], base[:, 2])
        is_any = low < high
        needed = (len(boxed) + 1) // 2
        low = torch.where(is_any, low, torch.inf).sort(0).values[needed - 1]
        return low, torch.where(is_any, high, 0).sort(0, descending=True).values[needed - 1]


def _cut(interval: tuple[Tensor, Tensor], slope: Tensor, start: Tensor) -> tuple[Tensor, Tensor]:
    """The part of the intervals (S, P), (S, P) in which start + slope * w >= 0, for slopes (S, 1)."""
    low, high = interval
    root = -start / slope
    low = torch.where(slope > 0, torch.maximum(low, root), low)
    high = torch.where(slope < 0, torch.minimum(high, root), high)
    return low, torch.where((slope == 0) & (start < 0), -1.0, high)


def _look_up(inverse: Tensor, base: Tensor, offset: list[float], *, labels: Tensor) -> NDArray[np.integer]:
    """(P * depths,) label at the projection of each sample."""
    height, width = labels.shape
    depth = torch.add(base[:, 2:], inverse, alpha=offset[2])
    is_behind = depth <= 0
    scale = depth.reciprocal_()
    column = torch.add(base[:, :1], inverse, alpha=offset[0]).mul_(scale).add_(1).clamp_(0, width - 1).int()
    row = torch.add(base[:, 1:2], inverse, alpha=offset[1]).mul_(scale).add_(1).clamp_(0, height - 1).int()
    place = row.mul_(width).add_(column).masked_fill_(is_behind, 0)  # the frame of the map is OUTSIDE
    return np.asarray(labels.numpy().ravel().take(place.numpy().ravel()))  # torch's look-up is slower


def _join_equal(pixel: Ints, labels: NDArray[np.integer]) -> tuple[Ints, NDArray[np.integer]]:
    """Join runs of equal columns of `labels` (V, I) on a ray; drop those that only lack regions of a neighbour."""
    if not len(pixel):
        return pixel, labels
    is_new = np.append(True, (labels[:, 1:] != labels[:, :-1]).any(0) | (pixel[1:] != pixel[:-1]))
    start = np.flatnonzero(is_new)
    pixel, labels = pixel[start], labels.take(start, 1)
    for _ in range(SWEEP.dominance_passes):
        same_ray = pixel[1:] == pixel[:-1]
        differs, is_empty = labels[:, 1:] != labels[:, :-1], labels == EMPTY
        less = ~(differs & ~is_empty[:, 1:]).any(0) & same_ray
        more = ~(differs & ~is_empty[:, :-1]).any(0) & same_ray
        keep = np.ones(len(pixel), bool)
        keep[1:] &= ~less
        keep[:-1] &= ~(more & ~less)
        if keep.all():
            break
        kept = np.flatnonzero(keep)
        pixel, labels = pixel[kept], labels.take(kept, 1)
    return pixel, labels


def run_starts(values: NDArray[np.integer]) -> Ints:
    """(R,) int64: where the runs of equal values start."""
    return np.flatnonzero(np.append(True, values[1:] != values[:-1])) if len(values) else np.zeros(0, np.int64)


def blocks_of_runs(start: Ints, num_hypotheses: int) -> list[slice]:
    """Consecutive slices of about `SWEEP.block_size` hypotheses; no run is cut. `start` is where the runs start."""
    if not len(start):
        return []
    first = start[run_starts(start // SWEEP.block_size)].tolist()
    return [slice(begin, end) for begin, end in pairwise([*first, num_hypotheses])]
