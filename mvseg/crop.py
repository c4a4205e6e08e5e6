"""One mask: a box in its photo, and the pixels in it. Boxes are cut out of frames, and pasted into them, only here."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeVar

import numpy as np
import torch
from torch import Tensor

Box = tuple[int, int, int, int]
Frame = TypeVar("Frame", Tensor, np.ndarray)


@dataclass(frozen=True, eq=False)
class Crop:
    """A mask as a crop: `pixels` (y2 - y1, x2 - x1) bool of a `box` x1, y1, x2, y2 in pixels, half-open, which may
    reach beyond the photo."""

    box: Box
    pixels: Tensor

    @staticmethod
    def of(mask: Tensor | np.ndarray, corner: tuple[int, int] = (0, 0)) -> Crop:
        """The tight crop of a mask (H, W) bool whose top-left pixel is at `corner` x, y, see `tighten`."""
        pixels, (x, y) = torch.as_tensor(mask), corner
        return Crop((x, y, x + pixels.shape[1], y + pixels.shape[0]), pixels).tighten()

    @property
    def area(self) -> int:
        """Pixels of the mask."""
        return int(self.pixels.sum())

    def holds(self, x: int, y: int) -> bool:
        """Whether the pixel in column x, row y of the photo is one of the mask."""
        x1, y1, x2, y2 = self.box
        return x1 <= x < x2 and y1 <= y < y2 and bool(self.pixels[y - y1, x - x1])

    def cut(self, frame: Frame) -> Frame:
        """(h, w, ...) view of a frame (H, W, ...) in the box, which must lie inside."""
        x1, y1, x2, y2 = self.box
        return frame[y1:y2, x1:x2]

    def within(self, box: Box) -> Crop:
        """The same mask in another box; what lies outside is lost."""
        (x1, y1, x2, y2), (left, top, right, bottom) = self.box, box
        pixels = self.pixels.new_zeros(bottom - top, right - left)
        a, b, c, d = max(x1, left), max(y1, top), min(x2, right), min(y2, bottom)
        if a < c and b < d:
            pixels[b - top : d - top, a - left : c - left] = self.pixels[b - y1 : d - y1, a - x1 : c - x1]
        return Crop(box, pixels)

    def paste(self, size: tuple[int, int]) -> Tensor:
        """(height, width) bool: the mask as a full frame of size width, height."""
        return self.within((0, 0, *size)).pixels

    def tighten(self) -> Crop:
        """The same mask in the smallest box; where it has no pixel, that of the top-left one, which is not set."""
        rows, columns = (self.pixels.any(axis).nonzero()[:, 0] for axis in (1, 0))
        if not len(rows):
            rows = columns = torch.zeros(1, dtype=torch.int64)
        (left, right), (top, bottom) = columns[[0, -1]].tolist(), rows[[0, -1]].tolist()
        box = (self.box[0] + left, self.box[1] + top, self.box[0] + right + 1, self.box[1] + bottom + 1)
        return Crop(box, self.pixels[top : bottom + 1, left : right + 1].clone())  # a view would hold the whole frame

    def union(self, *others: Crop) -> Crop:
        """Union of the mask and others, in the box around all."""
        x1, y1, x2, y2 = zip(*(each.box for each in (self, *others)), strict=True)
        box = min(x1), min(y1), max(x2), max(y2)
        return Crop(box, torch.stack([each.within(box).pixels for each in (self, *others)]).any(0))

    def intersect(self, other: Crop) -> Crop:
        """Intersection of both masks, in the box of this one."""
        return Crop(self.box, self.pixels & other.within(self.box).pixels)

    def iou(self, other: Crop) -> float:
        """Intersection over union; 0 without a pixel in either."""
        both = self.intersect(other).area
        return both / max(self.area + other.area - both, 1)
