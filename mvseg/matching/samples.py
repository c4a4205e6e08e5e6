"""The pixels of regions, view by view: one by one, as runs along the rows, or a random few."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from torch import Tensor

from mvseg.matching.numbers import EPIPOLAR
from mvseg.regions import Regions


@dataclass(frozen=True, eq=False)
class Samples:
    """P pixels, or runs of pixels along rows, of N regions of one view.

    Attributes:
        xy: (P, 2) float32, pixel centres; of a run, that of its first pixel.
        owner: (P,) int64 in [0, N), the region of each.
        weight: (P,) float32, number of mask pixels that each stands for.
        last_xy: (P, 2) float32, the centre of the last pixel of each run; None: these are pixels.
        length: (P,) int64, number of pixels, or lattice points, of each run.
    """

    xy: Tensor
    owner: Tensor
    weight: Tensor
    num_regions: int
    last_xy: Tensor | None = None
    length: Tensor | None = None

    @cached_property
    def ends_xy(self) -> Tensor:
        """(2 P, 2) the first pixels of all runs, then the last ones; (P, 2) for pixels."""
        return self.xy if self.last_xy is None else torch.cat((self.xy.T, self.last_xy.T), 1).T

    @cached_property
    def num_pixels(self) -> float:
        """Sum of the weights."""
        return float(self.weight.sum())

    def pixels(self, keep: Tensor | None = None) -> Samples:
        """All pixels of the runs, or of some (P,) bool; samples of pixels as they are."""
        if self.last_xy is None or self.length is None:
            return self
        fields = (self.xy, self.last_xy, self.owner, self.weight, self.length)
        xy, last, owner, weight, length = fields if keep is None else (each[keep] for each in fields)
        run = torch.repeat_interleave(length)
        step = torch.arange(len(run), device=xy.device) - (length.cumsum(0) - length)[run]
        pitch = (last - xy) / (length - 1).clamp(min=1)[:, None]
        every = (xy[run] + step[:, None] * pitch[run]).T.contiguous().T
        return Samples(xy=every, owner=owner[run], weight=(weight / length)[run], num_regions=self.num_regions)


def view_samples(regions: Regions) -> tuple[list[Samples], list[Tensor]]:
    """The pixels of the regions, view by view: V `Samples`, and V int64 tensors: the index in `regions` of each region
    of the view, in the order of `owner`."""
    members = [(regions.view_index == view).nonzero()[:, 0] for view in range(regions.num_views)]
    samples = []
    for nodes in members:
        xy, owner = regions.select(nodes).pixels()
        samples.append(Samples(xy=xy, owner=owner, weight=torch.ones_like(xy[:, 0]), num_regions=len(nodes)))
    return samples, members


def view_runs(regions: Regions, max_per_region: float = math.inf) -> tuple[list[Samples], list[Tensor]]:
    """The pixels of the regions as runs of at most `EPIPOLAR.run_px` along the rows, view by view; see `view_samples`.
    Of masks of more than `max_per_region` pixels, the runs of points of a lattice (see `Regions.thin`)."""
    members = [(regions.view_index == view).nonzero()[:, 0] for view in range(regions.num_views)]
    samples = []
    for nodes in members:
        areas = regions.areas[nodes]
        chosen, origin, steps = regions.select(nodes).thin(max_per_region)
        lattice_xy, length, owner = chosen.runs(EPIPOLAR.run_px)
        pitch, weight = steps[owner], length * (areas / chosen.areas.clamp(min=1)).float()[owner]
        xy = ((lattice_xy - 0.5) * pitch[:, None] + origin[owner]).T.contiguous().T
        last = torch.stack((xy[:, 0] + (length - 1) * pitch, xy[:, 1])).T
        samples.append(Samples(xy=xy, owner=owner, weight=weight, num_regions=len(nodes), last_xy=last, length=length))
    return samples, members


def draw_points(samples: Sequence[Samples], num_points: int, seed: int) -> list[Samples]:
    """`num_points` random pixels of each region, drawn with replacement as in the paper (Sec. 3.1); weights 1. The
    samples are pixels in the order of their regions."""
    generator = torch.Generator().manual_seed(seed)
    drawn = []
    for sample in samples:
        counts = torch.bincount(sample.owner, minlength=sample.num_regions)
        first = counts.cumsum(0) - counts
        draw = torch.rand(sample.num_regions, num_points, generator=generator).to(sample.xy.device)
        picks = (first[:, None] + (draw * counts[:, None]).long()).flatten()
        ones = torch.ones_like(sample.weight[picks])
        drawn.append(replace(sample, xy=sample.xy[picks], owner=sample.owner[picks], weight=ones))
    return drawn
