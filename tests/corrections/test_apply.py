"""Edits on masks made by hand: squares in two views."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from mvseg.config import RunConfig
from mvseg.corrections.apply import apply, read_stem_marks
from mvseg.corrections.corrected import Corrected, apply_everywhere
from mvseg.corrections.file import FORMAT, parse_corrections
from mvseg.findings.finding import Finding
from mvseg.formats.lens import distort, opencv_lens, undistort
from mvseg.formats.photos import Photos
from mvseg.masks import Masks, Origin
from mvseg.pipeline.finish import settle_edits
from mvseg.pipeline.open_scene import Opened
from mvseg.pipeline.plant import match_given
from mvseg.regions import regions_from_label_maps
from mvseg.scene import Scene, View
from mvseg.verification.choose import RejectedCandidate
from synthetic import cameras_at

WIDTH, HEIGHT = 60, 40
CAMERAS = cameras_at(torch.tensor([[10.0, 0, 0], [0, 10.0, 0]]), focal=60.0, width=WIDTH, height=HEIGHT)
SCENE = Scene("two", (View("a", Path("x/a.png")), View("b", Path("x/b.jpg"))), CAMERAS)


def label_map(*squares: tuple[int, int, int, int]) -> np.ndarray:
    labels = np.zeros((HEIGHT, WIDTH), np.int64)
    for number, (x1, y1, x2, y2) in enumerate(squares, start=1):
        labels[y1:y2, x1:x2] = number
    return labels


LEFT, RIGHT = (10, 10, 20, 20), (30, 10, 40, 20)
MAPS = [label_map(LEFT, RIGHT), label_map(LEFT, RIGHT)]
MASKS = Masks.of(regions_from_label_maps(MAPS), detection_scores=torch.full((4,), 0.9), origin=Origin.DETECTED)


def correct(*edits: dict[str, Any], masks: Masks = MASKS, scene: Scene = SCENE) -> Corrected:
    return apply(parse_corrections({"format": FORMAT, "edits": list(edits)}), masks, scene)


def findings_of(corrected: Corrected) -> list[Finding]:
    """Of the edits that were not applied, or are odd."""
    return [each.finding for each in corrected.fates if each.finding is not None]


def fates(corrected: Corrected) -> list[str]:
    return [each.fate for each in corrected.fates]


def square(x1: float, y1: float, x2: float, y2: float, view: str = "a", **more: Any) -> dict[str, Any]:
    return {"op": "outline", "view": view, "polygon": [[x1, y1], [x2, y1], [x2, y2], [x1, y2]], **more}


def at(op: str, x: float, y: float, view: str = "a", **more: Any) -> dict[str, Any]:
    return {"op": op, "view": view, "at": [x, y], **more}


def link(op: str, *places: tuple[str, float, float]) -> dict[str, Any]:
    return {"op": op, "at": [list(place) for place in places]}


def test_an_edit_about_a_stem_changes_no_mask() -> None:
    edits = [*(at(op, 15, 15, stem=True) for op in ("reject", "confirm")), at("reject", 1, 1, "c", stem=True)]
    marks = read_stem_marks(parse_corrections({"format": FORMAT, "edits": edits}), SCENE)
    assert marks == {1: (0, 15, 15, False), 2: (0, 15, 15, True), 3: None}
    corrected = correct(*edits)
    assert torch.equal(corrected.masks.regions.crops, MASKS.regions.crops)
    assert not corrected.masks.is_corrected.any()


def test_an_outline_replaces_what_it_covers_by_more_than_half() -> None:
    corrected = correct(square(9, 9, 35, 21))  # all of the left mask, half of the right one, which loses that half
    boxes = corrected.masks.regions.boxes[corrected.masks.view_index == 0].tolist()
    assert boxes == [[35, *RIGHT[1:]], [9, 9, 35, 21]]
    assert corrected.masks.origin.tolist() == [Origin.DETECTED, Origin.CORRECTED, Origin.DETECTED, Origin.DETECTED]
    assert corrected.masks.detection_scores[1].isnan()
    more = correct(square(9, 9, 36, 21))
    assert more.masks.regions.boxes[more.masks.view_index == 0].tolist() == [[9, 9, 36, 21]]


def test_a_click_on_an_outline_is_about_it_even_where_a_smaller_mask_lies_under_it() -> None:
    drawn = square(18, 8, 58, 38)  # a tenth of the left mask, all of the right one
    corrected = correct(drawn, at("reject", 19, 12), masks=MASKS)
    assert fates(corrected) == ["contradicted by edit 2", "applied"]
    assert corrected.masks.regions.boxes[corrected.masks.view_index == 0].tolist() == [[10, 10, 20, 20]]


def test_a_point_belongs_to_the_pixel_that_it_lies_in() -> None:
    assert fates(correct(at("reject", 19.99, 10.0))) == ["applied"]
    corrected = correct(at("reject", 20.0, 10.0), at("reject", 1, 1), at("reject", 12, 12, view="c"))
    assert fates(corrected) == ["points at nothing"] * 3
    why = "points at nothing: there is no mask at (20, 10) in view a"
    assert str(findings_of(corrected)[0]) == f"correction 1 (reject): {why}"
    assert len(corrected.masks) == 4


@pytest.mark.parametrize("name", ["b", "b.jpg", "x/b.jpg"])
def test_views_have_their_names_with_and_without_folder_and_suffix(name: str) -> None:
    assert correct(at("reject", 15, 15, view=name)).masks.view_index.tolist() == [0, 0, 1]


def test_a_cut_makes_two_masks_that_are_different() -> None:
    corrected = correct(at("split", 12, 15) | {"line": [[14, 12], [14, 18]]})  # goes on straight at its ends
    first, second = corrected.masks.regions.boxes[corrected.masks.origin == Origin.CUT].tolist()
    assert abs(first[2] - 14) <= 1  # the line is at 14
    assert [first, second] == [[10, 10, first[2], 20], [first[2], 10, 20, 20]]
    assert corrected.links.cannot.tolist() == [[1, 2]]
    assert int(corrected.masks.regions.areas.sum()) == 400
    assert fates(correct(at("split", 12, 15) | {"line": [[25, 12], [25, 18]]})) == ["points at nothing"]


def test_links_are_rows_of_the_masks_that_are_left() -> None:
    corrected = correct(
        at("reject", 15, 15),
        link("same", ("a", 35, 15), ("b", 35, 15)),
        link("different", ("b", 15, 15), ("b", 35, 15)),
        square(45, 30, 50, 35, leaf="word"),
        square(45, 30, 50, 35, view="b", leaf="word"),
        square(50, 2, 55, 5, view="b", leaf="other"),
    )
    assert fates(corrected) == ["applied"] * 6
    boxes = corrected.masks.regions.boxes.tolist()
    places = [(view, *box[:2]) for view, box in zip(corrected.masks.view_index.tolist(), boxes, strict=True)]
    must = {frozenset(places[row] for row in pair) for pair in corrected.links.must.tolist()}
    assert must == {frozenset({(0, 30, 10), (1, 30, 10)}), frozenset({(0, 45, 30), (1, 45, 30)})}
    assert {places[row] for row in corrected.links.cannot[0].tolist()} == {(1, 10, 10), (1, 30, 10)}


def test_a_later_edit_wins_and_the_earlier_one_says_so() -> None:
    same = link("same", ("a", 15, 15), ("b", 15, 15))
    different = link("different", ("b", 15, 15), ("a", 15, 15))
    for first, second, holds in ((same, different, "cannot"), (different, same, "must")):
        corrected = correct(first, second)
        assert fates(corrected) == ["contradicted by edit 2", "applied"]
        assert [len(corrected.links.must), len(corrected.links.cannot)] == [holds == "must", holds == "cannot"]
    assert fates(correct(square(9, 9, 21, 21), at("reject", 15, 15))) == ["contradicted by edit 2", "applied"]
    assert fates(correct(same, at("reject", 15, 15))) == ["contradicted by edit 2", "applied"]
    chain = correct(same, link("same", ("b", 15, 15), ("a", 35, 15)), link("different", ("a", 35, 15), ("a", 15, 15)))
    assert fates(chain) == ["contradicted by edit 3", "applied", "applied"]


def apply_known(*edits: dict[str, Any]) -> tuple[Masks, Corrected]:
    """Edits once the instances of the masks are known."""
    corrected = correct(*edits)
    ids = torch.tensor([1, 2, 1, 2])[: len(corrected.masks)]
    return apply_everywhere(corrected, Masks.of(corrected.masks.regions, ids, origin=Origin.DETECTED))


def test_whole_instances_once_they_are_known() -> None:
    def after(*edits: dict[str, Any]) -> Masks:
        return apply_known(*edits)[0]

    assert after(at("reject", 15, 15, everywhere=True)).regions.boxes.tolist() == [[*RIGHT], [*RIGHT]]
    assert after(at("reject", 15, 15, everywhere=True)).instance_ids.tolist() == [2, 2]
    confirmed = after(at("confirm", 15, 15, everywhere=True))
    assert confirmed.origin.tolist() == [Origin.CONFIRMED, Origin.DETECTED] * 2
    both = after(at("reject", 15, 15, everywhere=True), at("confirm", 15, 15, "b", everywhere=True))
    assert both.is_corrected.tolist() == [True, False, True, False]
    kept = after(at("reject", 15, 15, everywhere=True), at("confirm", 15, 15, "b"))
    assert kept.view_index.tolist() == [0, 1, 1]


def test_an_edit_of_a_whole_instance_says_which_earlier_ones_it_overrides() -> None:
    def told(*edits: dict[str, Any]) -> list[str]:
        return fates(apply_known(*edits)[1])

    everywhere = at("reject", 15, 15, everywhere=True)
    assert told(at("confirm", 15, 15, "b"), everywhere) == ["contradicted by edit 2", "applied"]
    assert told(everywhere, at("confirm", 15, 15, "b")) == ["applied", "applied"]
    assert told(everywhere, at("confirm", 15, 15, "b", everywhere=True)) == ["contradicted by edit 2", "applied"]
    assert told(at("confirm", 35, 15), everywhere) == ["applied", "applied"]
    assert told(at("confirm", 15, 15, "b"), everywhere, at("confirm", 15, 15, "b")) == ["applied"] * 3


def test_a_rejected_instance_may_be_drawn_anew() -> None:
    """The outline is another leaf: it does not bring the rejected one back."""
    drawn = square(*LEFT)
    corrected = correct(at("reject", 15, 15, everywhere=True), drawn, at("confirm", 15, 15))
    assert fates(corrected) == ["applied"] * 3
    known = Masks.of(corrected.masks.regions, torch.tensor([1, 2, 1, 1, 2]), origin=Origin.DETECTED)
    left, _ = apply_everywhere(corrected, replace(known, origin=corrected.masks.origin))
    assert left.view_index.tolist() == [0, 0, 1]
    assert left.origin.tolist() == [Origin.DETECTED, Origin.CORRECTED, Origin.DETECTED]


def test_points_are_of_the_photo_with_its_distortion() -> None:
    K = CAMERAS.K[0].numpy()
    lens = opencv_lens(K, [0.3, 0.1, 0, 0], width=WIDTH, height=HEIGHT)
    scene = Scene("bent", (View("a", Path("a.png"), lens), SCENE.views[1]), CAMERAS)
    photo = label_map((1, 1, 4, 4), LEFT).astype(np.uint16)
    masks = Masks.of(regions_from_label_maps([undistort(photo, lens, K), MAPS[1]]))
    corner = correct(at("reject", 2.5, 2.5), masks=masks, scene=scene)
    assert fates(corner) == ["applied"]
    assert corner.masks.regions.labels.tolist() == [2, 1, 2]
    drawn = correct(square(*LEFT), masks=masks, scene=scene).masks
    (row,) = drawn.is_corrected.nonzero()[:, 0].tolist()
    back = distort(drawn.regions.mask(row, WIDTH, HEIGHT).numpy().astype(np.uint8), lens, K)
    assert np.abs(back.astype(int) - (photo == 2)).sum() < 15  # of 100 pixels, along the edge


def test_a_scene_without_masks_takes_outlines() -> None:
    empty = Masks.of(regions_from_label_maps([np.zeros((HEIGHT, WIDTH), np.int64)] * 2))
    corrected = correct(square(5, 5, 9, 9), square(5, 5, 9, 9, view="b"), masks=empty)
    assert corrected.masks.view_index.tolist() == [0, 1]
    assert correct(at("reject", 5, 5), masks=empty).masks.view_index.tolist() == []


@pytest.mark.parametrize("everywhere", [False, True])
@pytest.mark.parametrize("later", [at("confirm", 15, 15), link("same", ("a", 15, 15), ("b", 15, 15))])
def test_a_later_edit_at_the_point_of_a_rejection_wins(everywhere: bool, later: dict[str, Any]) -> None:
    corrected = correct(at("reject", 15, 15, everywhere=everywhere), later)
    assert fates(corrected) == ["contradicted by edit 2", "applied"]
    assert len(corrected.masks) == 4
    kept, corrected = apply_everywhere(corrected, replace(corrected.masks, instance_ids=torch.tensor([1, 2, 1, 2])))
    assert len(kept) == 4
    assert fates(corrected)[1] == "applied"


def test_a_rejected_mask_does_not_come_back_before_the_one_below_it() -> None:
    """The leaf under a false mask is meant, not the false one."""
    corrected = correct(square(12, 12, 15, 15), at("reject", 13, 13), at("confirm", 13, 13))
    assert fates(corrected) == ["contradicted by edit 2", "applied", "applied"]
    assert len(corrected.masks) == 4
    assert corrected.masks.origin.tolist().count(Origin.CONFIRMED) == 1


def test_an_outline_is_a_leaf_of_its_own_unless_links_say_otherwise() -> None:
    """Matching must not take it for a piece of another one in its photo."""
    drawn = square(22, 10, 28, 20)
    apart = correct(drawn)
    row = apart.masks.origin.tolist().index(Origin.CORRECTED)
    others = {other for pair in apart.links.cannot.tolist() for other in pair if row in pair} - {row}
    assert others == {0, 1}  # the two masks of its photo
    assert not apart.masks.is_linked.any()
    joined = correct(drawn, link("same", ("a", 25, 15), ("a", 15, 15)))
    assert [sorted(pair) for pair in joined.links.cannot.tolist()] == [[1, 2]]
    assert joined.masks.is_linked.tolist() == [True, False, True, False, False]
    squares = [(5 * n, 10, 5 * n + 4, 20) for n in range(8)]
    masks = Masks.of(regions_from_label_maps([label_map(*squares), label_map()]))
    said = findings_of(correct(square(0, 0, 60, 40), masks=masks))
    assert [str(each) for each in said] == ["correction 1 (outline): applied: it replaces 8 masks"]


def test_saying_no_where_no_mask_is_answers_a_question() -> None:
    """A candidate goes, if it is no leaf in any photo; where a surface promises a mask, none is right. Elsewhere it is
    a mistake."""
    candidate = RejectedCandidate(0.3, Masks.of(regions_from_label_maps([label_map((40, 25, 55, 35)), label_map()])))
    other = RejectedCandidate(0.2, Masks.of(regions_from_label_maps([label_map((1, 25, 9, 35)), label_map()])))
    both = (at("reject", x, 30, everywhere=True) for x in (45, 25))
    corrected = correct(*both, at("reject", 5, 30))
    assert fates(corrected) == ["points at nothing"] * 3
    plant = match_given(Opened(SCENE, Photos(SCENE), RunConfig(), given=MASKS))
    plant = replace(plant, edits=corrected.fates, refused=corrected.refused, rejected=(candidate, other))
    settled = settle_edits(plant, {})
    answered = replace(corrected, fates=settled.edits)
    assert settle_edits(settled, {}).rejected == settled.rejected == (other,)
    assert fates(answered) == ["applied", "points at nothing", "applied"]
    assert len(findings_of(answered)) == 1


def test_links_stay_with_their_masks_when_an_instance_goes() -> None:
    corrected = correct(at("reject", 15, 15, everywhere=True), link("same", ("a", 35, 15), ("b", 35, 15)))
    assert corrected.masks.is_linked.tolist() == [False, True, False, True]
    matched = replace(corrected.masks, instance_ids=torch.tensor([1, 2, 1, 2]))
    masks, _ = apply_everywhere(corrected, matched)
    assert masks.regions.boxes.tolist() == [[*RIGHT], [*RIGHT]]
    assert masks.is_linked.tolist() == [True, True]
