"""The instance masks of all views of a scene, flat, as box crops. Boxes of masks are computed only here."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations
from typing import Any

import numpy as np
import torch
from scipy import ndimage
from torch import Tensor

from mvseg.crop import Box, Crop
from mvseg.errors import InputError
from mvseg.table import Table

IGNORE_LABEL = 65535  # definition: in label maps: pixels that belong to no region and are left out of every score


@dataclass(frozen=True, eq=False, repr=False)
class Regions(Table):
    """D instance masks in V views: the nodes of the paper's graph (Sec. 3.1).

    A mask is kept as the crop of its bounding box, never as a full frame; the crops of all regions stand one after
    another in one flat tensor. Regions of one view may overlap.

    Attributes:
        view_index: (D,) int64, the view of each region.
        boxes: (D, 4) int64, xyxy in pixels, half-open: the crop of region d covers columns x1..x2-1, rows y1..y2-1.
        crops: (sum of box areas,) bool, the crops, each in row-major order.
        num_views: V; views without any region count.
        labels: (D,) int64, the number each mask had in its source. It means nothing across views.

    Raises:
        InputError: shapes that disagree, an empty box, a view index outside [0, V).
    """

    view_index: Tensor
    boxes: Tensor
    crops: Tensor
    num_views: int
    labels: Tensor

    def __repr__(self) -> str:
        return f"Regions({len(self.view_index)} masks in {self.num_views} views)"

    def __post_init__(self) -> None:
        num_regions = len(self.view_index)
        if tuple(self.boxes.shape) != (num_regions, 4) or tuple(self.labels.shape) != (num_regions,):
            given = f"boxes {tuple(self.boxes.shape)} and labels {tuple(self.labels.shape)}"
            raise InputError(f"{num_regions} regions with {given}, expected ({num_regions}, 4) and ({num_regions},)")
        if num_regions and int(self.crop_sizes.min()) < 1:
            raise InputError(f"region {int(self.crop_sizes.min(1)[0].argmin())} has an empty box")
        if self.crops.dtype != torch.bool or len(self.crops) != int(self.crop_sizes.prod(1).sum()):
            raise InputError(f"crops hold {len(self.crops)} pixels, expected bool, as many as the boxes cover")
        if num_regions and not 0 <= int(self.view_index.min()) <= int(self.view_index.max()) < self.num_views:
            raise InputError(f"a region's view index is not in [0, {self.num_views})")

    @property
    def crop_sizes(self) -> Tensor:
        """(D, 2) int64: width and height of each crop."""
        return self.boxes[:, 2:] - self.boxes[:, :2]

    @cached_property
    def offsets(self) -> Tensor:
        """(D + 1,) int64: region d's crop is `crops[offsets[d]:offsets[d + 1]]`."""
        return torch.nn.functional.pad(self.crop_sizes.prod(1).cumsum(0), (1, 0))

    @cached_property
    def areas(self) -> Tensor:
        """(D,) int64: number of pixels of each mask, #_a in Eq. 3."""
        parts = self._parts()
        return torch.stack([part.sum() for part in parts]) if parts else torch.zeros_like(self.view_index)

    @property
    def num_per_view(self) -> Tensor:
        """(V,) int64: number of regions in each view."""
        return torch.bincount(self.view_index, minlength=self.num_views)

    def crop(self, index: int) -> Tensor:
        """(h, w) bool: the crop of one region, a view into `crops`."""
        start, end = self.offsets[index : index + 2].tolist()
        width, height = self.crop_sizes[index].tolist()
        return self.crops[start:end].reshape(height, width)

    def placed(self, index: int) -> Crop:
        """The crop of one region, with its box."""
        x1, y1, x2, y2 = self.boxes[index].tolist()
        return Crop((x1, y1, x2, y2), self.crop(index))

    def overlaps(self) -> list[tuple[int, int, int]]:
        """The pairs of regions of one view that share pixels: the earlier one, the later one, and how many."""
        pairs: list[tuple[int, int, int]] = []
        views, boxes = self.view_index.cpu().numpy(), self.boxes.cpu().numpy()
        crops = [self.crop(row).cpu().numpy() for row in range(len(self))]
        for view in np.unique(views).tolist():
            rows = np.flatnonzero(views == view).tolist()
            counts = np.zeros(boxes[rows, 3:1:-1].max(0), np.int32)  # how many show each pixel
            for row in rows:
                counts[_slices(boxes[row])] += crops[row]
            rows = [row for row in rows if (counts[_slices(boxes[row])][crops[row]] > 1).any()]
            for one, other in combinations(rows, 2):
                box = np.concatenate((np.maximum(*boxes[[one, other], :2]), np.minimum(*boxes[[one, other], 2:])))
                parts = [crops[row][_slices(box - np.tile(boxes[row, :2], 2))] for row in (one, other)]
                if (box[:2] < box[2:]).all() and (shared := int(np.count_nonzero(parts[0] & parts[1]))):
                    pairs.append((one, other, shared))
        return pairs

    def at(self, view: int, x: int, y: int) -> list[int]:
        """The regions of a view that show the pixel in column x, row y, ascending; none outside of the image."""
        here = (self.view_index == view).nonzero()[:, 0].tolist()
        return [index for index in here if self.placed(index).holds(x, y)]

    def union(self, indices: Iterable[int]) -> Crop:
        """Union of one or more regions of one view."""
        first, *others = map(self.placed, indices)
        return first.union(*others)

    def mask(self, index: int, width: int, height: int) -> Tensor:
        """(height, width) bool: one region as a full frame, for drawing and writing."""
        return self.placed(index).paste((width, height))

    def _pick_rows(self, index: Any) -> dict[str, Any]:
        ends = torch.stack((self.offsets[:-1][index], self.offsets[1:][index]), 1).tolist()
        crops = [self.crops[:0], *(self.crops[start:end] for start, end in ends)]
        return super()._pick_rows(index) | {"crops": torch.cat(crops)}

    def of_views(self, views: Tensor) -> Regions:
        """The regions of the views at (S,) int64, each named once, as those of views 0 to S - 1; by view."""
        place = torch.full((self.num_views,), -1, device=self.device)
        place[views.to(self.device)] = torch.arange(len(views), device=self.device)
        view_index = place[self.view_index]
        kept = (view_index >= 0).nonzero()[:, 0]
        kept = kept[view_index[kept].argsort(stable=True)]
        return replace(self.select(kept), view_index=view_index[kept], num_views=len(views))

    def pixels(self) -> tuple[Tensor, Tensor]:
        """Centres of the mask pixels: xy (P, 2) float32, at half integers, and owner (P,) int64, the region of each."""
        flat = self.crops.nonzero()[:, 0]
        of_region = torch.stack((self.offsets[:-1], self.crop_sizes[:, 0], self.boxes[:, 0], self.boxes[:, 1]))
        start, width, x1, y1 = (torch.repeat_interleave(of, self.areas, output_size=len(flat)) for of in of_region)
        local = flat - start
        down = local // width
        owner = torch.repeat_interleave(self.areas, output_size=len(flat))
        # one column after the other in memory: what works on all x, then on all y, is four times faster
        xy = torch.stack((local - down * width + x1, down + y1)).float().add_(0.5).T
        return xy, owner

    def thin(self, most: float) -> tuple[Regions, Tensor, Tensor]:
        """Thin masks of more than `most` pixels to a square lattice of at most about `most` points; a sliver that
        misses every lattice point keeps all of its pixels.

        Returns:
            The masks of lattice points, each with the box (0, 0, columns, rows); (D, 2) float32, the centre of the
            first lattice point; (D,) int64, the step of the lattice, pixels.
        """
        steps = (self.areas / most).sqrt().ceil().long().clamp(min=1).tolist()
        crops, boxes, origin = [self.crops[:0]], [], []
        for index, (part, (x1, y1, x2, y2)) in enumerate(zip(self._parts(), self.boxes.tolist(), strict=True)):
            crop, step = part.reshape(y2 - y1, x2 - x1), steps[index]
            row, column = -y1 % step, -x1 % step
            on_lattice = crop[row::step, column::step]
            if step > 1 and not on_lattice.any():
                row, column, steps[index], on_lattice = 0, 0, 1, crop
            crops.append(on_lattice.flatten())
            boxes.append((0, 0, on_lattice.shape[1], on_lattice.shape[0]))
            origin.append((x1 + column + 0.5, y1 + row + 0.5))
        box = torch.tensor(boxes, dtype=torch.int64, device=self.device).reshape(-1, 4)
        first = torch.tensor(origin, dtype=torch.float32, device=self.device).reshape(-1, 2)
        thinned = replace(self, boxes=box, crops=torch.cat(crops))
        return thinned, first, torch.tensor(steps, dtype=torch.int64, device=self.device)

    def _parts(self) -> tuple[Tensor, ...]:
        return self.crops.split(self.crop_sizes.prod(1).tolist())

    def runs(self, longest: int) -> tuple[Tensor, Tensor, Tensor]:
        """The mask pixels as runs along the rows of the image, of at most `longest` pixels: xy (P, 2) float32, the
        centre of the first pixel of each run; length (P,) int64, pixels; owner (P,) int64, its region, ordered."""
        widths, heights = self.crop_sizes.unbind(1)
        region = torch.repeat_interleave(heights)
        row = torch.arange(len(region), device=self.device) - (heights.cumsum(0) - heights)[region]
        left = self.offsets[region] + row * widths[region]  # of each row, in the flat crops
        right = left + widths[region] - 1
        starts, ends = self.crops.clone(), self.crops.clone()
        starts[1:] &= ~self.crops[:-1]
        ends[:-1] &= ~self.crops[1:]
        starts[left], ends[right] = self.crops[left], self.crops[right]
        first = starts.nonzero()[:, 0]
        length = ends.nonzero()[:, 0] - first + 1
        of_row = torch.searchsorted(left, first, right=True) - 1
        x = first - left[of_row] + self.boxes[region[of_row], 0]
        y = row[of_row] + self.boxes[region[of_row], 1]
        pieces = (length + longest - 1) // longest
        of_run = torch.repeat_interleave(pieces)
        begin = longest * (torch.arange(len(of_run), device=self.device) - (pieces.cumsum(0) - pieces)[of_run])
        xy = torch.stack((x[of_run] + begin, y[of_run])).float().add_(0.5).T
        return xy, (length[of_run] - begin).clamp(max=longest), region[of_row][of_run]

    def spread_pixels(self, most: int) -> tuple[Tensor, Tensor]:
        """At most `most` pixels of each region, evenly spread over its pixels in reading order: xy (Q, 2) float32,
        pixel centres; region (Q,) int64, ordered."""
        picked = [torch.zeros(0, dtype=torch.int64, device=self.device)]
        for part in self._parts():
            flat = part.nonzero()[:, 0]
            taken = min(len(flat), most)
            odd = 2 * torch.arange(taken, device=self.device) + 1
            picked.append(flat[odd * len(flat) // max(2 * taken, 1)])
        region = torch.repeat_interleave(self.areas.clamp(max=most))
        local, width = torch.cat(picked), self.crop_sizes[region, 0]
        corner = torch.stack((local % width, local // width), 1) + self.boxes[region, :2]
        return corner.float() + 0.5, region

    def label_map(self, view: int, values: Tensor, size: Sequence[int]) -> Tensor:
        """Paint the regions of one view into one frame of `size` width, height, each with its value of (D,) int64; 0 or
        less: left out. Returns (height, width) int64, 0 elsewhere. The smaller of overlapping regions is on top."""
        frame = torch.zeros(size[1], size[0], dtype=torch.int64, device=self.device)
        numbers = values.tolist()
        for index in self.large_first(view):
            if numbers[index] > 0:
                crop = self.placed(index)
                crop.cut(frame)[crop.pixels] = numbers[index]
        return frame

    def large_first(self, view: int) -> list[int]:
        """The regions of a view by their areas: painted in this order, small ones lie on top."""
        members = (self.view_index == view).nonzero()[:, 0]
        return members[self.areas[members].argsort(descending=True, stable=True)].tolist()


def regions_from_label_maps(label_maps: Iterable[np.ndarray | Tensor]) -> Regions:
    """Regions from one label map per view.

    Args:
        label_maps: V integer arrays or tensors (H, W), each of its own size, one at a time in memory; 0 is nothing,
            65535 is ignored, every other number is one region of that view.

    Returns:
        Regions ordered by view, then by number; `labels` holds the numbers.

    Raises:
        InputError: something else than such an array.
    """
    rows: list[tuple[int, Crop, int]] = []
    num_views = 0
    for view, given in enumerate(label_maps):
        label_map: object = given.detach().cpu().numpy() if isinstance(given, Tensor) else given
        if not isinstance(label_map, np.ndarray) or label_map.ndim != 2 or label_map.dtype.kind not in "uib":
            kind = f"{type(label_map).__name__} {getattr(label_map, 'shape', '')} {getattr(label_map, 'dtype', '')}"
            raise InputError(f"view {view}: the label map is a {kind.strip()}, expected an integer array (H, W)")
        num_views = view + 1
        for number, (x1, y1, x2, y2) in label_boxes(label_map).items():
            crop = Crop((x1, y1, x2, y2), torch.from_numpy(label_map[y1:y2, x1:x2] == number))
            rows.append((view, crop, number))
    return stack_regions(rows, num_views)


def _slices(box: np.ndarray) -> tuple[slice, slice]:
    x1, y1, x2, y2 = box.tolist()
    return slice(y1, y2), slice(x1, x2)


def label_boxes(label_map: np.ndarray) -> dict[int, Box]:
    """{number: x1, y1, x2, y2 (half-open)} of an integer label map (H, W), without 0 and 65535; ascending."""
    numbers: Iterable[int] = range(1, IGNORE_LABEL)
    dense = label_map.view(np.uint8) if label_map.dtype == bool else label_map
    if dense.min(initial=0) < 0 or dense.max(initial=0) > IGNORE_LABEL:
        distinct, inverse = np.unique(dense, return_inverse=True)
        numbers, dense = distinct.tolist(), inverse.reshape(dense.shape) + 1
    boxes = {}
    for number, place in zip(numbers, ndimage.find_objects(dense, max(1, int(dense.max(initial=0)))), strict=False):
        if place is not None and number not in (0, IGNORE_LABEL):
            boxes[number] = (place[1].start, place[0].start, place[1].stop, place[0].stop)
    return boxes


def stack_regions(rows: Sequence[tuple[int, Crop, int]], num_views: int) -> Regions:
    """Regions from the view, the mask and the label of each, on the CPU; there may be none."""
    view_index, crops, labels = zip(*rows, strict=True) if rows else ((), (), ())
    return Regions(
        view_index=torch.tensor(view_index, dtype=torch.int64),
        boxes=torch.tensor([each.box for each in crops], dtype=torch.int64).reshape(-1, 4),
        crops=torch.cat([torch.zeros(0, dtype=torch.bool), *(each.pixels.flatten() for each in crops)]),
        num_views=num_views,
        labels=torch.tensor(labels, dtype=torch.int64),
    )


def name_regions(regions: Regions) -> list[str]:
    """A name of each of D regions by view and pixels: regions have the same name only if they are equal."""
    regions = regions.to("cpu")
    places = zip(regions.view_index.tolist(), regions.boxes.tolist(), strict=True)
    pixels = (hashlib.sha256(regions.crop(row).numpy().tobytes()).hexdigest() for row in range(len(regions)))
    return [f"{view} {box} {digest}" for (view, box), digest in zip(places, pixels, strict=True)]
