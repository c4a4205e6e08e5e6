"""Which leaves edits leave as they were."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from blade_scene import as_regions
from mvseg.corrections.corrected import Corrected, Whole
from mvseg.masks import Masks, Origin
from mvseg.matching.links import Links
from mvseg.pipeline.apply_edits import leave_joined, unchanged_leaves
from three_leaves import true_maps

REGIONS, IDS = as_regions(true_maps())
BEFORE = Masks.of(REGIONS, IDS, origin=Origin.DETECTED)
ONE, TWO, THREE = ((leaf == IDS).nonzero()[:, 0].tolist() for leaf in (1, 2, 3))


NAMED = replace(BEFORE, is_linked=torch.ones(len(IDS), dtype=torch.bool))
WITHOUT = replace(BEFORE, instance_ids=IDS.where(torch.arange(len(IDS)) != ONE[0], -1))


def stay(masks: Masks = NAMED, before: Masks = BEFORE, *, whole: tuple[Whole, ...] = (), **links: object) -> list[int]:
    said = Links.of(**links)  # type: ignore[arg-type]
    edited = Corrected(masks, said, torch.zeros(len(masks)), whole, (), ())
    return unchanged_leaves(edited, before.instance_ids[masks.proposal], before).tolist()


def test_what_says_what_is_seen_changes_no_leaf() -> None:
    assert stay() == [1, 2, 3]
    assert stay(must=[(ONE[0], ONE[2])], cannot=[(ONE[1], TWO[1])], whole=(Whole(1, THREE[0], False),)) == [1, 2, 3]
    assert stay(replace(BEFORE, is_linked=torch.arange(len(IDS)) == TWO[1])) == [2]


@pytest.mark.parametrize(
    ("said", "left"),
    [
        ({"must": [(ONE[0], TWO[2])]}, [3]),
        ({"cannot": [(ONE[0], ONE[2])]}, [2, 3]),
        ({"whole": (Whole(1, TWO[0], True),)}, [1, 3]),
        ({"masks": NAMED.select(torch.arange(len(IDS)) != THREE[1])}, [1, 2]),
        ({"before": WITHOUT}, [1, 2, 3]),
        ({"before": WITHOUT, "must": [(ONE[0], ONE[1])]}, [2, 3]),
    ],
)
def test_a_leaf_that_an_edit_changes_is_found_anew(said: dict[str, object], left: list[int]) -> None:
    assert stay(**said) == left  # type: ignore[arg-type]


def test_masks_that_join_a_leaf_change_it() -> None:
    """Of four leaves of two masks, all masks of 1, one of 2, and none of 3 are matched to a new mask; 4 is not seen."""
    seen = torch.tensor([1, 1, 2, 2, 3, 3, -1, -1, -1])
    matched = torch.tensor([7, 7, 7, 5, 5, 5, 5, 4, 7])
    is_held = torch.arange(9) == 8
    assert leave_joined(seen, matched, is_held).tolist() == [-1, -1, -1, -1, 3, 3, -1, -1, -1]
    assert leave_joined(seen, matched, is_held & (matched != 7)).tolist() == seen.tolist()
    assert leave_joined(seen, matched.where(~is_held, -1), is_held).tolist() == seen.tolist()
    order = torch.randperm(9, generator=torch.Generator().manual_seed(0))
    assert leave_joined(seen[order], matched[order], is_held[order]).tolist() == [
        leave_joined(seen, matched, is_held)[n] for n in order
    ]
    assert len(leave_joined(seen[:0], matched[:0], is_held[:0])) == 0
