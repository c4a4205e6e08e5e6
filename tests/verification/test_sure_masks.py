"""What counts as confirmed: against a loop over masks, and at the edges."""

from __future__ import annotations

import pytest
import torch

from mvseg.matching.result import Matching
from mvseg.regions import Regions, stack_regions
from mvseg.verification.sure_masks import confirmed_masks


def dots(view_index: list[int], num_views: int) -> Regions:
    count = len(view_index)
    crops = [torch.ones(1, dtype=torch.bool)] * count
    boxes = [(number, 0, number + 1, 1) for number in range(count)]
    return stack_regions(view_index, boxes, crops, labels=range(count), num_views=num_views)


def matched(ids: list[int], scores: list[float]) -> Matching:
    return Matching(
        instance_ids=torch.tensor(ids, dtype=torch.int64),
        match_scores=torch.tensor(scores),
        num_instances=max([0, *ids]),
        method="nview",
    )


def confirmed_masks_reference(
    views: list[int], ids: list[int], scores: list[float], *, least: float, num_views: int
) -> list[bool]:
    """One mask at a time."""
    answers = []
    for own, score in zip(ids, scores, strict=True):
        sure = {view for view, other, s in zip(views, ids, scores, strict=True) if other == own and s >= 0.5}
        answers.append(own > 0 and score >= least and len(sure) >= num_views)
    return answers


@pytest.mark.parametrize("seed", range(5))
def test_as_one_at_a_time(seed: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    views = torch.randint(6, (80,), generator=generator).sort()[0].tolist()
    numbers = torch.randint(6, (80,), generator=generator).tolist()
    ids = [number or -1 for number in numbers]
    scores = [0.0 if own < 0 else float(torch.rand((), generator=generator)) for own in ids]
    for least, num_views in ((0.5, 4), (0.2, 2), (0.7, 3)):
        answer = confirmed_masks(dots(views, 6), matched(ids, scores), min_match_score=least, min_views=num_views)
        expected = confirmed_masks_reference(views, ids, scores, least=least, num_views=num_views)
        assert answer.tolist() == expected
        assert 0 < sum(expected) < 80


def test_all_views_are_enough_where_there_are_few() -> None:
    regions, matching = dots([0, 1, 2, 0, 1], 3), matched([1, 1, 1, 2, 2], [0.9] * 5)
    answer = confirmed_masks(regions, matching, min_match_score=0.5, min_views=4)
    assert answer.tolist() == [True, True, True, False, False]


def test_without_masks() -> None:
    assert confirmed_masks(dots([], 3), matched([], []), min_match_score=0.5, min_views=4).tolist() == []
