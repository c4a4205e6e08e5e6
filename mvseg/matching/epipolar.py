"""The epipolar pencil of two cameras (Eqs. 1, 2 and 4), without drawing a line.

Two cameras and their baseline span a pencil of half-planes. A pixel of either image lies in exactly one of them; its
epipolar line in the other image (Eq. 1) is where the same half-plane meets that image. So a region is a histogram over
the half-plane's angle, its epipolar band (Eq. 2) the set of occupied bins, and an epipolar map (Eq. 4) a look-up.

Departure from the paper: half-planes instead of full lines. The half of a line beyond the epipole belongs to points
behind one of the cameras; where both epipoles lie outside the images the two agree.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from math import ceil

import torch
from torch import Tensor

from mvseg.errors import check_arguments
from mvseg.matching.numbers import EPIPOLAR
from mvseg.matching.pencil import Pencil, epipolar_pencil, epipolar_pencils, is_coincident
from mvseg.matching.samples import Samples, view_samples
from mvseg.regions import Regions
from mvseg.scene import Cameras
from mvseg.system.running import progress_bar


@dataclass(frozen=True, eq=False)
class Bins:
    """A common binning of the angles of two images.

    Attributes:
        low: smallest angle.
        per_unit: bins per unit of angle.
        half_line: half the thickness of a line in image i and in image j, in bins.
        half_pixel: half a pixel in image i and in image j, in bins, rounded up.
    """

    low: float
    per_unit: float
    num_bins: int
    half_line: Sequence[int]
    half_pixel: Sequence[int]

    def index(self, angles: Tensor) -> Tensor:
        """(P,) int32 bin of each angle; -1 below the first bin and B above the last."""
        return torch.sub(angles, self.low).mul_(self.per_unit).floor_().clamp_(-1, self.num_bins).int()

    def band_radius(self, source: int) -> int:
        """Bins by which a band of image `source` (0 or 1) extends beyond its pixels' centres: half a line in the other
        image, but at least half a pixel of the source, lest neighbouring lines of a coarser source leave gaps."""
        return max(self.half_line[1 - source], self.half_pixel[source])


@dataclass(frozen=True, eq=False)
class Spans:
    """The half-planes of S samples of N regions of one view.

    Attributes:
        low, high: (S,) the smallest and the largest angle of each; the same tensor for pixels.
        owner: (S,) int64 in [0, N).
        weight: (S,) float32, number of mask pixels.
        num_pixels: sum of the weights.
    """

    low: Tensor
    high: Tensor
    owner: Tensor
    weight: Tensor
    num_pixels: float
    num_regions: int


def find_spans(pencil: Pencil, side: int, samples: Samples) -> Spans:
    """The half-planes of samples of camera i (side 0) or j (side 1) of a pencil. Runs along which the angle may not
    change evenly become pixels."""
    low = high = pencil.angles(side, samples.ends_xy)
    owner, weight = samples.owner, samples.weight
    if samples.last_xy is not None:
        first, last = low.split(len(owner))
        low, high = torch.minimum(first, last), torch.maximum(first, last)
        width = high - low
        if float(width.max() if len(width) else 0) > EPIPOLAR.wide:
            is_wide = width > EPIPOLAR.wide
            pixels = samples.pixels(is_wide)
            angles = pencil.angles(side, pixels.xy)
            low, high = (torch.cat((ends[~is_wide], angles)) for ends in (low, high))
            owner = torch.cat((owner[~is_wide], pixels.owner))
            weight = torch.cat((weight[~is_wide], pixels.weight))
    return Spans(low, high, owner, weight, samples.num_pixels, samples.num_regions)


def choose_bins(pitches: Sequence[float], angles: Sequence[Tensor]) -> Bins:
    """Bins of half a pixel over the angles of both views' pixels; lines are two pixels thick, as in the paper.

    A line is a wedge of the pencil, so its thickness varies with the distance to the epipole; it is two pixels on
    average over the pixels of each image. `pitches` are `Pencil.pitch` of views i and j; `angles` hold at least the
    smallest and the largest angle of the pixels of each. Both views need at least one pixel.
    """
    ends = torch.stack([torch.stack(torch.aminmax(part)) for part in angles]).tolist()
    low, high = min(end[0] for end in ends), max(end[1] for end in ends)
    per_unit = EPIPOLAR.bins_per_pixel / max(min(pitches), 1e-12)
    num_bins = int(min(max((high - low) * per_unit, EPIPOLAR.min_bins), EPIPOLAR.max_bins))
    per_unit = num_bins / max(high - low, 1e-12) * (1 - 1e-6)
    line = [max(1, min(num_bins, round(EPIPOLAR.line_px / 2 * pitch * per_unit))) for pitch in pitches]
    pixel = [max(1, min(num_bins, ceil(pitch / 2 * per_unit))) for pitch in pitches]
    return Bins(low=low, per_unit=per_unit, num_bins=num_bins, half_line=line, half_pixel=pixel)


def span_histogram(bins: Bins, spans: Spans) -> Tensor:
    """(N, B) float32: how many mask pixels of each region lie in each bin; those of a run are spread evenly over the
    bins between its ends. Whole numbers count shares of pixels, so that empty bins are exactly 0."""
    if spans.high is spans.low:
        padded = bins.num_bins + 2  # an extra bin at either end collects what lies outside
        # int32: half the memory traffic
        flat = torch.add(spans.owner.int() * padded, bins.index(spans.low)).add_(1).long()
        counts = spans.weight.new_zeros(spans.num_regions * padded).scatter_add_(0, flat, spans.weight)
        return counts.reshape(spans.num_regions, padded)[:, 1:-1]
    low, high = bins.index(spans.low), bins.index(spans.high)
    # int32: half the memory traffic, as long as all pixels of a region may lie in one bin
    kind = torch.int32 if EPIPOLAR.share * spans.num_pixels < 2**31 else torch.int64
    share = torch.div(EPIPOLAR.share * spans.weight, high - low + 1).round_().to(kind)
    padded = bins.num_bins + 3  # a bin at either end collects what lies outside; one more where the last runs end
    start = spans.owner * padded + low + 1
    changes = share.new_zeros(spans.num_regions * padded)
    changes.index_add_(0, start, share).index_add_(0, start + (high - low + 1), share.neg())
    counts = changes.reshape(spans.num_regions, padded).cumsum(1, dtype=kind)
    return counts[:, 1:-2].float().mul_(1 / EPIPOLAR.share)


@dataclass(frozen=True, eq=False)
class BinnedPair:
    """Two views with a baseline, and their regions as histograms over the half-planes of their pencil.

    Attributes:
        bins: common to both.
        pixels: (N, B) and (M, B) float32, pixels of each region of i and of j in each bin.
        lines: (N, B) and (M, B) float32, lines that the same regions send out in each bin.
    """

    i: int
    j: int
    pencil: Pencil
    bins: Bins
    pixels: tuple[Tensor, Tensor]
    lines: tuple[Tensor, Tensor]


def binned_pairs(
    samples: Sequence[Samples], cameras: Cameras, *, senders: Sequence[Samples] | None = None
) -> Iterator[BinnedPair]:
    """All pairs of views i < j that both have pixels, with a baseline between them. `samples` and `senders`, the pixels
    that send out lines (None: all), have an entry per view."""
    skip = is_coincident(cameras).tolist()
    occupied = [view for view, sample in enumerate(samples) if len(sample.xy)]
    pairs = [(i, j) for i in occupied for j in occupied if i < j and not skip[i][j]]
    pencils = epipolar_pencils(cameras, pairs)
    thinned = {view: _thin(samples[view]) for view in occupied}
    every_pair = zip(pairs, pencils, strict=True)
    for (i, j), pencil in progress_bar(every_pair, "comparing outlines", len(pairs), unit="pair"):
        spans = find_spans(pencil, 0, samples[i]), find_spans(pencil, 1, samples[j])
        pitches = pencil.pitch(0, thinned[i]), pencil.pitch(1, thinned[j])
        bins = choose_bins(pitches, [torch.stack((part.low.min(), part.high.max())) for part in spans])
        lines = pixels = span_histogram(bins, spans[0]), span_histogram(bins, spans[1])
        if senders is not None:
            sent = find_spans(pencil, 0, senders[i]), find_spans(pencil, 1, senders[j])
            lines = span_histogram(bins, sent[0]), span_histogram(bins, sent[1])
        yield BinnedPair(i=i, j=j, pencil=pencil, bins=bins, pixels=pixels, lines=lines)


def _thin(samples: Samples) -> Tensor:
    step = int((samples.num_pixels / EPIPOLAR.pitch_pixels) ** 0.5)
    if step < 2:
        return samples.pixels().xy
    xy = samples.pixels(samples.xy[:, 1].int() % step == 0).xy
    on_lattice = xy[:, 0].int() % step == 0
    return xy[on_lattice] if on_lattice.any() else samples.pixels().xy


def dilate(counts: Tensor, radius: int) -> Tensor:
    """(N, B) counts or bool -> (N, B) float32 of 0 and 1: bins within `radius` bins of one that is not 0."""
    occupied = (counts if counts.is_floating_point() else counts.float()).sign()
    return torch.nn.functional.max_pool1d(occupied[:, None], 2 * radius + 1, stride=1, padding=radius)[:, 0]


def epipolar_bands(regions: Regions, cameras: Cameras, *, view: int, xy: Tensor) -> Tensor:
    """Test which pixels `xy` (P, 2) float32 of a view lie in the epipolar band of which of D regions (Eq. 2): (D, P)
    bool. Regions of `view` itself, and of views that share its camera centre, have no band there."""
    bands = torch.zeros(len(regions), len(xy), dtype=torch.bool, device=regions.device)
    cameras = cameras.to(regions.device)
    skip = is_coincident(cameras)[view]
    for other, (source, members) in enumerate(zip(*view_samples(regions), strict=True)):
        if skip[other] or not len(members) or not len(xy):
            continue
        pencil = epipolar_pencil(cameras, other, view)
        spans, angles = find_spans(pencil, 0, source), pencil.angles(1, xy)
        bins = choose_bins((pencil.pitch(0, source.xy), pencil.pitch(1, xy)), (spans.low, angles))
        occupied = dilate(span_histogram(bins, spans), bins.band_radius(0))
        bands[members] = occupied[:, bins.index(angles).clamp(0, bins.num_bins - 1)] > 0
    return bands


@check_arguments
def epipolar_map(regions: Regions, cameras: Cameras, *, view: int, xy: Tensor) -> Tensor:
    """The epipolar map of one cluster (Eq. 4): the mean of its bands.

    Args:
        regions: the members of the cluster. Members in `view` itself have no band there and do not count.
        xy: (P, 2) float32 pixel positions in the view that the map belongs to.

    Returns:
        (P,) float32 in [0, 1]; zeros when no member lies in another view.
    """
    projectable = ~is_coincident(cameras.to(regions.device))[view][regions.view_index]
    return epipolar_bands(regions, cameras, view=view, xy=xy).sum(0) / projectable.sum().clamp(min=1)
