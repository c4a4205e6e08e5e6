"""The table of masks: everything that is known of a mask moves together."""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Any

import numpy as np
import pytest
import torch

from blade_scene import ring_cameras
from matched import matched
from mvseg.crop import Crop
from mvseg.errors import InputError
from mvseg.masks import Masks, Origin, replace_crops
from mvseg.matching.result import Matching, MatchReport
from mvseg.reconstruction.surface.mask_stack import MaskStack, stack_masks
from mvseg.regions import regions_from_label_maps
from mvseg.table import Table


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


def stack() -> MaskStack:
    """Masks of one leaf in five views."""
    masks = [np.pad(np.ones((12, 12 + view), bool), 6) for view in range(5)]
    others = [0 * mask.astype(np.int32) for mask in masks]
    return stack_masks(masks, others, range(5), px_from_world=np.tile(np.eye(3, 4), (5, 1, 1)))


def same(one: Table, other: Table) -> bool:
    pairs = [(getattr(one, each.name), getattr(other, each.name)) for each in fields(one)]
    return all(same(a, b) if isinstance(a, Table) else np.array_equal(np.asarray(a), np.asarray(b)) for a, b in pairs)


UNMATCHED = replace(table(), instance_ids=torch.full((5,), -1))


@pytest.mark.parametrize("rows", [UNMATCHED, UNMATCHED.regions, ring_cameras(5), stack()], ids=lambda each: type(each))
def test_the_columns_of_all_tables_move_together(rows: Table) -> None:
    index: Any = np.array if isinstance(rows, MaskStack) else torch.tensor
    order = index([3, 0, 4, 1, 2])
    assert not same(rows.select(order), rows)
    assert same(rows.select(order).select(order.argsort()), rows)
    assert same(rows.select(order >= 0), rows)
    with pytest.raises(InputError, match="a bool index of 4 for 5 rows, expected one per row"):
        rows.select(order[:4] >= 0)
    with pytest.raises(IndexError):
        rows.select(index([5]))
    if not isinstance(rows, MaskStack):  # these are padded, see `join_stacks`
        joined = rows.concatenate([rows, rows.select(order)])
        assert same(joined.select(order), rows.select(order))
        assert same(joined.select(torch.arange(5, 10)), rows.select(order).to("cpu"))


def test_concatenated_tables_share_no_instance_and_their_reports_are_joined() -> None:
    joined = Masks.concatenate([table(), table()])
    assert joined.instance_ids.tolist() == [2, 1, 2, -1, 3, 5, 4, 5, -1, 6]
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
    with pytest.raises(InputError, match=r"5 regions with columns of \[4, 5, 5, 5, 5, 5, 5\] rows"):
        replace(table(), instance_ids=torch.ones(4, dtype=torch.int64))
