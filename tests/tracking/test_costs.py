"""Costs of pairs of leaves, by plants made for them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mvseg.tracking.align import best_pairs, refine_alignment
from mvseg.tracking.fitted_costs import LINKS, POSES, Differences, bend, bent_costs, fitted_costs, size_costs
from mvseg.tracking.leaves import Pair, leaves_of
from mvseg.tracking.numbers import COSTS, LINKING, OBSERVATIONS
from tests.plants_over_days import Blades, grow_blades, see


def pair_of(first: Blades, second: Blades) -> tuple[Pair, np.ndarray]:
    """And where in the second each leaf of the first is."""
    (one, truth), (other, later) = see(first, 0), see(second, 1)
    return Pair.of(leaves_of(one), leaves_of(other), days=1, knows_up=True), np.array([later.index(n) for n in truth])


def test_places_are_measured_in_lengths_of_leaves_or_by_how_far_many_small_ones_are_spread() -> None:
    blades = grow_blades(12, 1)
    lengths = [float(np.linalg.norm(np.diff(blade[:, 1], axis=0), axis=1).sum()) for blade in blades.values()]
    near = {leaf: blade - blade[0, 1] for leaf, blade in blades.items()}
    assert pair_of(near, near)[0].scale == pytest.approx(np.median(lengths), rel=0.03)
    angles = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    ring = [(400 * np.cos(angle), 400 * np.sin(angle), 0.0) for angle in angles]
    far = {leaf: near[leaf] + place for leaf, place in enumerate(ring, start=1)}
    assert pair_of(far, far)[0].scale == pytest.approx(0.6 * 400, rel=0.03)


def test_a_midrib_that_runs_the_other_way_costs_half_a_unit() -> None:
    pair, there = pair_of(grow_blades(7, 2), grow_blades(7, 2))
    turned = replace(pair, second=replace(pair.second, midribs=pair.second.midribs[:, ::-1]))
    rows = np.arange(7)
    for scales in (POSES, LINKS):
        more = fitted_costs(turned, scales) - fitted_costs(pair, scales)
        np.testing.assert_allclose(more[rows, there], 0.5, atol=1e-9)


def test_a_plant_that_leans_over_is_bent_before_its_leaves_are_compared() -> None:
    """The more the higher up: a pose explains it in part, and the other leaves say the rest."""
    blades = grow_blades(9, 3)
    leaning = {leaf: blade + (blade[0, 1, 2], 0.4 * blade[0, 1, 2], 0) for leaf, blade in blades.items()}
    pair, there = pair_of(blades, leaning)
    alignment = refine_alignment(pair, np.eye(4))
    aligned = pair.moved(alignment.pose)
    bent, straight = bent_costs(aligned, alignment.pairs), fitted_costs(aligned, LINKS)
    rows = np.arange(9)
    assert bent[rows, there].max() < straight[rows, there].max() - 2
    bent[rows, there] -= LINKING.unlinked
    np.testing.assert_array_equal(best_pairs(bent), np.stack([rows, there], 1))


def test_each_leaf_is_bent_as_the_pairs_of_the_others_say() -> None:
    """As a loop that leaves its own pair out says, too; the prior is worth three pairs that did not move."""
    pair, there = pair_of(grow_blades(9, 3), {leaf: blade + 0.2 * blade[0, 1, 2] for leaf, blade in
                                              grow_blades(9, 3).items()})  # fmt: skip
    rows = np.arange(7)
    bent, widths = bend(pair, np.stack([rows, there[:7]], 1))
    bases, away = pair.first.bases / pair.scale, (pair.second.bases[there[:7]] - pair.first.bases[:7]) / pair.scale
    places = np.column_stack([np.ones(9), bases - bases[:7].mean(0)])
    weights = 1 / (1 + np.square(np.linalg.norm(away - np.median(away, 0), axis=1) / COSTS.usual))
    shifts, variances = np.zeros((9, 3)), np.zeros(9)
    for leaf in range(9):
        covariance = COSTS.prior_pairs * np.eye(4)
        moment = np.zeros((4, 3))
        for other in rows:
            if other != leaf:
                covariance += weights[other] * np.outer(places[other], places[other])
                moment += weights[other] * np.outer(places[other], away[other])
        shifts[leaf] = places[leaf] @ np.linalg.inv(covariance) @ moment
        variances[leaf] = places[leaf] @ np.linalg.inv(covariance) @ places[leaf]
    np.testing.assert_allclose((bent.bases - pair.first.bases) / pair.scale, shifts, atol=1e-9)
    median = np.median(np.linalg.norm((away - shifts[:7])[:, :2], axis=1)) / COSTS.usual
    np.testing.assert_allclose(widths, np.sqrt((3 + 7 * median**2) / 10 * (1 + variances)))


def test_a_leaf_of_which_half_is_seen_lies_on_the_whole_one() -> None:
    pair, there = pair_of(grow_blades(7, 2), grow_blades(7, 2))
    half = pair.second.points[:, OBSERVATIONS.cloud // 2 :].repeat(2, axis=1)
    part = replace(pair, second=replace(pair.second, points=half))
    near = Differences.of(part, cloud=True).near
    assert near is not None
    assert near[np.arange(7), there].max() < 0.03


def test_a_leaf_that_has_stopped_growing_keeps_its_length_or_its_area_and_a_young_one_may_grow() -> None:
    pair, there = pair_of(grow_blades(4, 5), grow_blades(4, 5))
    rows = np.arange(4)
    before, after = np.array([100.0, 100.0, 40.0, 40.0]), np.array([100.0, 65.0, 85.0, 40.0])
    first = replace(pair.first, lengths=before, areas=20 * before)
    second = replace(pair.second, lengths=np.empty(4), areas=np.empty(4))
    second.lengths[there], second.areas[there] = after, (2000, 2000, 3600, 800)
    days = replace(pair, first=first, second=second, days=3)
    costs = size_costs(Differences.of(days), LINKS)[rows, there]
    assert costs[[0, 2]].max() < 0.2
    assert 1 < costs[3] < 2.5  # it may have stopped early, which is rarer
    assert costs[1] < 2.5  # a surface shows it shorter, with the area that it had
    no_areas = replace(days, second=replace(second, areas=np.full(4, np.nan)))
    lengths_alone = size_costs(Differences.of(no_areas), LINKS)[rows, there]
    assert lengths_alone[1] > costs[1] + 1
