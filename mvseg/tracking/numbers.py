"""The numbers of tracking: definitions, technical limits, and what was fitted to simulated and real series.

`python -m benchmarks.thirds --room tracking` prints what a third less or more of each changes; the table is in
docs/notes/tracking.md. Scales and weights that were fitted together stand in `fitted_costs.py`, `align.py` and
`associate.py`.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class ObservationNumbers:
    """Observations of a leaf on a date."""

    stations: int = 9  # definition: points of a midrib, base and tip included
    rows: int = 12  # definition: rows of points from base to tip, of edge, midrib and edge
    most_days: int = 100_000  # limit: days of five digits; more are dates, or seconds

    @property
    def cloud(self) -> int:
        """Points that stand for a leaf."""
        return 3 * self.rows


@dataclass(frozen=True)
class AlignNumbers:
    """The pose of a plant on one date in the world of another."""

    still: float = 4.0  # chosen: log odds that a pot stands as it stood, over any single turn, unless `pots` says more
    num_refined: int = 20  # chosen: poses of two dates that are refined, those that look best
    upright: float = 2.0  # chosen: weight of the direction of up where a pose is fitted, in leaves
    tip: float = 0.43  # chosen: weight of the tip of a leaf there, where base and middle have 1, for tips sway
    least_weight: float = 1.0  # chosen: min. weight there of a pair that the user says is one leaf
    large_new: float = 3.0  # chosen: log odds that each large leaf costs a pose that lets it appear from nowhere
    temper: float = 0.44  # fitted: python -m benchmarks.fit_chances; share of a gain of a pose that is log odds
    told: float = 0.9  # chosen: probability of an alignment below which the user is told
    turns: int = 30  # definition: turns of a pot that leaves can tell apart, of 12 degrees
    rounds: int = 5  # limit: max. rounds of pairing leaves and fitting a pose to them
    date_rounds: int = 6  # limit: max. rounds of placing all dates anew; two or three are enough
    digits: int = 6  # limit: decimals of logarithms and probabilities; what differs in later ones is a tie
    places: int = 9  # limit: decimals of a pose; what differs in later ones is rounding


@dataclass(frozen=True)
class CostNumbers:
    """Costs of pairs of leaves."""

    tail: float = 3.0  # chosen: degrees of freedom of Student's t, which differences follow
    flipped: float = 0.5  # chosen: additional cost of a midrib that runs the other way on the other date
    spread: float = 0.6  # chosen: share of the spread of bases in which places are measured, if leaves are shorter
    prior_pairs: int = 3  # chosen: pairs that say as much of how a plant bent as the prior, that it did not
    usual: float = 0.16  # chosen: usual error of the place of a base once a plant is bent, in `Pair.scale`


@dataclass(frozen=True)
class LinkNumbers:
    """Links from observation to observation of a leaf."""

    most_gap: int = 3  # chosen: max. dates between compared observations: a leaf may be hidden on two
    unlinked: float = 2.0  # chosen: a pair of leaves that costs less favours one track over two
    user_odds: float = 20.0  # definition: log odds of a user's link for weighing poses: more than any leaf's
    asked: float = 1e4  # limit: gain of a link of the user, above all that leaves can say
    most_odds: float = 40.0  # limit: max. log odds, so that their exponentials are numbers
    rounds: int = 10  # limit: max. rounds of joining anew; two or three are enough


@dataclass(frozen=True)
class PageNumbers:
    """The page, and its questions."""

    most_questions: int = 10  # definition: questions that the user answers
    least_doubt: float = 0.1  # chosen: probability that a link, or its absence, is wrong, below which nobody is asked
    side: int = 72  # definition: pixels of a picture of a leaf
    large_side: int = 160  # definition: the same, where links are corrected
    plant_side: int = 120  # definition: pixels of the picture of a plant
    quality: int = 70  # definition: JPEG quality of pictures


OBSERVATIONS = ObservationNumbers()
ALIGN = AlignNumbers()
COSTS = CostNumbers()
LINKING = LinkNumbers()
PAGE = PageNumbers()
