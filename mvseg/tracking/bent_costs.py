"""How unlike two leaves of different dates are, once their plants are aligned and the one is bent as the other: for
linking the leaves of plants with many.

As `fitted_costs`, with two differences: leaves around one say how far it was moved, so that places tell more; and where
a surface shows half of a leaf, where its points are counts. Lengths cost what they cost there.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from mvseg.system.running import kept
from mvseg.tracking.align import Alignment
from mvseg.tracking.dates import Floats
from mvseg.tracking.fitted_costs import LINKS, POSES, size_costs, student_tail
from mvseg.tracking.leaves import Leaves, Pair
from mvseg.tracking.numbers import BENT, SIGHTS


@kept
def bent_costs(pair: Pair, alignment: Alignment) -> Floats:
    """Costs after the plant was let bend and stretch: each leaf moves as the other pairs say, not as its own does."""
    first, second, scale, pairs = pair.first, pair.second, pair.scale, alignment.pairs
    moved = first.moved(alignment.pose)
    one, other = moved.bases[pairs[:, 0]], second.bases[pairs[:, 1]]
    middle = one.mean(0)
    terms = np.column_stack([np.ones(len(one)), (one - middle) / scale])
    away = other - one
    weight = 1 / (1 + np.square(np.linalg.norm(away - np.median(away, 0), axis=1) / (3 * BENT.place * scale)))
    ridge = BENT.like_rigid * np.diag([1.0, 1.0, 1.0, 1.0])
    inverse = np.linalg.inv(terms.T @ (terms * weight[:, None]) + ridge)
    factors = inverse @ (terms * weight[:, None]).T @ away
    everywhere = np.column_stack([np.ones(len(moved)), (moved.bases - middle) / scale]) @ factors
    leverage = np.einsum("pi,ij,pj->p", terms, inverse, terms) * weight
    fitted = terms @ factors
    everywhere[pairs[:, 0]] = away - (away - fitted) / np.maximum(1 - leverage, 0.1)[:, None]  # without its own pair
    bent = moved.shifted(everywhere)
    rest = np.linalg.norm((other - bent.bases[pairs[:, 0]])[:, :2], axis=1) / (1.18 * BENT.place * scale)
    widening = float(np.clip(np.median(rest), 0.7, 2.0))
    in_place = replace(pair, first=bent)
    costs, clouds = pair_costs(in_place, widening=widening), cloud_costs(in_place, widening=widening)
    both = first.is_surface[:, None] & second.is_surface[None]
    by_midrib = costs + BENT.cloud_counts * np.minimum(clouds, 0.0)
    by_cloud = clouds + BENT.cloud_counts * np.minimum(costs, BENT.parting)
    in_part = np.abs(np.log(second.lengths[None] / first.lengths[:, None])) > BENT.in_part
    return np.where(both, np.where(in_part, np.minimum(by_midrib, by_cloud), by_midrib), by_cloud)


def pair_costs(pair: Pair, *, widening: float = 1.0) -> Floats:
    """(N, M) costs of leaf i of the earlier and leaf j of the later date, in one frame, being the same; below 0: it is
    likelier than not. `widening` widens the scales of places and directions, for dates that differ more than usual."""
    turned = replace(pair, first=replace(pair.first, midribs=pair.first.midribs[:, ::-1]))
    directed = np.minimum(_directed_costs(pair, widening), _directed_costs(turned, widening) + BENT.flipped)
    return directed + size_costs(pair, LINKS)


def cloud_costs(pair: Pair, *, widening: float = 1.0) -> Floats:
    """(N, M) costs as `pair_costs`, from where the leaves are alone: how far the points of one are from the other.

    It needs neither base nor tip, and forgives a leaf that is seen in part: the nearer way counts.
    """
    apart = np.linalg.norm(pair.first.points[:, None, :, None] - pair.second.points[None, :, None], axis=-1)
    ways = apart.min(3).mean(2), apart.min(2).mean(2)
    near, far = np.minimum(*ways) / pair.scale, np.maximum(*ways) / pair.scale
    wide = BENT.place * widening + BENT.rise * pair.days
    return 0.5 * (student_tail(near / wide, 2) + student_tail(far / (3 * wide), 1)) - BENT.apart


def _directed_costs(pair: Pair, widening: float) -> Floats:
    first, second, scale = pair.first, pair.second, pair.scale
    apart = (second.bases[None] - first.bases[:, None]) / scale
    noise = np.hypot(first.base_sd[:, None], second.base_sd[None]) / scale
    across = np.linalg.norm(apart[..., :2], axis=-1) / np.hypot(BENT.place * widening, noise)
    along = apart[..., 2] / np.hypot(BENT.place * widening + BENT.rise * pair.days, noise)
    turn_noise = np.hypot(first.turn_sd[:, None], second.turn_sd[None])
    turn = np.arccos(np.clip(first.chords @ second.chords.T, -1, 1)) / np.hypot(POSES.turn * widening, turn_noise)
    bend = _bends(first, second) / BENT.bend
    return 0.5 * (
        student_tail(across, 2) + student_tail(along, 1) + student_tail(turn, 2) + student_tail(bend, 2)
    ) - BENT.parting  # fmt: skip


def _bends(first: Leaves, second: Leaves) -> Floats:
    """(N, M) root mean square distance between the midribs in units of their length, base on base."""
    one = (first.midribs - first.midribs[:, :1]) / first.lengths[:, None, None]
    other = (second.midribs - second.midribs[:, :1]) / second.lengths[:, None, None]
    away: Floats = np.linalg.norm(one[:, None] - other[None], axis=-1)
    tips = np.linalg.norm(one[:, None, -1] - other[None, :, -1], axis=-1)
    chord = tips[..., None] * np.linspace(0, 1, SIGHTS.stations)
    return np.sqrt(np.mean((away - 0.5 * chord) ** 2, axis=-1))  # half of the turn is counted as a turn already
