"""The numbers of tracking: definitions, technical limits, and what was fitted to simulated and real series.

`python benchmarks/thirds.py --room tracking` prints what a third less or more of each changes; the table is in
docs/notes/tracking.md. Scales and weights that were fitted together stand in `fitted_costs.py`, `align.py` and
`associate.py`.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class SightNumbers:
    """What a date shows of a leaf."""

    stations: int = 9  # definition: points of a midrib, base and tip included
    rows: int = 12  # definition: rows of points from base to tip, of edge, midrib and edge
    most_parts: int = 256  # limit: parts of a path, at most
    most_days: int = 100_000  # limit: days of five digits; more are dates, or seconds

    @property
    def cloud(self) -> int:
        """Points that stand for a leaf."""
        return 3 * self.rows


@dataclass(frozen=True)
class AlignNumbers:
    """The pose of a plant on one date in the world of another."""

    still: float = 5 / 6  # probability that a pot stands as it stood, before its plant is known
    prior_pairs: int = 6  # pairs of dates that say as much as this does
    least_still: float = 1e-6  # limit: probability of either answer, at least, so that its logarithm is a number
    alike_length: float = 1.2  # difference of the log lengths of two leaves that suggest a pose, at most
    num_refined: int = 20  # poses of two dates that are refined: those that look best
    upright: float = 2.0  # weight of the direction of up where a pose is fitted, in leaves
    tip: float = 0.43  # weight of the tip of a leaf there, where base and middle have 1, for tips sway
    least_weight: float = 1.0  # weight there of a pair that a person says is one leaf, at least
    large_new: float = 3.0  # log odds that each large leaf costs a pose that lets it appear from nowhere
    temper: float = 0.44  # share of a gain of a pose that is log odds; `python benchmarks/fit_chances.py` fits it
    told: float = 0.9  # probability of an alignment below which a person is told
    turns: int = 30  # definition: turns of a pot that leaves can tell apart, of 12 degrees
    rounds: int = 5  # limit: rounds of pairing leaves and fitting a pose to them, at most
    date_rounds: int = 6  # limit: rounds of placing all dates anew, at most; two or three are enough
    digits: int = 6  # limit: decimals of logarithms and probabilities; what differs in later ones is a tie
    places: int = 9  # limit: decimals of a pose; what differs in later ones is rounding


@dataclass(frozen=True)
class MotionNumbers:
    """Two parts of a plant that have moved apart."""

    least_gain: float = 20.0  # log odds from which a second motion is believed; leaves that only grow reach 15
    sure_margin: float = 7.0  # log odds of it over each other one from which it is sure, where two turns fit


@dataclass(frozen=True)
class BentNumbers:
    """Costs of pairs of leaves, where a plant has bent, too."""

    tail: float = 3.0  # degrees of freedom of Student's t, which differences follow
    flipped: float = 0.5  # additional cost of a midrib that runs the other way on the other date
    spread: float = 0.6  # share of the spread of bases in which places are measured, if leaves are shorter
    enough: int = 6  # leaves that are paired, from which on they tell how a plant bent
    like_rigid: float = 0.3  # weight of one motion of all leaves, where a plant is bent, in leaves
    place: float = 0.07  # scale of the distance of bases, or of points, of two sights of a leaf, in `Pair.scale`
    rise: float = 0.02  # growth of that scale a day between the dates, for heights and points, as internodes stretch
    bend: float = 0.10  # scale of the distance of midribs of two sights of a leaf, laid base on base, in its lengths
    parting: float = 9.0  # log odds of a leaf against a stranger where midribs agree in all
    apart: float = 3.0  # log odds of a leaf against a stranger where points lie on each other
    cloud_counts: float = 0.3  # factor of the cost of midribs, or of points, whichever says less of a pair
    in_part: float = 0.3  # difference of log lengths above which a surface may show a part of the leaf only


@dataclass(frozen=True)
class LinkNumbers:
    """Links from sight to sight of a leaf."""

    most_gap: int = 3  # dates from one sight to another that are compared, at most, so that two may hide a leaf
    unlinked: float = 2.0  # cost of a pair of leaves up to which one track is cheaper than two
    said: float = 20.0  # definition: log odds of what a person says, where poses are weighed: more than any leaf's own
    asked: float = 1e4  # limit: gain of what a person says, above all that leaves can say
    most_odds: float = 40.0  # limit: log odds, at most, so that their exponentials are numbers
    rounds: int = 10  # limit: rounds of joining anew, at most; two or three are enough


@dataclass(frozen=True)
class GrowthNumbers:
    """Curves of growing leaves."""

    least_sd: float = 0.01  # standard deviation of a size, at least, as a share of it: no leaf is measured better
    least_dates: int = 5  # dates on which a leaf is measured, from which on it gets a curve, which has three parameters


@dataclass(frozen=True)
class PageNumbers:
    """What a person sees and is asked."""

    most_questions: int = 10  # definition: questions that a person answers
    least_doubt: float = 0.1  # probability that a link, or that there is none, is wrong, below which nobody is asked
    curve_steps: int = 40  # definition: points of a drawn curve
    side: int = 72  # definition: pixels of a picture of a leaf
    large_side: int = 160  # definition: the same, where links are corrected
    plant_side: int = 120  # definition: pixels of the picture of a plant
    quality: int = 70  # definition: JPEG quality of pictures


SIGHTS = SightNumbers()
ALIGN = AlignNumbers()
MOTIONS = MotionNumbers()
BENT = BentNumbers()
LINKING = LinkNumbers()
GROWTH = GrowthNumbers()
PAGE = PageNumbers()
