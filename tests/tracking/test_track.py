"""Tracks of whole plants: births, deaths, gaps, and what cannot be known."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mvseg.corrections.track_links import LeafLink
from mvseg.errors import InputError
from mvseg.findings.finding import Finding
from mvseg.tracking.dates import PlantOnDate
from mvseg.tracking.track import track_leaves
from tests.plants_over_days import Blades, grow_blades, see, true_tracks

BLADES = grow_blades(10, 4)


def days(*present: set[int]) -> tuple[list[PlantOnDate], list[list[int]]]:
    """Dates with these leaves, in a pot that is turned each day."""
    seen = [
        see({leaf: BLADES[leaf] for leaf in there}, day, turn=77 * day, lean=3, shift=(60 * day, 0, 0))
        for day, there in enumerate(present)
    ]
    return [date for date, _ in seen], [truth for _, truth in seen]


def test_births_deaths_and_gaps() -> None:
    old = set(range(1, 10))
    dates, truths = days(old, old - {5}, (old | {10}) - {1}, (old | {10}) - {1})
    tracks = track_leaves(dates, plant="basil")
    assert tracks.findings == ()
    assert all(len(leaves) == 1 for leaves in true_tracks(tracks, truths).values())
    assert tracks.num_tracks == 10
    of_leaf = {next(iter(leaves)): track for track, leaves in true_tracks(tracks, truths).items()}
    states = {
        leaf: [(row.date, row.state) for row in tracks.rows if row.track == of_leaf[leaf]] for leaf in (1, 2, 5, 10)
    }
    assert states[1] == [(0, "seen"), (1, "seen"), (2, "gone")]
    assert states[2] == [(0, "seen"), (1, "seen"), (2, "seen"), (3, "seen")]
    assert states[5] == [(0, "seen"), (1, "hidden"), (2, "seen"), (3, "seen")]
    assert states[10] == [(2, "born"), (3, "seen")]
    linked = [row.probability for row in tracks.rows if row.date > 0 and row.state == "seen"]
    assert min(linked) > 0.9


def test_tracks_are_numbered_from_below() -> None:
    """However the leaves of a date are numbered, and whichever appeared first."""
    upper = dict(sorted(BLADES.items(), key=lambda item: -float(item[1][0, 1, 2]))[:6])
    dates = [see(blades, day)[0] for day, blades in enumerate((upper, BLADES))]
    for seen in (dates, [replace(date, leaves=date.leaves[::-1]) for date in dates]):
        tracks = track_leaves(seen)
        midribs = {leaf.leaf: leaf.midrib for leaf in tracks.dates[1].leaves}
        rows = [row for row in tracks.rows if row.date == 1 and row.leaf is not None]
        heights = [float(midribs[row.leaf][0, 2]) for row in rows]  # type: ignore[index]
        assert [row.track for row in rows] == [*range(1, 11)]
        assert heights == sorted(heights)
    unknown = track_leaves([replace(date, knows_up=False) for date in dates])
    assert [row.track for row in unknown.rows if row.date == 0] == [*range(1, 7)]  # in the order of appearance


@pytest.mark.parametrize(("num_hidden", "num_tracks"), [(2, 10), (3, 11)])
def test_a_leaf_that_is_missing_for_more_than_two_dates_gets_a_new_track(num_hidden: int, num_tracks: int) -> None:
    every = set(BLADES)
    dates, truths = days(every, *[every - {4}] * num_hidden, every)
    tracks = track_leaves(dates)
    assert tracks.num_tracks == num_tracks
    assert all(len(leaves) == 1 for leaves in true_tracks(tracks, truths).values())


def test_poses_bring_all_dates_into_the_first_frame() -> None:
    dates, truths = days(set(BLADES), set(BLADES), set(BLADES))
    tracks = track_leaves(dates)
    for date, truth, pose in zip(tracks.dates[1:], truths[1:], tracks.poses[1:], strict=True):
        for leaf in date.leaves:
            assert leaf.midrib is not None
            base = pose[:3, :3] @ leaf.midrib[0] + pose[:3, 3]
            np.testing.assert_allclose(base, BLADES[truth[leaf.leaf - 1]][0, 1], atol=12)


def test_a_repotted_plant_is_linked_by_guesses_that_say_so() -> None:
    dates, _ = days(set(BLADES), set(BLADES))
    other = see(grow_blades(9, 77), 2, scene="other")[0]
    tracks = track_leaves([*dates, other])
    assert (tracks.findings[0].code, tracks.findings[0].where) == ("pot_guessed", "day-1 and other")
    guessed = [row.probability for row in tracks.rows if row.date == 2 and not math.isnan(row.probability)]
    sure = [row.probability for row in tracks.rows if row.date == 1]
    assert max(guessed, default=0) < 0.9 < min(sure)


def two_in_a_pot(turn: float, other: Blades) -> tuple[list[PlantOnDate], list[list[int]]]:
    """Two plants side by side; after the first date the second one is set back, turned against the first."""
    pot = Rotation.from_euler("z", turn, degrees=True)
    still = {leaf + 10: blade + (250.0, 0, 0) for leaf, blade in other.items()}
    turned = {leaf + 10: pot.apply(blade.reshape(-1, 3)).reshape(blade.shape) + (250.0, 0, 0)
              for leaf, blade in other.items()}  # fmt: skip
    seen = [see(BLADES | (turned if day else still), day, turn=50 * day) for day in range(2)]
    return [date for date, _ in seen], [truth for _, truth in seen]


def test_two_plants_in_one_pot_keep_their_tracks_even_where_one_is_turned() -> None:
    dates, truths = two_in_a_pot(0, grow_blades(8, 31))
    tracks = track_leaves(dates)
    assert tracks.findings == ()
    assert tracks.num_tracks == 18
    assert all(len(leaves) == 1 for leaves in true_tracks(tracks, truths).values())
    dates, truths = two_in_a_pot(120, grow_blades(8, 31))
    tracks = [found for found in true_tracks(track_leaves(dates), truths).values() if found & set(BLADES)]
    assert sorted(tracks, key=min) == [{leaf} for leaf in sorted(BLADES)]


def test_a_plant_with_one_leaf_and_a_date_without_leaves() -> None:
    dates = [see({3: BLADES[3]}, time)[0] for time in (0, 1)]  # on the same spot
    tracks = track_leaves(dates)
    assert tracks.num_tracks == 1
    assert 0.9 < max(row.probability for row in tracks.rows if row.date == 1) < 1
    assert tracks.rows[1].probability < 1
    fixed = track_leaves(dates, pots="fixed")
    assert fixed.num_tracks == 1
    assert fixed.findings == ()
    old = set(range(1, 9))
    dates, truths = days(old, set(), old)
    tracks = track_leaves(dates)
    assert (tracks.findings[0].code, tracks.findings[0].where) == ("pot_guessed", "day-0 and day-1")
    assert tracks.num_tracks == 8  # linked over the date without leaves
    assert all(len(leaves) == 1 for leaves in true_tracks(tracks, truths).values())


def test_a_leaf_without_a_shape_is_a_track_of_one_date() -> None:
    dates, _ = days(set(BLADES), set(BLADES))
    hidden = replace(dates[1].leaves[0], midrib=None, normal=None, points=None)
    tracks = track_leaves([dates[0], replace(dates[1], leaves=(hidden, *dates[1].leaves[1:]))])
    assert tracks.findings[0] == Finding("leaves_without_shape", values={"count": 1})
    assert tracks.num_tracks == 11


def test_what_looks_like_a_stem_counts_where_another_date_shows_a_leaf() -> None:
    """A leaf that is rolled on one day keeps its track; what is a stem on all days, or on one alone, has none."""
    blades = grow_blades(5, 3)
    young = {leaf: blade for leaf, blade in blades.items() if leaf != 5}
    seen = [see(young, 0), see(blades, 1), see(blades, 2)]
    doubted = {0: {2, 4}, 1: {2, 3}, 2: {2, 5}}  # true leaves; 2 on all days
    dates = [
        replace(date, leaves=tuple(
            replace(leaf, is_doubted=true in doubted[n]) for leaf, true in zip(date.leaves, truth, strict=True)
        ))
        for n, (date, truth) in enumerate(seen)
    ]  # fmt: skip
    tracks = track_leaves(dates)
    found = true_tracks(tracks, [truth for _, truth in seen])
    assert sorted(map(sorted, found.values())) == [[1], [3], [4], [5]]
    assert [len(date.leaves) for date in tracks.dates] == [3, 4, 4]
    assert all(sum(row.track == track and row.leaf is not None for row in tracks.rows) == 3 - (5 in true)
               for track, true in found.items())  # fmt: skip


def test_what_a_person_says_is_obeyed() -> None:
    dates, truths = days(set(BLADES), set(BLADES), set(BLADES))
    ids = [{leaf: number for number, leaf in enumerate(truth, start=1)} for truth in truths]
    same = LeafLink(True, (("day-0", ids[0][1]), ("day-2", ids[2][2])))
    tracks = track_leaves(dates, links=[same])
    assert {1, 2} in true_tracks(tracks, truths).values()
    apart = LeafLink(False, (("day-0", ids[0][3]), ("day-2", ids[2][3])))
    tracks = track_leaves(dates, links=[apart])
    rows = {(row.date, row.leaf): row.track for row in tracks.rows}
    assert rows[0, ids[0][3]] != rows[2, ids[2][3]]
    with pytest.raises(InputError, match="results of one name"):
        track_leaves([dates[0], replace(dates[1], scene="day-0")], links=[same])
    for links, said in (
        ([LeafLink(True, (("day-9", 1), ("day-1", 1)))], "names the scene day-9"),
        ([LeafLink(True, (("day-0", 99), ("day-1", 1)))], "names leaf 99 of day-0"),
        ([LeafLink(True, (("day-0", 1), ("day-0", 2)))], "two leaves of day-0 are one"),
        ([replace(same, is_same=False), same], "same and to be different"),
    ):
        with pytest.raises(InputError, match=said):
            track_leaves(dates, links=links)


def test_the_number_of_dates_and_times() -> None:
    date = see(BLADES, 0)[0]
    with pytest.raises(InputError, match="expected two or more"):
        track_leaves([date])
    with pytest.raises(InputError, match="2 results have 1 times"):
        track_leaves([date, date], [0])
