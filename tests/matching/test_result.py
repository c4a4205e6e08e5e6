"""The Matching carrier: everything that is known of regions and instances moves together."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from mvseg.errors import InputError
from mvseg.matching.result import Matching, MergedMask, count_sure_views

PART = torch.tensor([[True, False]])


def matching() -> Matching:
    """Five regions, three instances; region 2 also shows instance 3."""
    return Matching(
        instance_ids=torch.tensor([2, 1, 2, -1, 3]),
        match_scores=torch.tensor([0.9, 0.8, 0.4, 0.0, 0.6]),
        num_instances=3,
        method="nview",
        support=torch.tensor([1, 1, 1]),
        merged=(MergedMask(region=2, own=2, other=3, part=PART),),
        residual_px=1,
        explained=0.8,
        view_explained=torch.tensor([0.7, float("nan")]),
    )


def merged_of(matching: Matching) -> list[tuple[int, int, int]]:
    assert all(mask.part is PART for mask in matching.merged)
    return [(mask.region, mask.own, mask.other) for mask in matching.merged]


def same(first: Matching, second: Matching) -> bool:
    assert first.support is not None
    assert second.support is not None
    return (
        torch.equal(first.instance_ids, second.instance_ids)
        and torch.equal(first.match_scores, second.match_scores)
        and torch.equal(first.support, second.support)
        and merged_of(first) == merged_of(second)
        and (first.num_instances, first.residual_px) == (second.num_instances, second.residual_px)
    )


def test_selected_regions_keep_what_is_known_of_them() -> None:
    chosen = matching().select(torch.tensor([4, 2]))
    assert chosen.instance_ids.tolist() == [3, 2]
    assert chosen.match_scores.tolist() == pytest.approx([0.6, 0.4])
    assert merged_of(chosen) == [(1, 2, 3)]
    assert chosen.num_instances == 3
    assert matching().select(torch.tensor([0])).merged == ()
    assert merged_of(matching().select(torch.tensor([2, 0, 2]))) == [(0, 2, 3), (2, 2, 3)]


def test_reordering_is_the_inverse_of_selecting() -> None:
    order = torch.tensor([3, 0, 4, 1, 2])
    assert same(matching().select(order).reorder(order), matching())
    assert matching().reorder(order).instance_ids.tolist() == [1, -1, 3, 2, 2]


def test_relabelling_moves_ids_support_and_merged_masks() -> None:
    support = torch.tensor([10, 20, 30])
    before = Matching(**{**vars(matching()), "support": support})
    after = before.relabel(torch.tensor([3, 1, 2]))
    assert after.instance_ids.tolist() == [1, 3, 1, -1, 2]
    assert after.support is not None
    assert after.support.tolist() == [20, 30, 10]
    assert merged_of(after) == [(2, 1, 2)]
    assert same(after.relabel(torch.tensor([2, 3, 1])), before)


def test_a_discarded_instance_leaves_nothing_behind() -> None:
    after = matching().relabel(torch.tensor([2, 1, -1]))
    assert after.instance_ids.tolist() == [1, 2, 1, -1, -1]
    assert after.match_scores.tolist() == pytest.approx([0.9, 0.8, 0.4, 0, 0])
    assert after.num_instances == 2
    assert after.support is not None
    assert after.support.shape == (2,)
    assert after.merged == ()


@pytest.mark.parametrize("numbers", [[1, 2], [1, 1, 2], [0, 1, 2], [2, 3, 4]])
def test_other_numbers_are_refused(numbers: list[int]) -> None:
    with pytest.raises(InputError, match="3 instances get the numbers"):
        matching().relabel(torch.tensor(numbers))


def test_concatenated_matchings_share_no_instance() -> None:
    joined = Matching.concatenate([matching(), matching()])
    assert joined.instance_ids.tolist() == [2, 1, 2, -1, 3, 5, 4, 5, -1, 6]
    assert joined.num_instances == 6
    assert merged_of(joined) == [(2, 2, 3), (7, 5, 6)]
    assert joined.support is not None
    assert joined.support.tolist() == [1] * 6
    assert joined.explained == pytest.approx(0.8)
    other = replace(matching(), view_explained=torch.tensor([0.5, 0.6]))
    joined = Matching.concatenate([matching(), other])
    assert joined.view_explained is not None
    assert joined.view_explained.tolist() == pytest.approx([0.6, 0.6])
    plain = Matching(torch.tensor([1, -1]), torch.zeros(2), num_instances=1, method="symnmf")
    mixed = Matching.concatenate([plain, matching()])
    assert mixed.support is None
    assert mixed.residual_px is None
    assert mixed.explained is None
    assert mixed.view_explained is None
    assert same(Matching.concatenate([matching()]), matching())


def test_sure_views_are_counted_once_each() -> None:
    assert count_sure_views(matching(), torch.tensor([0, 0, 1, 1, 2])).tolist() == [1, 1, 1]
    two = Matching(torch.tensor([1, 1, 1]), torch.tensor([0.9, 0.5, 0.7]), num_instances=1, method="nview")
    assert count_sure_views(two, torch.tensor([0, 0, 3])).tolist() == [2]
    empty = Matching(torch.zeros(0, dtype=torch.int64), torch.zeros(0), num_instances=0, method="nview")
    assert count_sure_views(empty, torch.zeros(0, dtype=torch.int64)).tolist() == []
