"""Tracks over all dates at once: the cheapest way to give every leaf one track, with births, deaths and gaps.

Every leaf has at most one next sight and at most one earlier one, and a link costs what `pair_costs` says. The cheapest
set of paths through such a graph is an assignment of leaves to their next sights (a minimum-cost flow of unit
capacities), which `scipy.optimize.linear_sum_assignment` solves exactly.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from scipy.optimize import linear_sum_assignment

from mvseg.errors import InputError
from mvseg.tracking.align import Alignment, align
from mvseg.tracking.costs import ACROSS, Leaves, cloud_costs, pair_costs, typical_length
from mvseg.tracking.dates import Floats

Sight = tuple[int, int]  # index of the date, row of its `Leaves`
MOST_GAP = 3  # dates from one sight to the next, at most: two dates may hide a leaf
# Of a date that hides a leaf, and of each further one. If it were less, a leaf that looks odd on every other date would
# become two tracks.
GAP_COST, MORE_GAP = 9.0, 0.5
UNLINKED = 4.0  # a link may cost that much before two tracks are cheaper than one
CLOUD_COUNTS = 0.3  # of the points of two surfaces, whose midribs say most already, and the other way round
MOST_HELP = 8.0
IN_PART = 0.3  # change of log length from which one of two surfaces may show a part of the leaf only
ENTITLED = -1e4  # cost of a link that a person asks for
CALIBRATION = (0.8, 1.6)  # slope and offset of the log odds of a link, fitted on simulated series (docs/tracking.md)
LIKE_RIGID = 0.3  # weight of "the plant moved as a whole", in leaves


@dataclass(frozen=True, eq=False)
class DatePair:
    """Two dates: how they are aligned, and the (N, M) costs of their leaves being the same."""

    alignment: Alignment
    costs: Floats


@dataclass(frozen=True)
class Link:
    """Two sights of one leaf, the earlier one first, and the probability that they are."""

    before: Sight
    after: Sight
    probability: float


def compare_dates(
    dates: Sequence[Leaves], times: Sequence[float], *, knows_up: bool
) -> dict[tuple[int, int], DatePair]:
    """{(earlier, later): pair} of all dates at most MOST_GAP apart, each aligned; those in between help."""
    compared: dict[tuple[int, int], DatePair] = {}
    for gap in range(1, min(MOST_GAP, len(dates) - 1) + 1):
        for earlier in range(len(dates) - gap):
            later = earlier + gap
            first, second, days = dates[earlier], dates[later], times[later] - times[earlier]
            guess = _chain(compared, earlier, later)
            alignment = align(first, second, days=days, knows_up=knows_up, guess=guess)
            costs = np.full((len(first), len(second)), np.inf)
            if alignment.is_sure:
                costs = _bent_costs(first, second, alignment, days=days)
            compared[earlier, later] = DatePair(alignment, costs)
    return compared


def gap_cost(dates: int) -> float:
    """What a link over that many dates costs more than one to the next date."""
    return GAP_COST + MORE_GAP * (dates - 2) if dates > 1 else 0.0


def _chain(compared: Mapping[tuple[int, int], DatePair], earlier: int, later: int) -> Alignment | None:
    """The alignment by way of the date in between; None where that is not sure."""
    middle = later - 1
    if middle == earlier or not (
        compared[earlier, middle].alignment.is_sure and compared[middle, later].alignment.is_sure
    ):
        return None
    one, other = compared[earlier, middle].alignment, compared[middle, later].alignment
    return replace(one, rotation=other.rotation @ one.rotation, shift=other.rotation @ one.shift + other.shift)


def _bent_costs(first: Leaves, second: Leaves, alignment: Alignment, *, days: float) -> Floats:
    """Costs after the plant was let bend and stretch: each leaf moves as the other pairs say, not as its own does."""
    scale = typical_length(first, second)
    moved = first.moved(alignment.rotation, alignment.shift)
    pairs = alignment.pairs
    one, other = moved.bases[pairs[:, 0]], second.bases[pairs[:, 1]]
    middle = one.mean(0)
    terms = np.column_stack([np.ones(len(one)), (one - middle) / scale])
    away = other - one
    weight = 1 / (1 + np.square(np.linalg.norm(away - np.median(away, 0), axis=1) / (3 * ACROSS * scale)))
    ridge = LIKE_RIGID * np.diag([1.0, 1.0, 1.0, 1.0])
    inverse = np.linalg.inv(terms.T @ (terms * weight[:, None]) + ridge)
    factors = inverse @ (terms * weight[:, None]).T @ away
    everywhere = np.column_stack([np.ones(len(moved)), (moved.bases - middle) / scale]) @ factors
    leverage = np.einsum("pi,ij,pj->p", terms, inverse, terms) * weight
    fitted = terms @ factors
    everywhere[pairs[:, 0]] = away - (away - fitted) / np.maximum(1 - leverage, 0.1)[:, None]  # without its own pair
    bent = moved.shifted(everywhere)
    rest = np.linalg.norm((other - bent.bases[pairs[:, 0]])[:, :2], axis=1) / (1.18 * ACROSS * scale)
    spread = float(np.clip(np.median(rest), 0.7, 2.0))
    costs = pair_costs(bent, second, days=days, scale=scale, spread=spread)
    clouds = cloud_costs(bent, second, days=days, scale=scale, spread=spread)
    both = first.is_surface[:, None] & second.is_surface[None]
    by_midrib = costs + CLOUD_COUNTS * np.minimum(clouds, 0.0)
    by_cloud = clouds + CLOUD_COUNTS * np.clip(costs, -MOST_HELP, MOST_HELP)
    in_part = np.abs(np.log(second.lengths[None] / first.lengths[:, None])) > IN_PART
    return np.where(both, np.where(in_part, np.minimum(by_midrib, by_cloud), by_midrib), by_cloud)


def link_leaves(
    counts: Sequence[int],
    compared: Mapping[tuple[int, int], DatePair],
    *,
    same: Collection[tuple[Sight, Sight]] = (),
    different: Collection[tuple[Sight, Sight]] = (),
) -> list[Link]:
    """The links of the cheapest tracks.

    Args:
        counts: number of leaves with a shape on each date.
        compared: see `compare_dates`.
        same, different: pairs of sights that a person says are one leaf, or are not.
    """
    starts = np.concatenate([[0], np.cumsum(counts)]).astype(int)
    total = int(starts[-1])
    if total == 0:
        return []
    costs = np.full((total, total), np.inf)
    for (earlier, later), pair in compared.items():
        block = pair.costs + gap_cost(later - earlier)
        costs[starts[earlier] : starts[earlier + 1], starts[later] : starts[later + 1]] = block

    date_of = np.repeat(np.arange(len(counts)), counts)
    after = _obey(costs, *([(int(starts[a] + i), int(starts[b] + j)) for (a, i), (b, j) in said]
                           for said in (same, different)))  # fmt: skip
    sights = [(int(date_of[n]), int(n - starts[date_of[n]])) for n in range(total)]
    links = []
    for one, other in sorted(after.items()):
        (date, row), (later, column) = sights[one], sights[other]
        asked = costs[one, other] <= ENTITLED
        chance = 1.0 if asked else probability(compared[date, later].costs, row, column)
        links.append(Link((date, row), (later, column), chance))
    return links


def _obey(costs: Floats, same: Sequence[tuple[int, int]], different: Sequence[tuple[int, int]]) -> dict[int, int]:
    """{sight: its next} of the cheapest paths, with pairs (earlier, later) on one path, or on two; changes `costs`.

    A pair that is not on one path of its own gets a direct link; of a path that it must not share, the dearest link
    between the two is forbidden.

    Raises:
        InputError: the pairs contradict each other.
    """
    for _ in range(1 + len(costs) * (len(same) + len(different))):
        after = _cheapest_links(costs)
        apart = [(one, other) for one, other in same if other not in _path(after, one)]
        joined = [(one, other) for one, other in different if other in _path(after, one)]
        if not apart and not joined:
            return after
        for one, other in apart:
            costs[one], costs[:, other] = np.inf, np.inf
            costs[one, other] = ENTITLED
        for one, other in joined:
            path = [one, *_path(after, one)]
            steps = list(pairwise(path[: path.index(other) + 1]))
            costs[max(steps, key=lambda step: float(costs[step]))] = np.inf
    raise InputError("what a person says of leaves over days contradicts itself")


def _path(after: Mapping[int, int], start: int) -> list[int]:
    """The sights that follow one."""
    path = []
    while start in after:
        start = after[start]
        path.append(start)
    return path


def _cheapest_links(costs: Floats) -> dict[int, int]:
    """{sight: its next} of the paths with the least sum of costs, a missing link costing UNLINKED."""
    rows, columns = linear_sum_assignment(np.minimum(costs, UNLINKED))
    taken = costs[rows, columns] < UNLINKED
    return dict(zip(rows[taken].tolist(), columns[taken].tolist(), strict=True))


def probability(costs: Floats, row: int, column: int) -> float:
    """Of a pair in the costs (N, M) of two dates: that it is one leaf, against all other partners that each could have.

    With costs as log odds, p = e^-c / (1 + e^-c + the sum of e^-c over the others); its log odds are then stretched as
    simulated series say (`CALIBRATION`).
    """
    odds = np.exp(-np.clip(costs, -40, 40))
    own = odds[row, column]
    others = odds[row].sum() + odds[:, column].sum() - 2 * own
    slope, offset = CALIBRATION
    logit = slope * float(np.log(own) - np.log1p(others)) + offset
    return float(1 / (1 + np.exp(-np.clip(logit, -40, 40))))
