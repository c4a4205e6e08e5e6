"""The weighted graph of regions (Eq. 3)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from mvseg.errors import check_arguments
from mvseg.matching.epipolar import Bins, binned_pairs, dilate
from mvseg.matching.samples import draw_points, view_runs, view_samples
from mvseg.regions import Regions
from mvseg.scene import Cameras


@dataclass(frozen=True, eq=False)
class Affinity:
    """The undirected weighted graph G = (V, E, w) of the paper, sparse.

    Attributes:
        edges: (E, 2) int64, pairs of regions of different views, first < second, each pair once.
        weights: (E,) float32 in (0, 1], the mean of the two directions of Eq. 3; pairs of weight 0 are left out.
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


@check_arguments
def region_affinity(regions: Regions, cameras: Cameras, *, num_points: int | None = None, seed: int = 0) -> Affinity:
    """Affinity of all pairs of regions in different views (Eq. 3), symmetrised. The graph is on the device of the
    regions.

    Args:
        cameras: pairs of views that share a camera centre are skipped: their regions get no edge.
        num_points: random pixels per region that send out epipolar lines (the paper: 200). None, the default, uses all
            pixels: no slower, and without sampling noise.
    """
    samples, members = view_runs(regions)
    senders = None if num_points is None else draw_points(view_samples(regions)[0], num_points, seed)
    edges = [torch.zeros(2, 0, dtype=torch.int64, device=regions.device)]
    weights = [torch.zeros(0, device=regions.device)]
    # thousands of small operations: on a CPU, what autograd notes of each is a fifth of the time
    with torch.inference_mode(regions.device.type == "cpu"):
        for pair in binned_pairs(samples, cameras, senders=senders):
            j_from_i, i_from_j = pairwise_affinity(pair.bins, pair.pixels, pair.lines)
            mean = (j_from_i + i_from_j.T) / 2
            first, second = mean.nonzero().unbind(1)
            edges.append(torch.stack((members[pair.i][first], members[pair.j][second])))
            weights.append(mean[first, second])
    return Affinity(torch.stack(torch.aminmax(torch.cat(edges, 1), dim=0), 1), torch.cat(weights), len(regions))


def pairwise_affinity(bins: Bins, pixels: tuple[Tensor, Tensor], lines: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor]:
    """Both directions of Eq. 3 for the regions of two views.

    w(n -> m) is the fraction of m's pixels inside the band of n, times the fraction of n's lines that pass through m.
    `pixels` and `lines` hold (N, B) and (M, B) float32: pixels of the regions of views i and j in each bin, and lines
    that they send out. Returns w(i -> j) (N, M) and w(j -> i) (M, N), float32 in [0, 1].
    """
    bands = tuple(dilate(lines[side], bins.band_radius(side)) for side in (0, 1))
    inside = bands[0] @ pixels[1].T, bands[1] @ pixels[0].T  # pixels of the other view in each region's band
    through = tuple(
        # one line per pixel, as thick as the band: then the same pixels are counted
        inside[1 - side].T
        if lines is pixels and bins.band_radius(1 - side) == bins.half_line[1 - side]
        else lines[side] @ dilate(pixels[1 - side], bins.half_line[1 - side]).T
        for side in (0, 1)
    )
    num_pixels = [each.sum(1).clamp_(min=1) for each in pixels]
    num_lines = num_pixels if lines is pixels else [each.sum(1).clamp_(min=1) for each in lines]
    # shares of pixels in float32: their sums are 1 up to rounding where all of them are inside
    shares = [inside[side] / num_pixels[1 - side] * (through[side] / num_lines[side][:, None]) for side in (0, 1)]
    return shares[0].clamp_(max=1), shares[1].clamp_(max=1)
