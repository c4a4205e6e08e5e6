"""What a person is asked about tracks, and what the answers change."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from mvseg.tracking.numbers import PAGE
from mvseg.tracking.questions import describe_changes, list_questions
from mvseg.tracking.track import Tracks, track_leaves
from tests.plants_over_days import grow_blades, opposite_leaves, see, true_tracks


def in_two_ways() -> tuple[Tracks, list[list[int]]]:
    """A plant that looks the same from behind, in a pot that was turned: all of its links are guesses."""
    seen = [see(opposite_leaves(3), day, turn=40 * day) for day in (0, 1)]
    return track_leaves([date for date, _ in seen], pots="turned"), [truth for _, truth in seen]


def test_an_answer_changes_what_the_question_says_it_changes() -> None:
    now, truths = in_two_ways()
    questions = list_questions(now)
    assert len(questions) == 6
    assert [each.doubt for each in questions] == sorted((each.doubt for each in questions), reverse=True)
    asked = questions[0]
    assert asked.is_linked
    then = track_leaves(now.dates, links=[asked.link(now, is_same=False)], pots="turned")
    behind = {frozenset({1 + (leaf - 1) % 6, 1 + (leaf + 2) % 6}) for leaf in range(1, 7)}
    either = [{frozenset(each) for each in true_tracks(tracks, truths).values()} for tracks in (now, then)]
    assert sorted(map(len, either)) == [3, 6]  # once each leaf with itself, once with the one behind it
    assert behind in either
    turned, *changes = describe_changes(now, then)
    assert turned in ("the plant of day 1 is turned by 180 degrees", "the plant of day 1 is turned by 179 degrees")
    tracks_of = {(row.date, row.leaf): row.track for row in now.rows}
    first, second = ({row.leaf or 0: row.track for row in then.rows if row.date == date} for date in (0, 1))
    before = {track: leaf for leaf, track in first.items()}
    expected = [(tracks_of[1, leaf], tracks_of[0, before[track]]) for leaf, track in sorted(second.items())]
    assert changes == [f"leaf {leaf} of day 1 is leaf {other}" for leaf, other in expected]
    assert describe_changes(now, now) == []


def test_who_is_sure_asks_nothing_and_ends_are_asked_about_once() -> None:
    blades = grow_blades(8, 4)
    dates = [see(blades, day)[0] for day in (0, 1)]
    tracks = track_leaves(dates)
    assert list_questions(tracks) == []
    apart = replace(tracks, chances={(0, 1): np.full((8, 8), 0.5)}, rows=tuple(
        replace(row, track=row.track + 8 * row.date, state="born" if row.date else "seen") for row in tracks.rows
    ))  # fmt: skip
    questions = list_questions(apart)
    assert len(questions) == 8 < PAGE.most_questions
    assert {each.is_linked for each in questions} == {False}
    assert len({each.before for each in questions}) == len({each.after for each in questions}) == 8
