from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from known_leaves import bent_blade, move, turn_about
from mvseg.reconstruction.stem.leaf_bases import axes_of_bases
from mvseg.results.stem_shapes import PETIOLE_COLOR, STEM_COLOR, continue_below, stem_parts
from mvseg.traits.nodes import Stem, measure_stem

UP = np.array([0.0, 0.0, 1.0])


@pytest.fixture(scope="module")
def stem() -> Stem:
    leaves = {}
    for n in range(5):
        leaf = move(bent_blade(), turn_about(UP, 137.5 * n), shift=(0, 0, 20.0 * n))
        leaves[n + 1] = move(leaf, np.eye(3), shift=tuple(leaf.midrib[5].numpy() * [1, 1, 0]))
    (axis,) = axes_of_bases(leaves, UP)
    return measure_stem(axis.axis, axis.bases, frame=None, source="leaf bases")


def test_a_stem_and_its_petioles_are_tubes_with_names_of_their_own(stem: Stem) -> None:
    trunk, *petioles = stem_parts(stem)
    assert (trunk.name, trunk.leaf, trunk.color) == ("stem_1", None, STEM_COLOR)
    assert {part.name for part in petioles} == {f"petiole_{part.leaf:03d}" for part in petioles}
    assert len(petioles) >= 3
    for part in petioles:
        node = next(each for each in stem.nodes if each.leaf == part.leaf)
        assert part.color == PETIOLE_COLOR
        assert part.points.tolist() == [list(node.place), list(node.base)]
    height = np.array([node.place for node in stem.nodes])[:, 2]
    short = replace(stem, axis=replace(stem.axis, points=stem.axis.points[10:20], radius=stem.axis.radius[10:20]))
    whole = next(stem_parts(short))  # no leaf floats beyond its ends
    assert [whole.points[0, 2], whole.points[-1, 2]] == [height.min(), height.max()]
    (below,) = continue_below(whole, [*(whole.points[[0, -1]] - [30.0, 0, 7.0])])  # the middles of two leaves
    assert (below.is_guessed, whole.points[0, 2] - below.points[0, 2]) == (True, pytest.approx(7, abs=0.5))
    assert not continue_below(whole, [*whole.points])
    for part in (whole, trunk, *petioles):
        assert part.mesh().is_volume


def test_a_radius_that_is_known_is_drawn(stem: Stem) -> None:
    thick = replace(stem, axis=replace(stem.axis, radius=np.full(len(stem.axis.points), 4.0)))
    (trunk, *_) = stem_parts(thick)
    assert trunk.radius == pytest.approx(4.0)
    assert trunk.mesh().volume == pytest.approx(np.pi * 16 * stem.axis.length, rel=0.08)
