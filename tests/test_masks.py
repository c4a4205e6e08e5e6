"""The table of masks: everything that is known of a mask moves together."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from matched import matched
from mvseg.crop import Crop
from mvseg.errors import InputError
from mvseg.masks import Masks, Origin, replace_crops
from mvseg.matching.result import Matching, MatchReport
from mvseg.regions import regions_from_label_maps


def table() -> Masks:
    """Five masks in three views, three instances."""
    labels = np.zeros((3, 6, 9), np.int64)
    labels[0, 1, 0:2], labels[0, 3, 3:5], labels[1, 1, 0:2], labels[1, 3, 3:5], labels[2, 2:4, 2:4] = 1, 2, 1, 2, 1
    return Masks.of(
        regions_from_label_maps(list(labels)),
        torch.tensor([2, 1, 2, -1, 3]),
        torch.tensor([0.9, 0.8, 0.4, 0.0, 0.6]),
        detection_scores=torch.tensor([0.1, 0.2, 0.3, 0.4, 0.5]),
        classes=torch.tensor([1, 2, 1, 1, 1]),
        origin=Origin.DETECTED,
    )


def same(first: Masks, second: Masks) -> bool:
    names = ("instance_ids", "match_scores", "detection_scores", "classes", "origin")
    columns = all(torch.equal(getattr(first, name), getattr(second, name)) for name in names)
    return columns and torch.equal(first.regions.crops, second.regions.crops)


def test_selected_rows_keep_what_is_known_of_them() -> None:
    chosen = table().select(torch.tensor([4, 2]))
    assert chosen.instance_ids.tolist() == [3, 2]
    assert chosen.match_scores.tolist() == pytest.approx([0.6, 0.4])
    assert chosen.view_index.tolist() == [2, 1]
    assert same(table().select(table().match_scores >= 0), table())


def test_a_permutation_and_its_inverse_are_nothing() -> None:
    order = torch.tensor([3, 0, 4, 1, 2])
    assert same(table().select(order).select(order.argsort()), table())


def test_concatenated_tables_share_no_instance() -> None:
    joined = Masks.concatenate([table(), table()])
    assert joined.instance_ids.tolist() == [2, 1, 2, -1, 3, 5, 4, 5, -1, 6]
    assert same(Masks.concatenate([table()]), table())


def test_reports_are_joined() -> None:
    plain = MatchReport("symnmf")
    full = MatchReport("nview", True, residual_px=1, explained=0.8, view_explained=torch.tensor([0.7, float("nan")]))
    other = replace(full, residual_px=2, explained=0.4, view_explained=torch.tensor([0.5, 0.6]))
    joined = MatchReport.join([full, other], [3, 1])
    assert (joined.method, joined.has_probabilities, joined.residual_px) == ("nview", True, 2)
    assert joined.explained == pytest.approx(0.7)
    assert joined.view_explained is not None
    assert joined.view_explained.tolist() == pytest.approx([0.6, 0.6])
    mixed = MatchReport.join([plain, full], [1, 1])
    assert (mixed.has_probabilities, mixed.residual_px, mixed.explained, mixed.view_explained) == (False, *[None] * 3)


def test_sure_views_are_counted_once_each() -> None:
    assert table().count_sure_views().tolist() == [1, 1, 1]
    assert replace(table(), instance_ids=torch.tensor([1, 1, 1, -1, 1])).count_sure_views().tolist() == [2]
    assert Matching(table(), MatchReport("symnmf")).support is None
    assert matched(table().regions).support is not None


def test_new_pixels_keep_all_else() -> None:
    masks = table()
    boxes = [(x1, y1, x1 + 1, y1 + 1) for x1, y1, _, _ in masks.regions.boxes.tolist()]
    cut = replace_crops(masks, [Crop(box, torch.ones(1, 1, dtype=torch.bool)) for box in boxes])
    assert cut.regions.areas.tolist() == [1] * 5
    assert torch.equal(cut.instance_ids, masks.instance_ids)
    assert torch.equal(cut.view_index, masks.view_index)


def test_columns_have_a_row_for_every_region() -> None:
    with pytest.raises(InputError, match=r"5 regions with columns of \[4, 5, 5, 5, 5, 5, 5\] rows"):
        replace(table(), instance_ids=torch.ones(4, dtype=torch.int64))
