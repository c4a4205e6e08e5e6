"""Stage 3: the epipolar pencil of two cameras (Eqs. 1, 2 and 4), without drawing a line.

Two cameras and their baseline b span a pencil of half-planes bounded by b. A pixel of either image lies in exactly one
of them, and that half-plane is all that epipolar geometry knows about the pixel: its epipolar line in the other image
(Eq. 1) is where the same half-plane meets that image. So a region is a histogram over the angle of the half-plane, its
epipolar band (Eq. 2) is the set of occupied bins, and an epipolar map (Eq. 4) is a look-up.

Departure from the paper: half-planes instead of full lines. The half of a line beyond the epipole belongs to points
behind one of the cameras; where both epipoles lie outside the images the two are the same.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import ceil

import torch
from torch import Tensor

from mvseg.errors import InputError
from mvseg.regions import Regions
from mvseg.scene import Cameras

BINS_PER_PIXEL = 2  # a bin is half a pixel wide, so that a line of two pixels is resolved
MIN_BINS, MAX_BINS = 64, 8192
COINCIDENT = 1e-6  # baselines shorter than this fraction of the longest one have no epipolar geometry


@dataclass(frozen=True, eq=False)
class Samples:
    """P pixels of N regions of one view.

    Attributes:
        xy: (P, 2) float32, pixel centres.
        owner: (P,) int64 in [0, N), the region of each pixel.
        weight: (P,) float32, number of mask pixels that each stands for.
        num_regions: N.
    """

    xy: Tensor
    owner: Tensor
    weight: Tensor
    num_regions: int


def view_samples(regions: Regions, max_per_region: int | None = None) -> tuple[list[Samples], list[Tensor]]:
    """The pixels of the regions, view by view.

    Args:
        regions: D regions in V views.
        max_per_region: see `Regions.pixels`.

    Returns:
        V `Samples`, and V int64 tensors with the indices in `regions` that the owners of a view stand for.
    """
    xy, owner, weight = regions.pixels(max_per_region)
    members = [(regions.view_index == view).nonzero()[:, 0] for view in range(regions.num_views)]
    rank = torch.empty(len(regions), dtype=torch.int64, device=regions.device)
    for nodes in members:
        rank[nodes] = torch.arange(len(nodes), device=regions.device)
    view_of_pixel = regions.view_index[owner]
    order = view_of_pixel.argsort(stable=True)
    ends = torch.bincount(view_of_pixel, minlength=regions.num_views).tolist()
    parts = zip(xy[order].split(ends), rank[owner[order]].split(ends), weight[order].split(ends), members, strict=True)
    return [Samples(p, o, w, len(nodes)) for p, o, w, nodes in parts], members


@dataclass(frozen=True, eq=False)
class Pencil:
    """The half-planes through the baseline of cameras i and j.

    Attributes:
        plane_from_px: (2, 2, 3) float64, for camera i and camera j: (u, v, 1) -> (x, y), the viewing ray of the pixel
            projected along the baseline. The angle of (x, y) is the angle of the half-plane, equal in both images.
    """

    plane_from_px: Tensor

    def angles(self, side: int, xy: Tensor) -> Tensor:
        """Half-plane of each pixel (Eq. 1: pixels of i and j with equal angle lie on each other's epipolar lines).

        Args:
            side: 0 for camera i, 1 for camera j.
            xy: (P, 2) pixel positions.

        Returns:
            (P,) float32 in [-2, 2], a monotone stand-in for atan2 that needs one division (the 1-norm angle
            y / (|x| + |y|), continued over the left half-plane). 0 at an epipole, where no half-plane is defined.
        """
        x, y = self._plane(side, xy)
        angle = y / (x.abs() + y.abs()).clamp(min=torch.finfo(x.dtype).tiny)
        return torch.where(x < 0, torch.where(y < 0, -2 - angle, 2 - angle), angle)

    def pitch(self, side: int, xy: Tensor) -> float:
        """Mean change of the angle when a pixel moves by one pixel across its epipolar line.

        It is the mean of |x grad y - y grad x| / (|x| + |y|)^2 over the pixels; pixels within a pixel of the epipole,
        where it diverges, count as one pixel away from it.
        """
        x, y = self._plane(side, xy)
        gradient = self.plane_from_px[side, :, :2].to(x)
        across = torch.linalg.vector_norm(x[:, None] * gradient[1] - y[:, None] * gradient[0], dim=1)
        reach = torch.maximum(x.abs() + y.abs(), gradient.abs().sum())
        return float((across / reach**2).mean())

    def _plane(self, side: int, xy: Tensor) -> tuple[Tensor, Tensor]:
        rows = self.plane_from_px[side].to(xy)
        x, y = (xy @ rows[:, :2].T + rows[:, 2]).unbind(1)
        return x, y


def is_coincident(cameras: Cameras) -> Tensor:
    """(V, V) bool: the pair has no baseline (shorter than 1e-6 of the scene's longest), so no epipolar geometry."""
    distance = torch.cdist(cameras.centers, cameras.centers)
    return distance <= COINCIDENT * distance.max()


def epipolar_pencil(cameras: Cameras, i: int, j: int) -> Pencil:
    """The pencil of two cameras.

    Any baseline will do: an epipole inside an image or at infinity and cameras that look at each other are no special
    cases.

    Raises:
        InputError: cameras i and j share a centre (no epipolar geometry).
    """
    baseline = cameras.centers[j] - cameras.centers[i]
    length = torch.linalg.vector_norm(baseline)
    if length == 0:
        raise InputError(f"views {i} and {j} were taken from one place, expected a baseline between them")
    axis = baseline / length
    world_from_px = cameras.world_from_px[[i, j]]
    # Angle 0 points where both cameras look, so that the jump at +-2 is as far from the regions as it can be.
    forward = cameras.R[[i, j], 2].sum(0)
    forward = forward - (forward @ axis) * axis
    if torch.linalg.vector_norm(forward) < 1e-9:  # both look along the baseline: any direction across it serves
        forward = torch.linalg.cross(axis, torch.eye(3).to(axis)[axis.abs().argmin()])
    e1 = forward / torch.linalg.vector_norm(forward)
    e2 = torch.linalg.cross(axis, e1)
    return Pencil(torch.stack((e1, e2)) @ world_from_px)


@dataclass(frozen=True, eq=False)
class Bins:
    """A common binning of the angles of two images.

    Attributes:
        low: smallest angle.
        per_unit: bins per unit of angle.
        num_bins: B.
        half_line: for image i and image j, how many bins half the thickness of a line is there.
        half_pixel: the same for half a pixel, rounded up.
    """

    low: float
    per_unit: float
    num_bins: int
    half_line: tuple[int, int]
    half_pixel: tuple[int, int]

    def index(self, angles: Tensor) -> Tensor:
        """(P,) int64 bin of each angle; angles outside the binning give a number outside [0, B)."""
        return ((angles - self.low) * self.per_unit).floor().long()

    def band_radius(self, source: int) -> int:
        """Bins that a band of image `source` (0 or 1) reaches beyond its pixels' centres, seen in the other image.

        Half a line there; but never less than half a pixel of the source, so that a band of neighbouring pixels has
        no gaps where the source image is the coarser one.
        """
        return max(self.half_line[1 - source], self.half_pixel[source])


def choose_bins(pencil: Pencil, samples: tuple[Samples, Samples], line_px: float = 2.0) -> Bins:
    """Bins of half a pixel over the angles of both views' samples; lines are `line_px` pixels thick (paper: 2).

    A line is a wedge of the pencil, so its thickness in pixels varies with the distance to the epipole; `line_px` is
    met on average over the samples of each image. Both samples must hold at least one pixel.
    """
    angles = torch.cat([pencil.angles(side, samples[side].xy) for side in (0, 1)])
    low, high = angles.min().item(), angles.max().item()
    pitches = [pencil.pitch(side, samples[side].xy) for side in (0, 1)]
    per_unit = BINS_PER_PIXEL / max(min(pitches), 1e-12)
    num_bins = int(min(max((high - low) * per_unit, MIN_BINS), MAX_BINS))
    per_unit = num_bins / max(high - low, 1e-12) * (1 - 1e-6)
    half_line = [max(1, min(num_bins, round(line_px / 2 * pitch * per_unit))) for pitch in pitches]
    half_pixel = [max(1, min(num_bins, ceil(pitch / 2 * per_unit))) for pitch in pitches]
    return Bins(low, per_unit, num_bins, (half_line[0], half_line[1]), (half_pixel[0], half_pixel[1]))


def bin_histogram(pencil: Pencil, bins: Bins, side: int, samples: Samples) -> Tensor:
    """(N, B) float32: how many mask pixels of each region lie in each bin of half-planes.

    Pixels whose half-plane lies outside the bins are left out.
    """
    index = bins.index(pencil.angles(side, samples.xy))
    inside = (index >= 0) & (index < bins.num_bins)
    flat = (samples.owner * bins.num_bins + index)[inside]
    counts = torch.bincount(flat, weights=samples.weight[inside], minlength=samples.num_regions * bins.num_bins)
    return counts.reshape(samples.num_regions, bins.num_bins).float()


def dilate(occupied: Tensor, radius: int) -> Tensor:
    """(N, B) bool -> (N, B) float32 of 0 and 1: bins within `radius` bins of an occupied one."""
    total = torch.nn.functional.pad(occupied.float().cumsum(1), (radius + 1, radius), mode="constant")
    num_bins = occupied.shape[1]
    total[:, num_bins + radius + 1 :] = total[:, num_bins + radius, None]
    return (total[:, 2 * radius + 1 :] > total[:, :num_bins]).float()


def epipolar_bands(regions: Regions, cameras: Cameras, view: int, xy: Tensor) -> Tensor:
    """Which pixels of a view lie in the epipolar band of which region (Eq. 2).

    Args:
        regions: D regions; those of `view` itself, and of views at the same place, have no band there.
        cameras: V cameras.
        view: the view that the bands are projected to.
        xy: (P, 2) float32 pixel positions in that view.

    Returns:
        (D, P) bool.
    """
    bands = torch.zeros(len(regions), len(xy), dtype=torch.bool, device=regions.device)
    if not len(xy):
        return bands
    target = Samples(xy, torch.zeros(len(xy), dtype=torch.int64, device=xy.device), torch.ones_like(xy[:, 0]), 1)
    skip = is_coincident(cameras)[view]
    for other, (source, members) in enumerate(zip(*view_samples(regions), strict=True)):
        if skip[other] or not len(members):
            continue
        pencil = epipolar_pencil(cameras, other, view)
        bins = choose_bins(pencil, (source, target))
        occupied = dilate(bin_histogram(pencil, bins, 0, source) > 0, bins.band_radius(0))
        bands[members] = occupied[:, bins.index(pencil.angles(1, xy)).clamp(0, bins.num_bins - 1)] > 0
    return bands


def epipolar_map(regions: Regions, cameras: Cameras, view: int, xy: Tensor) -> Tensor:
    """The epipolar map of one cluster (Eq. 4): the mean of its bands.

    Args:
        regions: the members of the cluster. Members in `view` itself have no band there and do not count.
        cameras: V cameras.
        view: the view that the map belongs to.
        xy: (P, 2) float32 pixel positions in that view.

    Returns:
        (P,) float32 in [0, 1]; zeros when no member lies in another view.
    """
    projectable = ~is_coincident(cameras)[view][regions.view_index]
    return epipolar_bands(regions, cameras, view, xy).sum(0) / projectable.sum().clamp(min=1)
