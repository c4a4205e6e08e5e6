"""A link between two halves of a leaf, and between two leaves."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from blade_scene import as_regions
from known_leaves import flat_leaf
from mvseg.corrections.corrected import Corrected
from mvseg.corrections.linked_halves import link_halves
from mvseg.masks import Masks
from mvseg.matching.links import Links
from three_leaves import CAMERAS, LEAVES, halved_maps, true_maps

ALL = tuple(range(len(CAMERAS)))


Pair = tuple[int, int]


def link(maps: list[np.ndarray], pair: Pair, views: Pair, **links: list[Pair]) -> Corrected:
    """What follows from "same" between the masks of two labels in two views."""
    regions, ids = as_regions(maps)
    first, second = (
        int(((ids == label) & (regions.view_index == view)).nonzero()) for label, view in zip(pair, views, strict=True)
    )
    edited = Corrected(Masks.of(regions), Links.of([(first, second)], **links), torch.zeros(len(ids)), (), (), ())
    return link_halves(edited, ids, CAMERAS)


@pytest.mark.parametrize("views", [(0, 0), (1, 4)])
def test_halves_are_linked_in_all_photos_that_show_both(views: tuple[int, int]) -> None:
    """One photo shows them whole, and in one only one half has a mask."""
    maps = halved_maps((0, 1, 2, 4))
    maps[3] = true_maps()[3]
    linked = link(maps, (1, 11), views)
    _, ids = as_regions(maps)
    named = torch.zeros(len(ids), dtype=torch.bool)
    named[linked.links.must.flatten()] = True
    in_both = torch.isin(linked.masks.view_index, torch.tensor([0, 1, 2, 4]))
    assert torch.equal(named, torch.isin(ids, torch.tensor([1, 11])) & in_both)
    component = linked.links.components(len(ids))
    for view in (0, 1, 2, 4):
        here = (linked.masks.view_index == view).numpy()
        one, other = component[here & (ids == 1).numpy()], component[here & (ids == 11).numpy()]
        assert one == other
    assert int(linked.masks.is_linked.sum()) >= 6  # and nothing else takes them away


def test_a_link_between_two_leaves_or_what_is_kept_apart_is_about_one_mask() -> None:
    leaves = {1: LEAVES[1], 2: LEAVES[2], 3: flat_leaf(length=0.9, half_width=0.2, at=(0.75, -0.3, 0.4))}
    linked = link(true_maps(leaves), (1, 3), (0, 2))
    assert len(linked.links.must) == 1
    assert not linked.masks.is_linked.any()
    maps = halved_maps(ALL)
    regions, ids = as_regions(maps)
    here = regions.view_index == 3
    apart = tuple(int((here & (ids == each)).nonzero()) for each in (1, 11))
    linked = link(maps, (1, 11), (0, 0), cannot=[apart])
    assert len(linked.links.must) == 1
