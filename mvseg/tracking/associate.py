"""Tracks over all dates at once: the observations of leaves are parted such that the costs within tracks are least.

Each leaf is compared with those of the three dates before and after, and a track's cost is the sum over all of its
pairs: a leaf that looks odd on one date, or is missed, is held by the dates around it. The least sum is hard to find (a
multicut, see Keuper et al., ICCV 2015); here all tracks are cut at a date, or one date is taken out of them, and their
parts are joined anew, exactly (`linear_sum_assignment`), until that gains nothing.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.special import expit

from mvseg.arrays import Floats, Ints
from mvseg.errors import InputError
from mvseg.tracking.compare import Asked, Comparison, Observation, link_chances
from mvseg.tracking.numbers import LINKING

# fitted: slope and offset of the log odds of links; `python -m benchmarks.fit_chances` fits them
CALIBRATION = (0.33, 4.08)


@dataclass(frozen=True)
class Association:
    """Two observations of one leaf that follow each other, and the probability that they are: 1 if the user says so.
    `link_leaves` gives it for dates that are surely aligned, `sum_over_poses` for any."""

    before: Observation
    after: Observation
    probability: float
    is_asked: bool = False


def link_leaves(
    counts: Sequence[int],
    costs: Mapping[tuple[int, int], Floats],
    *,
    same: Asked = (),
    different: Asked = (),
    doubted: np.ndarray | bool = False,
) -> list[Association]:
    """The links of the cheapest tracks, by their earlier observation.

    `counts` are the leaves with a shape on each date; `same` and `different` pairs of observations that the user says
    are one leaf, or are not; `doubted` (S,) bool, date after date, looks like a stem and is not named in such a pair,
    see `join_observations`. Raises InputError: the pairs contradict each other.
    """
    starts = np.concatenate([[0], np.cumsum(counts)]).astype(int)
    date_of, gains = np.repeat(np.arange(len(counts)), counts), np.zeros((starts[-1], starts[-1]))
    for (a, b), of_pair in costs.items():
        gains[starts[a] : starts[a + 1], starts[b] : starts[b + 1]] = (LINKING.unlinked - of_pair) / (b - a)
    asked = {(starts[a] + i, starts[b] + j): sign * LINKING.asked for said, sign in ((same, 1), (different, -1))
             for (a, i), (b, j) in said}  # fmt: skip
    for place, gain in asked.items():
        gains[place] = gain
    gains += gains.T
    tracks = join_observations(gains, date_of, doubted & ~np.isin(np.arange(len(gains)), [*chain(*asked)]))
    if any((tracks[one] == tracks[other]) != (gain > 0) for (one, other), gain in asked.items()):
        raise InputError("what the user says of leaves over days contradicts itself")
    links = []
    for later in range(1, len(counts)):
        chances = _probabilities(tracks, gains, later=date_of >= later)
        for after in np.flatnonzero(date_of == later):
            known = np.flatnonzero((tracks == tracks[after]) & (date_of < later))
            if len(known):
                before, chance = known[-1], chances[tracks[after]]
                is_asked = gains[known, after].max() >= LINKING.asked
                both = [(int(date_of[n]), int(n - starts[date_of[n]])) for n in (before, after)]
                links.append(Association(both[0], both[1], 1.0 if is_asked else chance, is_asked=bool(is_asked)))
    return links


def sum_over_poses(links: Sequence[Association], compared: Comparison) -> list[Association]:
    """The links with probabilities summed over poses: that each is right under the one that was taken, and under the
    others. Links of the user are so under all of them."""
    associations = []
    for link in links:
        (earlier, row), (later, column) = link.before, link.after
        sure, others = float(compared.trust[earlier, later]), compared.otherwise.get((earlier, later))
        chance = sure * link.probability + (1 - sure) * (0.0 if others is None else float(others[row, column]))
        associations.append(link if link.is_asked else replace(link, probability=chance))
    return associations


def pairwise_chances(compared: Comparison) -> dict[tuple[int, int], Floats]:
    """{(earlier, later): (N, M) probability that leaves of these two dates are the same, summed over poses}, whatever
    other dates and the user say; for asking about leaves that are not linked."""
    chances = {}
    for pair, costs in compared.costs.items():
        under_this, trust = link_chances(LINKING.unlinked - costs), compared.trust[pair]
        chances[pair] = trust * under_this + (1 - trust) * compared.otherwise.get(pair, 0.0)
    return chances


def join_observations(gains: Floats, date_of: np.ndarray, doubted: np.ndarray) -> np.ndarray:
    """(S,) the track of each observation, such that gains within tracks are large; no track has two of one date.
    `gains` (S, S) symmetric are of each pair in one track, 0 where not compared; `date_of` (S,) are date indices.

    Observations that are `doubted` (S,) bool, since they look like a stem, join the tracks of the others where these
    have none on a date. So a rolled leaf goes on as the leaf that it opens to, not as the next one in its place.
    """
    tracks, sure = np.arange(len(gains)), ~doubted
    tracks[sure] = len(gains) + _join_all(gains[np.ix_(sure, sure)], date_of[sure])
    excluding = np.where(date_of[:, None] == date_of, -LINKING.asked, gains)
    for date in np.unique(date_of[doubted]):
        tracks = _rejoin(tracks, excluding, doubted & (date_of == date))
    return tracks


def _join_all(gains: Floats, date_of: np.ndarray) -> np.ndarray:
    tracks, dates = np.arange(len(gains)), np.unique(date_of)
    for date in dates[1:]:
        tracks = _rejoin(tracks, gains, date_of == date, among=date_of <= date)
    for _ in range(LINKING.rounds):
        before = tracks[:, None] == tracks
        for date in dates:
            for apart in (date_of > date, date_of == date):
                tracks = _rejoin(tracks, gains, apart)
        if ((tracks[:, None] == tracks) == before).all():
            break
    return tracks


def _rejoin(tracks: np.ndarray, gains: Floats, apart: np.ndarray, among: np.ndarray | None = None) -> np.ndarray:
    """Cut the tracks in two, `apart` (S,) and the rest, and join the parts for the largest gain."""
    here, there, table = _part_gains(tracks, gains, ~apart if among is None else among & ~apart, apart)
    rows, columns = linear_sum_assignment(np.maximum(table, 0.0), maximize=True)
    is_better = table[rows, columns] > 0
    names = tracks.max(initial=0) + 1 + np.arange(len(there))
    names[columns[is_better]] = here[rows[is_better]]
    joined = tracks.copy()
    joined[apart] = names[np.searchsorted(there, tracks[apart])]
    return joined


def _part_gains(tracks: Ints, gains: Floats, one: np.ndarray, other: np.ndarray) -> tuple[Ints, Ints, Floats]:
    (here, row), (there, column) = (np.unique(tracks[part], return_inverse=True) for part in (one, other))
    return here, there, np.eye(len(here))[row].T @ gains[np.ix_(one, other)] @ np.eye(len(there))[column]


def _probabilities(tracks: np.ndarray, gains: Floats, later: np.ndarray) -> dict[int, float]:
    """{track: P(its later observations show the same leaf)}, against all parts it could join (`CALIBRATION`)."""
    here, there, table = _part_gains(tracks, gains, ~later, later)
    odds, probabilities = np.exp(np.clip(table, -LINKING.most_odds, LINKING.most_odds)), {}
    for track in np.intersect1d(here, there).tolist():
        row, column = np.searchsorted(here, track), np.searchsorted(there, track)
        others = odds[row].sum() + odds[:, column].sum() - 2 * odds[row, column]
        logit = CALIBRATION[0] * (np.log(odds[row, column]) - np.log1p(others)) + CALIBRATION[1]
        probabilities[track] = float(expit(logit))
    return probabilities
