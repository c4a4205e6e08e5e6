"""Links under more than one pose: their probability is the sum over all of them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from mvseg.tracking.associate import Association, link_leaves, sum_over_poses
from mvseg.tracking.compare import Comparison, compare_dates
from mvseg.tracking.leaves import leaves_of
from tests.plants_over_days import Blades, grow_blades, opposite_leaves, see


def link_two(blades: Blades) -> tuple[list[Association], Comparison]:
    leaves = [leaves_of(see(blades, day, turn=40 * day)[0]) for day in (0, 1)]
    compared = compare_dates(leaves, [0.0, 1.0], knows_up=True, pots="turned")
    return link_leaves([len(each) for each in leaves], compared.costs), compared


def test_leaves_of_a_plant_that_looks_the_same_from_behind_are_linked_with_half_a_chance() -> None:
    links, compared = link_two(opposite_leaves(3))
    assert len(links) == 6
    chances = np.array([link.probability for link in sum_over_poses(links, compared)])
    assert chances == pytest.approx(np.full(6, 0.5), abs=0.15)
    assert min(link.probability for link in links) > 0.9  # under the pose that was taken


def test_one_link_of_a_person_settles_how_the_pot_stands() -> None:
    """Whichever way the plant was taken to stand: all other leaves follow."""
    blades = opposite_leaves(3)
    (one, truth), (other, later) = (see(blades, day, turn=40 * day) for day in (0, 1))
    leaves = [leaves_of(one), leaves_of(other)]
    for behind in (0, 3):
        asked = [((0, truth.index(1)), (1, later.index(1 + behind)))]
        compared = compare_dates(leaves, [0.0, 1.0], knows_up=True, pots="turned", same=asked)
        links = sum_over_poses(link_leaves([6, 6], compared.costs, same=asked), compared)
        linked = {truth[link.before[1]]: later[link.after[1]] for link in links}
        assert linked == {leaf: 1 + (leaf - 1 + behind) % 6 for leaf in range(1, 7)}
        assert min(link.probability for link in links) > 0.9
    (link,) = (link for link in links if link.before == asked[0][0])
    unlike = [(link.before, link.after)]
    compared = compare_dates(leaves, [0.0, 1.0], knows_up=True, pots="turned", different=unlike)
    assert truth[link.before[1]] == later[link_of(compared, link.before)]  # then it is as in the other pose


def link_of(compared: Comparison, before: tuple[int, int]) -> int:
    """The row of the leaf that follows one."""
    return next(link.after[1] for link in link_leaves([6, 6], compared.costs) if link.before == before)


def test_one_leaf_that_breaks_the_symmetry_makes_them_sure() -> None:
    links, compared = link_two({leaf: blade for leaf, blade in opposite_leaves(3).items() if leaf != 6})
    assert min(link.probability for link in sum_over_poses(links, compared)) > 0.8


def test_pots_that_are_said_to_be_fixed_stand_as_they_stood() -> None:
    """Even where the leaves say otherwise."""
    leaves = [leaves_of(see(grow_blades(7, 3), day, turn=80 * day)[0]) for day in range(4)]
    compared = compare_dates(leaves, [0.0, 1.0, 2.0, 3.0], knows_up=True, pots="fixed")
    np.testing.assert_array_equal(compared.poses, np.tile(np.eye(4), (4, 1, 1)))
    assert (compared.trust == 1).all()
    assert compared.otherwise == {}


def test_the_sum_is_that_of_a_loop() -> None:
    rng, links = (
        np.random.default_rng(0),
        [Association((0, 1), (1, 0), 0.8), Association((0, 0), (2, 1), 0.6), Association((0, 2), (2, 0), 1.0)],
    )
    trust, others = rng.uniform(size=(3, 3)), {(0, 1): rng.uniform(size=(3, 2)), (0, 2): rng.uniform(size=(3, 2))}
    compared = replace(link_two(grow_blades(3, 1))[1], trust=trust, otherwise=others)
    found = sum_over_poses(links, compared)
    for link, summed in zip(links, found, strict=True):
        (earlier, row), (later, column) = link.before, link.after
        expected = 0.0
        for weight, chance in ((trust[earlier, later], link.probability),
                               (1 - trust[earlier, later], others[earlier, later][row, column])):  # fmt: skip
            expected += weight * chance
        assert summed.probability == pytest.approx(expected)
    assert sum_over_poses(links, replace(compared, trust=np.ones((3, 3)))) == links
    alone = sum_over_poses(links, replace(compared, otherwise={}))
    assert [link.probability for link in alone] == pytest.approx([trust[0, 1] * 0.8, trust[0, 2] * 0.6, trust[0, 2]])


def test_what_a_person_says_holds_under_every_pose() -> None:
    said = Association((0, 0), (1, 0), 1.0, is_asked=True)
    compared = replace(link_two(grow_blades(3, 1))[1], trust=np.zeros((2, 2)))
    assert sum_over_poses([said], compared) == [said]
