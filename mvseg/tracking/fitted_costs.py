"""How unlike two leaves of different dates are, by scales of greatest likelihood: for finding how dates stand to each
other, and for linking the leaves of small plants.

The cost of a pair is minus the logarithm of how much likelier its differences are between two sights of one leaf than
between a leaf and a stranger. Each difference has a scale of its own, widened by the standard deviations that the
surfaces carry, and heavy tails: one odd number does not outweigh the others. A stranger is the nearer by chance, the
more leaves there are.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from mvseg.tracking.dates import Floats
from mvseg.tracking.leaves import Pair

TAIL = 3.0  # degrees of freedom of Student's t, which differences follow
FLIPPED = 0.5  # a midrib that runs the other way on the other date: it costs this much more


@dataclass(frozen=True)
class Scales:
    """Of the differences between two sights of one leaf: of places in `Pair.scale`, of angles in radians, of lengths as
    natural logarithms.

    Attributes:
        across: of the base, away from the stem.
        along, stretch: of the base up the stem, and more of it per height above the foot, for internodes stretch.
        turn: of the direction from base to tip.
        growth: log length that is expected per day and room to grow, see `length_costs`.
        size, spurt: of the log length, and more of it per growth that is expected.
        loose: of the log length of leaves that only voxels show.
        lines, near: weight and scale of the distances between midribs, see `_line_costs`; 0: they do not count.
        parting: log of how much rarer a stranger's differences are at the peak, on a plant of one leaf.
    """

    across: float
    along: float
    stretch: float
    turn: float
    growth: float
    size: float
    spurt: float
    loose: float
    lines: float
    near: float
    parting: float


# `python benchmarks/fit_costs.py` fits both, on seedlings and on simulated plants, in true poses. Poses are found by
# bases and directions: midribs lie near each other in poses that are exact only.
POSES = Scales(across=0.223, along=0.028, stretch=0.226, turn=0.288, growth=0.239, size=0.182, spurt=0.284, loose=0.298,
               lines=0.0, near=1.0, parting=8.212)  # fmt: skip
LINKS = Scales(across=0.640, along=0.044, stretch=0.742, turn=0.420, growth=0.300, size=0.183, spurt=0.184, loose=0.285,
               lines=0.277, near=0.006, parting=13.653)  # fmt: skip


def fitted_costs(pair: Pair, scales: Scales = POSES) -> Floats:
    """(N, M) costs of leaf i of the earlier and leaf j of the later date, in one frame, being the same; below 0: it is
    likelier than not. What a person says of them counts, too."""
    turned = replace(pair, first=replace(pair.first, midribs=pair.first.midribs[:, ::-1]))
    costs = np.minimum(_base_costs(pair, scales), _base_costs(turned, scales) + FLIPPED) + length_costs(pair, scales)
    if scales.lines:
        costs += scales.lines * _line_costs(pair, scales)
    return costs + np.log(max(len(pair.first), len(pair.second), 1)) - scales.parting + pair.said


def _base_costs(pair: Pair, scales: Scales) -> Floats:
    """Of bases and directions, midribs running as they do.

    The foot of the plant counts as the origin where that is below the lowest base by one `Pair.scale` at most; a base
    is as high above it as the internodes below are long.
    """
    first, second, scale = pair.first, pair.second, pair.scale
    apart = (second.bases[None] - first.bases[:, None]) / scale
    lowest = first.bases[:, 2].min(initial=np.inf)
    height = (first.bases[:, 2] - lowest + np.clip(lowest, 0, scale)) / scale
    noise = np.hypot(first.base_sd[:, None], second.base_sd[None]) / scale
    across = np.linalg.norm(apart[..., :2], axis=-1) / np.hypot(scales.across, noise)
    along = apart[..., 2] / np.hypot(scales.along + scales.stretch * height[:, None], noise)
    turn_noise = np.hypot(first.turn_sd[:, None], second.turn_sd[None])
    turn = np.arccos(np.clip(first.chords @ second.chords.T, -1, 1)) / np.hypot(scales.turn, turn_noise)
    return 0.5 * (student_tail(across, 2) + student_tail(along, 1) + student_tail(turn, 2))


def length_costs(pair: Pair, scales: Scales) -> Floats:
    """Of lengths: a leaf has room to grow until it is as long as the longest one of the later date, and grows the
    faster the more it has, up to a factor of e."""
    first, second = pair.first, pair.second
    room = np.maximum(np.log(second.lengths.max(initial=1e-9) / first.lengths), 0)
    growth = np.minimum(scales.growth * pair.days * np.minimum(room, 1.0), room)[:, None]
    loose = np.where(first.is_surface[:, None] & second.is_surface[None], 0.0, scales.loose)
    wide = np.sqrt(scales.size**2 + loose**2 + (scales.spurt * growth) ** 2)
    return 0.5 * student_tail((np.log(second.lengths[None] / first.lengths[:, None]) - growth) / wide, 1)


def _line_costs(pair: Pair, scales: Scales) -> Floats:
    """Of the distances between midribs, whichever way they run. A leaf that is seen in part lies on the whole one,
    which reaches farther: the nearer way, from the one to the other or back, counts three times as much."""
    apart = np.linalg.norm(pair.first.midribs[:, None, :, None] - pair.second.midribs[None, :, None], axis=-1)
    ways = apart.min(3).mean(2), apart.min(2).mean(2)
    wide = scales.near * pair.scale
    return 0.5 * (student_tail(np.minimum(*ways) / wide, 2) + student_tail(np.maximum(*ways) / (3 * wide), 1))


def student_tail(x: Floats, dimensions: int) -> Floats:
    """Minus twice the log of Student's density in units of its peak."""
    return (TAIL + dimensions) * np.log1p(np.square(x) / TAIL)
