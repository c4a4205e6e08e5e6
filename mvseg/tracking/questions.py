"""Questions to the user about a plant's tracks: the most doubtful links, and the effects of another answer."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations, pairwise

import numpy as np
from scipy.spatial.transform import Rotation

from mvseg.corrections.track_links import LeafLink
from mvseg.tracking.dates import NUMBER
from mvseg.tracking.numbers import ALIGN, PAGE
from mvseg.tracking.track import Tracks, list_observations

Observation = tuple[int, int]  # index of the date, id of the leaf in its result


@dataclass(frozen=True)
class Question:
    """Are two leaves of different dates the same?

    Attributes:
        is_linked: they are, as the tracks say; otherwise `before` has no later observation, and `after` no earlier one.
        doubt: probability that the tracks are wrong there.
    """

    before: Observation
    after: Observation
    is_linked: bool
    doubt: float

    def link(self, tracks: Tracks, *, is_same: bool) -> LeafLink:
        """The user's answer."""
        return LeafLink(is_same, tuple((tracks.dates[date].scene, leaf) for date, leaf in (self.before, self.after)))


def list_questions(tracks: Tracks, links: Sequence[LeafLink] = ()) -> list[Question]:
    """The most doubtful first; each leaf is asked about once as the earlier one, and once as the later one. Questions
    that `links` answer are left out."""
    linked = {frozenset(pair) for link in links for pair in combinations(link.leaves, 2)}
    every = sorted((*_of_links(tracks), *_of_ends(tracks)), key=lambda each: (-each.doubt, each.before, each.after))
    asked: list[Question] = []
    for each in every:
        is_new = all(each.before != other.before and each.after != other.after for other in asked)
        is_answered = frozenset(each.link(tracks, is_same=True).leaves) in linked
        if is_new and not is_answered and each.doubt >= PAGE.least_doubt and len(asked) < PAGE.most_questions:
            asked.append(each)
    return asked


def _of_links(tracks: Tracks) -> Iterator[Question]:
    for observations in list_observations(tracks).values():
        for (before, _), (after, chance) in pairwise(observations):
            yield Question(before, after, True, round(1 - chance, 6))


def _of_ends(tracks: Tracks) -> Iterator[Question]:
    shaped = [{date.leaves[place].leaf: row for row, place in enumerate(date.shaped)} for date in tracks.dates]
    observations = list(list_observations(tracks).values())
    for (earlier, leaf), (later, other) in ((one[-1][0], two[0][0]) for one in observations for two in observations):
        chances = tracks.chances.get((earlier, later))
        if chances is not None and leaf in shaped[earlier] and other in shaped[later]:
            chance = float(chances[shaped[earlier][leaf], shaped[later][other]])
            yield Question((earlier, leaf), (later, other), False, round(chance, 6))


def describe_changes(now: Tracks, then: Tracks) -> list[str]:
    """Describe the differences of other tracks of the same plant, a sentence each; leaves are called as they are
    now."""
    names = {leaf: track for track, observations in list_observations(now).items() for leaf, _ in observations}
    before, after = _earlier_observations(now), _earlier_observations(then)
    changes = []
    for observation in sorted(before.keys() | after.keys()):
        if before.get(observation) != (source := after.get(observation)) and observation in names:
            leaf = f"leaf {names[observation]} of {_name_day(now, observation[0])}"
            if source is None:
                changes.append(f"{leaf} is a new one")
            elif source in names:
                changes.append(f"{leaf} is leaf {names[source]}")
    return [*_describe_turns(now, then), *changes]


def _describe_turns(now: Tracks, then: Tracks) -> Iterator[str]:
    for later in range(1, len(now.dates)):
        one, other = (np.linalg.inv(each.poses[later - 1]) @ each.poses[later] for each in (now, then))
        turn = np.degrees(Rotation.from_matrix(other[:3, :3] @ one[:3, :3].T).magnitude())
        if turn > 360 / ALIGN.turns:
            yield f"the plant of {_name_day(now, later)} is turned by {turn:.0f} degrees"


def _name_day(tracks: Tracks, date: int) -> str:
    written = tracks.dates[date].written
    return f"day {written}" if NUMBER.fullmatch(written) else written


def _earlier_observations(tracks: Tracks) -> dict[Observation, Observation]:
    every = (pairwise(observations) for observations in list_observations(tracks).values())
    return {after: before for pairs in every for (before, _), (after, _) in pairs}
