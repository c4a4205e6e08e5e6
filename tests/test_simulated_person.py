"""The person of `benchmarks/corrections.py`: names what is wrong in a result, and edits that mend it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from benchmarks.corrections import judge, print_table, read_records, write_records
from benchmarks.learned_corrections import correct_photos
from benchmarks.masks_alone import change_masks_alone
from benchmarks.simulated_person import (
    Labels,
    Look,
    Repair,
    choose_repairs,
    count_worth,
    cut_line,
    list_answers,
    list_repairs,
)
from mvseg.corrections.apply import apply
from mvseg.corrections.doubtful import Doubt, Outlines
from mvseg.corrections.file import Corrections, Edit, Reject
from mvseg.masks import Masks
from mvseg.regions import regions_from_label_maps
from mvseg.scene import Scene, View
from three_leaves import CAMERAS

WIDTH, HEIGHT = CAMERAS.sizes[0].tolist()


@pytest.fixture
def truth() -> list[Labels]:
    """Leaves 1, 2 and 3 beside each other in every view, 20 x 40 pixels each; 2 and 3 touch."""
    labels = np.zeros((HEIGHT, WIDTH), np.uint16)
    for leaf, left in ((1, 10), (2, 40), (3, 60)):
        labels[10:50, left : left + 20] = leaf
    return [labels] * len(CAMERAS)


@pytest.fixture
def scene() -> Scene:
    views = tuple(View(f"v{view}", Path(f"v{view}.png")) for view in range(len(CAMERAS)))
    return Scene(name="plant", views=views, cameras=CAMERAS, unit="mm", up=None)


def masks_of(labels: list[Labels], ids: dict[int, int] | None = None) -> Masks:
    """Masks of label maps, whose instances are the labels, or `ids` of them."""
    regions = regions_from_label_maps(labels)
    return Masks.of(regions, torch.tensor([(ids or {}).get(label, label) for label in regions.labels.tolist()]))


def repairs_of(masks: Masks, truth: list[Labels], scene: Scene, doubts: tuple[Doubt, ...] = ()) -> list[Repair]:
    return choose_repairs(list_repairs(Look(masks, truth, scene, doubts)), order="repair", worth=(9, 9), done=())


def mend(masks: Masks, truth: list[Labels], scene: Scene) -> tuple[list[str], Masks]:
    """What the person does in one round, and the masks alone afterwards."""
    edits: tuple[Edit, ...] = ()
    for each in repairs_of(masks, truth, scene):
        edits += each.edits
    changed = apply(Corrections(edits), masks, scene)
    assert {fate.fate for fate in changed.fates} <= {"applied"}
    return [edit.op for edit in edits], change_masks_alone(masks, edits, scene)


def test_nothing_is_wrong_with_the_truth(truth: list[Labels], scene: Scene) -> None:
    ops, after = mend(masks_of(truth), truth, scene)
    assert ops == []
    assert judge(after, truth) == {"ari": 1, "pair_f1": 1, "mv_pq": 1, "right": 1}


def test_a_mask_of_another_leaf_goes_home(truth: list[Labels], scene: Scene) -> None:
    masks = masks_of(truth)
    ids = masks.instance_ids.clone()
    ids[(masks.view_index == 1) & (ids == 1)] = 2
    ops, after = mend(replace(masks, instance_ids=ids), truth, scene)
    assert ops == ["same"]
    assert judge(after, truth)["mv_pq"] == 1


def test_two_leaves_of_one_id_part(truth: list[Labels], scene: Scene) -> None:
    ops, after = mend(masks_of(truth, {2: 1}), truth, scene)
    assert set(ops) == {"different"}
    assert judge(after, truth)["mv_pq"] > judge(masks_of(truth, {2: 1}), truth)["mv_pq"]


def test_what_is_no_leaf_goes_and_what_was_missed_is_drawn_in_two_photos(truth: list[Labels], scene: Scene) -> None:
    found = [labels.copy() for labels in truth]
    for labels in found:
        labels[labels == 1] = 0
        labels[60:80, 10:50] = 9
    ops, after = mend(masks_of(found), truth, scene)
    assert sorted(ops) == ["outline", "outline", "reject"]
    assert judge(after, truth)["ari"] == 1
    drawn = (after.instance_ids == after.instance_ids[after.is_corrected][0]) & after.is_corrected
    assert int(drawn.sum()) == 2  # and in the other photos nothing, where masks alone are changed


def test_a_mask_of_two_leaves_is_cut_between_them(truth: list[Labels], scene: Scene) -> None:
    line = cut_line(truth[0], 2, 3)
    np.testing.assert_allclose(line[:, 0], 60, atol=0.6)
    found = [truth[0].copy(), *truth[1:]]
    found[0][truth[0] == 3] = 2
    ops, after = mend(masks_of(found), truth, scene)
    assert ops == ["split"]
    ops, after = mend(after, truth, scene)
    assert ops == ["same"]  # the part that was cut off
    assert judge(after, truth)["mv_pq"] > 0.99


def test_a_missed_mask_is_drawn_and_joins_its_leaf(truth: list[Labels], scene: Scene) -> None:
    found = [truth[0].copy(), *truth[1:]]
    found[0][truth[0] == 3] = 0
    ops, after = mend(masks_of(found), truth, scene)
    assert ops == ["outline", "same"]
    assert judge(after, truth)["mv_pq"] > 0.99


def test_a_leaf_that_is_nearly_lost_is_drawn_anew(truth: list[Labels], scene: Scene) -> None:
    found = [labels.copy() for labels in truth]
    for labels in found[1:]:
        labels[labels == 1] = 0
    ops, _ = mend(masks_of(found), truth, scene)
    assert ops == ["outline", "outline"]


def test_only_the_photos_that_are_named_are_corrected(truth: list[Labels], scene: Scene) -> None:
    found = [labels.copy() for labels in truth]
    for labels in found[:3]:
        labels[60:80, 10:50] = 9
        labels[labels == 3] = 0
    edits = correct_photos(masks_of(found), truth, scene=scene, names={"v0", "v2"})
    assert {edit.view for edit in edits} == {"v0", "v2"}
    assert {edit.op for edit in edits} == {"outline", "reject"}


SQUARE = np.array([[10.0, 10], [30, 10], [30, 50], [10, 50]])  # leaf 1
EMPTY = SQUARE + (90, 0)


def answer(doubt: Doubt, masks: Masks, truth: list[Labels], scene: Scene) -> list[Edit]:
    return [edit for each in list_answers(Look(masks, truth, scene, [doubt])) for edit in each.edits]


def test_questions_get_true_answers(truth: list[Labels], scene: Scene) -> None:
    masks = masks_of(truth)
    one, two = ((masks.instance_ids == leaf).nonzero()[:, 0].tolist() for leaf in (1, 2))

    def ops(kind: str, region: int = -1, other: int = -1, instance: int = 1, outlines: Outlines = ()) -> list[str]:
        doubt = Doubt(kind, 0.5, 0, instance, region=region, other=other, outlines=outlines)  # type: ignore[arg-type]
        said = answer(doubt, masks, truth, scene)
        return [f"{edit.op}{' everywhere' * getattr(edit, 'everywhere', False)}" for edit in said]

    assert ops("match", one[0], one[1]) == ["same"]
    assert ops("surface", two[0], one[1]) == ["different"]
    assert ops("covered", two[0], one[1]) == ["different"]
    assert ops("match", one[0]) == ["confirm"]
    assert ops("few", one[0]) == ["confirm everywhere"]
    assert ops("missing", other=one[1], outlines=((0, SQUARE),)) == ["outline", "same"]
    assert ops("missing", other=one[1], outlines=((0, EMPTY),)) == ["reject"]
    assert ops("leaf", instance=-1, outlines=((0, EMPTY), (1, EMPTY))) == ["reject everywhere"]
    assert ops("leaf", instance=-1, outlines=((0, SQUARE), (1, SQUARE))) == []  # it has a number already
    masks = masks_of(truth, {1: -1})
    assert ops("leaf", instance=-1, outlines=((0, SQUARE), (1, SQUARE))) == ["outline", "outline"]
    masks = masks_of([np.roll(labels, 60, 0) for labels in truth])  # no mask shows a leaf
    assert ops("match", one[0], one[1]) == ["reject"]
    assert ops("few", one[0]) == ["reject everywhere"]


def test_what_was_answered_is_not_asked_again_and_an_answer_costs_one(truth: list[Labels], scene: Scene) -> None:
    masks = masks_of(truth, {1: -1})
    doubt = Doubt("leaf", 0.5, 0, -1, outlines=((0, SQUARE), (1, SQUARE)))
    (said,) = list_answers(Look(masks, truth, scene, [doubt]))
    assert said.cost == 1
    edits = [edit.model_copy(update={"by": said.name}) for edit in said.edits]
    assert count_worth(edits) == 1
    assert count_worth(said.edits) == 6  # drawn by hand
    assert list_answers(Look(masks, truth, scene, [doubt]), edits) == []
    assert list_answers(Look(masks, truth, scene, [doubt]), [Reject(view="v1", at=(20, 20))]) == []
    assert list_answers(Look(masks, truth, scene, [doubt]), [Reject(view="v2", at=(20, 20))]) == [said]


def test_the_order_and_the_worth_of_repairs() -> None:
    edit = Reject(view="v0", at=(1, 1))
    small = Repair("small", (edit,), gain=0.1, doubt=0.9, leaves=frozenset({1}))
    large = Repair("large", (edit, edit), gain=0.9, doubt=0.2, leaves=frozenset({2}))
    same_leaf = Repair("same leaf", (edit,), gain=0.05, doubt=0.1, leaves=frozenset({2}))
    found = [small, large, same_leaf]
    assert count_worth(large.edits) == 2
    assert choose_repairs(found, order="repair", worth=(9, 9), done=()) == [large, small]
    assert choose_repairs(found, order="ask", worth=(9, 9), done=()) == [small, large]
    assert choose_repairs(found, order="repair", worth=(1, 1), done=()) == [small]
    assert choose_repairs(found, order="repair", worth=(1, 2), done={"small"}) == [large]


def test_records_are_read_as_they_were_written(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    values = {f"{of}{name}": 0.5 for of in ("", "alone_") for name in ("ari", "pair_f1", "mv_pq", "right")}
    about = {"scene": "degraded_a", "order": "repair", "leaves": 8.0, "seconds": 1.0, "edits": 3.0, "harmed": 1.0}
    records = [about | {"worth": 0.0} | values, about | {"worth": 4.0} | values | {"right": 1.0}]
    write_records(tmp_path / "a.csv", records)
    assert read_records(tmp_path / "a.csv") == records
    print_table([records])
    said = capsys.readouterr().out
    assert "right with edits worth 4 of 8; 2 leaves harmed by 3 edits" in said
