"""Stage 4: the weighted graph of regions (Eq. 3)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor
from tqdm import tqdm

from mvseg.epipolar import (
    Bins,
    Pencil,
    Samples,
    bin_histogram,
    choose_bins,
    dilate,
    epipolar_pencil,
    is_coincident,
    view_samples,
)
from mvseg.regions import Regions
from mvseg.scene import Cameras


@dataclass(frozen=True, eq=False)
class Affinity:
    """The undirected weighted graph G = (V, E, w) of the paper, sparse.

    Attributes:
        edges: (E, 2) int64, pairs of regions of different views, first < second, each pair once.
        weights: (E,) float32 in (0, 1], the mean of the two directions of Eq. 3; pairs of weight 0 are left out.
        num_regions: D.
    """

    edges: Tensor
    weights: Tensor
    num_regions: int

    def to_dense(self) -> Tensor:
        """(D, D) float32, symmetric, zero diagonal: the paper's W."""
        dense = torch.zeros(self.num_regions, self.num_regions, device=self.weights.device)
        first, second = self.edges.unbind(1)
        dense[first, second] = self.weights
        dense[second, first] = self.weights
        return dense


def region_affinity(
    regions: Regions, cameras: Cameras, *, num_points: int | None = None, seed: int = 0, progress: bool = False
) -> Affinity:
    """Affinity of all pairs of regions in different views (Eq. 3), symmetrised.

    Args:
        regions: D regions in V views.
        cameras: V cameras. Pairs of views at one place are skipped: their regions get no edge.
        num_points: how many random pixels of a region send out epipolar lines. None takes all pixels, which is no
            slower, has no sampling noise and is the default; the paper takes 200.
        seed: of the random pixels.
        progress: show a progress bar over the pairs of views.

    Returns:
        The graph. A region in a view alone, or whose bands meet nothing, has no edge.
    """
    samples, members = view_samples(regions)
    senders = samples if num_points is None else _draw_points(samples, num_points, seed)
    edges, weights = [torch.zeros(0, 2, dtype=torch.int64, device=regions.device)], []
    for i, j, pencil, bins in view_pairs(samples, cameras, progress=progress):
        both = pairwise_affinity(pencil, bins, (samples[i], samples[j]), (senders[i], senders[j]))
        mean = both[0].add(both[1].T) / 2
        place = mean.nonzero()
        pair = torch.stack((members[i][place[:, 0]], members[j][place[:, 1]]), 1)
        edges.append(pair.sort(1).values)
        weights.append(mean[place[:, 0], place[:, 1]])
    empty = torch.zeros(0, device=regions.device)
    return Affinity(torch.cat(edges), torch.cat([empty, *weights]), len(regions))


def pairwise_affinity(
    pencil: Pencil, bins: Bins, targets: tuple[Samples, Samples], senders: tuple[Samples, Samples]
) -> tuple[Tensor, Tensor]:
    """Both directions of Eq. 3 for the regions of two views.

    w(n -> m) is the fraction of m's pixels inside the band of n, times the fraction of n's lines that pass through m.

    Args:
        pencil: of the two views.
        bins: of the angles of both views' pixels.
        targets: all pixels of the N regions of view i and of the M regions of view j.
        senders: the pixels of the same regions that send out lines.

    Returns:
        w(i -> j) (N, M) and w(j -> i) (M, N), float32 in [0, 1].
    """
    pixels = [bin_histogram(pencil, bins, side, targets[side]) for side in (0, 1)]
    lines = [pixels[s] if senders[s] is targets[s] else bin_histogram(pencil, bins, s, senders[s]) for s in (0, 1)]
    return (
        _directed(lines[0], pixels[1], bins.band_radius(0), bins.half_line[1]),
        _directed(lines[1], pixels[0], bins.band_radius(1), bins.half_line[0]),
    )


def _directed(lines: Tensor, pixels: Tensor, band_radius: int, half_line: int) -> Tensor:
    """(N, M) affinity from (N, B) line counts and (M, B) pixel counts."""
    covered = dilate(lines > 0, band_radius) @ pixels.T / pixels.sum(1).clamp(min=1)
    passing = lines @ dilate(pixels > 0, half_line).T / lines.sum(1, keepdim=True).clamp(min=1)
    return covered * passing


def view_pairs(
    samples: list[Samples], cameras: Cameras, *, progress: bool = False
) -> Iterator[tuple[int, int, Pencil, Bins]]:
    """The pairs of views i < j that both hold pixels and have a baseline, each with its pencil and bins."""
    skip = is_coincident(cameras).tolist()
    occupied = [view for view, sample in enumerate(samples) if len(sample.xy)]
    pairs = [(i, j) for i in occupied for j in occupied if i < j and not skip[i][j]]
    for i, j in tqdm(pairs, desc="epipolar weights", unit="pair", disable=not progress):
        pencil = epipolar_pencil(cameras, i, j)
        yield i, j, pencil, choose_bins(pencil, (samples[i], samples[j]))


def _draw_points(samples: list[Samples], num_points: int, seed: int) -> list[Samples]:
    """`num_points` random pixels of each region, drawn with replacement as in the paper; weights 1."""
    generator = torch.Generator().manual_seed(seed)
    drawn = []
    for sample in samples:
        counts = torch.bincount(sample.owner, minlength=sample.num_regions)
        first = counts.cumsum(0) - counts
        draw = torch.rand(sample.num_regions, num_points, generator=generator).to(sample.xy.device)
        order = sample.owner.argsort(stable=True)
        picks = order[(first[:, None] + (draw * counts[:, None]).long()).flatten()]
        owner = sample.owner[picks]
        drawn.append(Samples(sample.xy[picks], owner, torch.ones_like(sample.weight[picks]), sample.num_regions))
    return drawn
