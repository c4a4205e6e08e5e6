"""Costs of pairs of leaves, by plants made for them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mvseg.tracking.align import refine
from mvseg.tracking.bent_costs import bent_costs, pair_costs
from mvseg.tracking.fitted_costs import LINKS, fitted_costs, size_costs
from mvseg.tracking.leaves import Pair, leaves_of
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
    for costs in (pair_costs, lambda each: fitted_costs(each, LINKS)):
        np.testing.assert_allclose((costs(turned) - costs(pair))[rows, there], 0.5, atol=1e-9)


def test_a_plant_that_leans_over_is_bent_before_its_leaves_are_compared() -> None:
    """The more the higher up: a pose explains it in part, and the other leaves say the rest."""
    blades = grow_blades(9, 3)
    leaning = {leaf: blade + (blade[0, 1, 2], 0.4 * blade[0, 1, 2], 0) for leaf, blade in blades.items()}
    pair, there = pair_of(blades, leaning)
    alignment = refine(pair, np.eye(4))
    rows = np.arange(9)
    bent, straight = bent_costs(pair, alignment), pair_costs(pair.moved(alignment.pose))
    assert straight[rows, there].max() > 0
    assert bent[rows, there].max() < -4
    bent[rows, there] = np.inf
    assert bent.min() > 0


def test_a_leaf_that_has_stopped_growing_keeps_its_length_or_its_area_and_a_young_one_may_grow() -> None:
    pair, there = pair_of(grow_blades(4, 5), grow_blades(4, 5))
    rows = np.arange(4)
    before, after = np.array([100.0, 100.0, 40.0, 40.0]), np.array([100.0, 65.0, 85.0, 40.0])
    first = replace(pair.first, lengths=before, areas=20 * before)
    second = replace(pair.second, lengths=np.empty(4), areas=np.empty(4))
    second.lengths[there], second.areas[there] = after, (2000, 2000, 3600, 800)
    days = replace(pair, first=first, second=second, days=3)
    costs = size_costs(days, LINKS)[rows, there]
    assert costs[[0, 2]].max() < 0.2
    assert 1 < costs[3] < 2.5  # it may have stopped early, which is rarer
    assert costs[1] < 2.5  # a surface shows it shorter, with the area that it had
    no_areas = replace(days, second=replace(second, areas=np.full(4, np.nan)))
    assert size_costs(no_areas, LINKS)[rows, there][1] > costs[1] + 1  # then its length alone tells
