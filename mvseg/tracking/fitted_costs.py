"""How unlike two leaves of different dates are, by scales of greatest likelihood: for finding how dates stand to each
other (`fitted_costs`), and for linking leaves, once the earlier plant is bent as the pairs say (`bent_costs`).

The cost of a pair is minus the logarithm of how much likelier its differences are between two observations of one leaf
than between a leaf and a stranger. Each difference has its own scale, widened by the surfaces' standard deviations, and
heavy tails: one odd number does not outweigh the others. With more leaves, a wrong leaf is more likely to lie nearby.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.distance import cdist

from mvseg.arrays import Floats
from mvseg.tracking.leaves import DateLeaves, Pair
from mvseg.tracking.numbers import COSTS, OBSERVATIONS


@dataclass(frozen=True)
class Scales:
    """Scales of differences between two observations of one leaf: of places in `Pair.scale`, of angles in radians, of
    lengths as natural logarithms.

    Attributes:
        across: of the base, away from the stem.
        along, stretch: of the base up the stem, and more of it per height above the foot, for internodes stretch.
        turn: of the direction from base to tip.
        growth: log size that is expected per day and room to grow, see `size_costs`.
        grown: how much likelier it is than growing at the peak that a leaf has stopped.
        size, spurt: of the log size, and more of it per growth that is expected of a leaf that grows.
        loose: of the log size of leaves that only voxels show.
        cloud, near: weight and scale of the distance between surfaces, see `_cloud_distances`; 0: it does not count.
        parting: log of how much rarer a stranger's differences are at the peak, on a plant of one leaf.
    """

    across: float
    along: float
    stretch: float
    turn: float
    growth: float
    grown: float
    size: float
    spurt: float
    loose: float
    cloud: float
    near: float
    parting: float


# fitted: python -m benchmarks.fit_costs, on seedlings, a maize, a basil and simulated plants in true poses; `cloud` and
# `near` with --places-too. `grown` of links, fitted to 0.17, was chosen; why other scales stay as an earlier fit had
# them stands in docs/notes/tracking.md. Poses are found by bases and directions: surfaces lie on each other in exact
# poses only.
POSES = Scales(across=0.223, along=0.028, stretch=0.226, turn=0.288, growth=0.262, grown=0.503, size=0.104,
               spurt=0.296, loose=0.301, cloud=0.0, near=1.0, parting=7.969)  # fmt: skip
LINKS = Scales(across=0.640, along=0.044, stretch=0.742, turn=0.420, growth=0.325, grown=0.1, size=0.112,
               spurt=0.258, loose=0.270, cloud=0.684, near=0.023, parting=13.222)  # fmt: skip


@dataclass(frozen=True, eq=False)
class Differences:
    """Between N leaves of an earlier and M leaves of a later date, in one frame: each (N, M), or (2, N, M) with the
    midribs of the earlier ones as they run, then turned round. Places are in `Pair.scale`, sizes are logarithms.

    Attributes:
        across, along, away: of bases, from the stem, up, and in all: (2, N, M).
        height: (2, N, M) of the earlier base over the foot of the plant. The foot counts as the origin where that is
            below the lowest base by one `Pair.scale` at most.
        turn: (2, N, M) between the directions from base to tip, radians.
        longer, wider: of lengths, and of roots of areas, NaN where there are none.
        room: from the length of the earlier leaf to that of the longest one of the later date, >= 0.
        is_loose: only voxels show one of them.
        crowd: logarithm of the number of leaves.
        near: distances between surfaces, see `_cloud_distances`; None where nobody asked for them.
        width: factor of the scales of places, in which `near` is measured, too.
    """

    across: Floats
    along: Floats
    away: Floats
    height: Floats
    turn: Floats
    base_sd: Floats
    turn_sd: Floats
    longer: Floats
    wider: Floats
    room: Floats
    days: Floats
    is_loose: np.ndarray
    crowd: Floats
    knows_up: np.ndarray
    near: Floats | None
    width: Floats

    @classmethod
    def of(cls, pair: Pair, widths: Floats | None = None, *, cloud: bool = False) -> Differences:
        """`widths` (N,) of the earlier leaves, 1 without; `cloud`: with distances between surfaces."""
        first, second, scale = pair.first, pair.second, pair.scale
        ends = first.midribs[:, [0, -1]].swapaxes(0, 1)  # (2, N, 3)
        apart = (second.bases - ends[:, :, None]) / scale
        lowest = ends[:, :, 2].min(1, initial=np.inf, keepdims=True)
        chords = np.stack([first.chords, -first.chords])
        full = np.ones((len(first), len(second)))
        room = np.maximum(np.log(second.lengths.max(initial=1e-9) / first.lengths), 0)
        return cls(
            across=np.linalg.norm(apart[..., :2], axis=-1), along=apart[..., 2], away=np.linalg.norm(apart, axis=-1),
            height=((ends[:, :, 2] - lowest + np.clip(lowest, 0, scale)) / scale)[..., None] * full,
            turn=np.arccos(np.clip(chords @ second.chords.T, -1, 1)),
            base_sd=np.hypot(first.base_sd[:, None], second.base_sd[None]) / scale,
            turn_sd=np.hypot(first.turn_sd[:, None], second.turn_sd[None]),
            longer=np.log(second.lengths[None] / first.lengths[:, None]),
            wider=0.5 * np.log(second.areas[None] / first.areas[:, None]),
            room=room[:, None] * full, days=pair.days * full,
            is_loose=~(first.is_surface[:, None] & second.is_surface[None]),
            crowd=np.log(max(*full.shape, 1)) * full, knows_up=np.full(full.shape, pair.knows_up),
            near=_cloud_distances(pair) if cloud else None, width=full if widths is None else widths[:, None] * full,
        )  # fmt: skip


def fitted_costs(pair: Pair, scales: Scales = POSES, widths: Floats | None = None) -> Floats:
    """(N, M) costs of leaf i of the earlier and leaf j of the later date, in one frame, being the same; below 0: it is
    likelier than not. The user's links count, too. `widths`: see `Differences`."""
    return costs_of(Differences.of(pair, widths, cloud=scales.cloud > 0), scales) + pair.link_costs


def bent_costs(pair: Pair, pairs: np.ndarray) -> Floats:
    """(N, M) costs of links between dates in one frame, the earlier one bent as `pairs` (P, 2) of its leaves say; below
    0 leaves are likelier one than not."""
    bent, widths = bend(pair, pairs)
    return fitted_costs(replace(pair, first=bent), LINKS, widths)


def bend(pair: Pair, pairs: np.ndarray) -> tuple[DateLeaves, Floats]:
    """The leaves of the earlier date where the later one should show them, and (N,) factors of the scales of places.

    A plant leans, and its internodes stretch: each leaf moves as those around it did, and the better these agree, the
    more places tell. Both are regressions with a prior worth some pairs, so that only many pairs move the costs much.

    The shift of a base is linear in its place: a ridge regression over the pairs, `COSTS.prior_pairs` strong, of which
    each leaf is predicted without its own pair. Factors grow with the variance of that prediction, and with the median
    error of all, which weighs against `COSTS.usual` as the pairs do against the prior. Without pairs nothing bends.
    """
    first, prior, (rows, columns) = pair.first, COSTS.prior_pairs, pairs.T
    if not len(rows):
        return first, np.ones(len(first))
    away = (pair.second.bases[columns] - first.bases[rows]) / pair.scale
    places = np.column_stack([np.ones(len(first)), (first.bases - first.bases[rows].mean(0)) / pair.scale])
    terms = places[rows]
    weights = 1 / (1 + np.square(np.linalg.norm(away - np.median(away, 0), axis=1) / COSTS.usual))
    inverse = np.linalg.inv((terms.T * weights) @ terms + prior * np.eye(4))
    shifts = places @ (inverse @ (terms.T * weights) @ away)
    variances = np.einsum("ni,ij,nj->n", places, inverse, places)
    others = 1 - weights * variances[rows]  # > 0, as the prior counts, too
    errors = (away - shifts[rows]) / others[:, None]
    shifts[rows], variances[rows] = away - errors, variances[rows] / others
    median = float(np.median(np.linalg.norm(errors[:, :2], axis=1))) / COSTS.usual
    spread = (prior + len(rows) * median**2) / (prior + len(rows))
    moved = shifts[:, None] * pair.scale
    return replace(first, midribs=first.midribs + moved, points=first.points + moved), np.sqrt(spread * (1 + variances))


def costs_of(apart: Differences, scales: Scales) -> Floats:
    """(N, M) costs, see `fitted_costs`."""
    as_it_runs, turned = _place_costs(apart, scales)
    costs = np.minimum(as_it_runs, turned + COSTS.flipped) + size_costs(apart, scales) + apart.crowd - scales.parting
    if apart.near is not None:
        costs += scales.cloud * 0.5 * student_tail(apart.near / (scales.near * apart.width), 2)
    return np.asarray(costs)


def _place_costs(apart: Differences, scales: Scales) -> Floats:
    """(2, N, M) of bases and directions; higher bases move up more; where up is not known, as far in any direction."""
    across = student_tail(apart.across / np.hypot(scales.across * apart.width, apart.base_sd), 2)
    up = (scales.along + scales.stretch * apart.height) * apart.width
    along = student_tail(apart.along / np.hypot(up, apart.base_sd), 1)
    away = student_tail(apart.away / np.hypot(scales.across * apart.width, apart.base_sd), 3)
    turn = student_tail(apart.turn / np.hypot(scales.turn, apart.turn_sd), 2)
    return np.asarray(0.5 * (np.where(apart.knows_up, across + along, away) + turn))


def size_costs(apart: Differences, scales: Scales) -> Floats:
    """(N, M) of sizes alone, which hardly change once a leaf has stopped growing.

    A size is the root of an area, or a length where one of the two leaves has no area. A leaf that grows has room to
    until it is as long as the longest one of the later date, and grows the faster the more it has, up to a factor of e.
    Nobody knows which leaves grow: either may be so.
    """
    larger = np.where(np.isfinite(apart.wider), apart.wider, apart.longer)
    growth = np.minimum(scales.growth * apart.days * np.minimum(apart.room, 1.0), apart.room)
    loose = np.where(apart.is_loose, scales.loose, 0.0)
    young = np.sqrt(scales.size**2 + loose**2 + (scales.spurt * growth) ** 2)
    stays = np.log(scales.grown) - 0.5 * student_tail(larger / np.hypot(scales.size, loose), 1)
    grows = -0.5 * student_tail((apart.longer - growth) / young, 1)
    return np.asarray(-np.logaddexp(stays, grows))


def _cloud_distances(pair: Pair) -> Floats:
    """(N, M) mean distance of the points of one leaf from the other, the nearer way of two: for leaves seen in part."""
    shape = (len(pair.first), OBSERVATIONS.cloud, len(pair.second), OBSERVATIONS.cloud)
    apart = cdist(pair.first.points.reshape(-1, 3), pair.second.points.reshape(-1, 3)).reshape(shape)
    return np.minimum(apart.min(3).mean(1), apart.min(1).mean(2)) / pair.scale


def student_tail(x: Floats, dimensions: int) -> Floats:
    """Minus twice the log of Student's density in units of its peak."""
    return (COSTS.tail + dimensions) * np.log1p(np.square(x) / COSTS.tail)
