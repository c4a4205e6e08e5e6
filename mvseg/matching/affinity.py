"""The weighted graph of regions (Eq. 3)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from mvseg.matching.epipolar import Bins, binned_pairs, dilate, draw_points, view_samples
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
        cameras: V cameras. Pairs of views that share a camera centre are skipped: their regions get no edge.
        num_points: random pixels per region that send out epipolar lines (the paper: 200). None, the default, uses all
            pixels: no slower, and without sampling noise.
        seed: for the random pixels.
        progress: show a progress bar over the pairs of views.

    Returns:
        The graph. A region of weight 0 to all regions of the other views has no edge.
    """
    samples, members = view_samples(regions)
    senders = None if num_points is None else draw_points(samples, num_points, seed)
    edges, weights = [torch.zeros(0, 2, dtype=torch.int64, device=regions.device)], []
    for pair in binned_pairs(samples, cameras, senders=senders, progress=progress):
        i, j = pair.i, pair.j
        j_from_i, i_from_j = pairwise_affinity(pair.bins, pair.pixels, pair.lines)
        mean = (j_from_i + i_from_j.T) / 2
        first, second = mean.nonzero().unbind(1)
        edges.append(torch.stack((members[i][first], members[j][second]), 1).sort(1).values)
        weights.append(mean[first, second])
    empty = torch.zeros(0, device=regions.device)
    return Affinity(torch.cat(edges), torch.cat([empty, *weights]), len(regions))


def pairwise_affinity(bins: Bins, pixels: tuple[Tensor, Tensor], lines: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor]:
    """Both directions of Eq. 3 for the regions of two views.

    w(n -> m) is the fraction of m's pixels inside the band of n, times the fraction of n's lines that pass through m.

    Args:
        bins: B half-planes of the two views' pencil.
        pixels: (N, B) and (M, B) float32, pixels of the regions of view i and of view j in each bin.
        lines: (N, B) and (M, B) float32, lines that the same regions send out in each bin.

    Returns:
        w(i -> j) (N, M) and w(j -> i) (M, N), float32 in [0, 1].
    """
    j_from_i = _directed(lines[0], pixels[1], band_radius=bins.band_radius(0), half_line=bins.half_line[1])
    return j_from_i, _directed(lines[1], pixels[0], band_radius=bins.band_radius(1), half_line=bins.half_line[0])


def _directed(lines: Tensor, pixels: Tensor, *, band_radius: int, half_line: int) -> Tensor:
    """(N, M) affinity from (N, B) line counts and (M, B) pixel counts."""
    covered = dilate(lines > 0, band_radius) @ pixels.T / pixels.sum(1).clamp(min=1)
    passing = lines @ dilate(pixels > 0, half_line).T / lines.sum(1, keepdim=True).clamp(min=1)
    return covered * passing
