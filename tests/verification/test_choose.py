"""Which leaves and masks are chosen: three known leaves, one over another, seen by six cameras, and what a detector may
propose of them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import permutations

import numpy as np
import pytest
import torch

from blade_scene import SIZE, EllipticBlade, as_regions, blade_masks, ring_cameras
from known_leaves import flat_leaf
from mvseg.errors import InputWarning
from mvseg.masks import Masks, Origin
from mvseg.reconstruction.surface.leaf_surface import LeafSurface
from mvseg.regions import Regions
from mvseg.scene import Cameras
from mvseg.verification import leaf_scores
from mvseg.verification.candidates import Key, gather_candidates
from mvseg.verification.choice import assign_masks, least_chance
from mvseg.verification.choose import Edited, Judges, Leaves, add_beside, choose_leaves
from mvseg.verification.evidence import draw_views
from three_leaves import CAMERAS, LEAVES, true_maps
from tube_scene import BENT, tube_masks
from warned import warns_of

TRUE = true_maps()
REGIONS, IDS = as_regions(TRUE)


def proposals_of(regions: Regions, scores: torch.Tensor) -> Masks:
    numbered = replace(regions, labels=torch.arange(len(regions)))
    return Masks.of(numbered, detection_scores=scores, origin=Origin.DETECTED)


def matched_of(proposals: Masks, ids: torch.Tensor, rows: torch.Tensor | None = None, score: float = 0.9) -> Masks:
    rows = torch.arange(len(proposals)) if rows is None else rows
    chosen = proposals.select(rows)
    return replace(chosen, instance_ids=ids, match_scores=torch.where(ids > 0, score, 0.0))


def fit(masks: Masks, _: Cameras, __: object) -> dict[int, LeafSurface]:
    """The known leaves, by most of the masks."""
    found = {}
    for instance in masks.instance_ids[masks.instance_ids > 0].unique().tolist():
        rows = masks.regions.labels[masks.instance_ids == instance]
        leaf = int(TRUTH[rows.clamp(max=len(TRUTH) - 1)].mode().values)
        found[instance] = LEAVES.get(leaf, STRAY)
    return found


STRAY = flat_leaf(length=0.5, half_width=0.2, at=(2.0, 2.0, 0.0))
TRUTH = IDS
PROPOSALS = proposals_of(REGIONS, torch.full((len(REGIONS),), 0.8))


def choose(
    matched: Masks,
    proposals: Masks = PROPOSALS,
    *,
    cameras: Cameras = CAMERAS,
    edited: Edited | None = None,
    min_probability: float | None = None,
    fit: Callable[..., dict[int, LeafSurface]] = fit,
) -> Leaves:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("mvseg.verification.choose.fit_roughly", fit)
        judges = Judges(cameras, min_probability=min_probability)
        return choose_leaves(proposals, {"matched": matched}, judges, edited=edited)


def edit(masks: Masks, *, keys: Sequence[Key] = (), gone: Sequence[int] = ()) -> Edited:
    stays = torch.full((len(masks),), bool(keys))
    apart = torch.zeros(0, 2, dtype=torch.int64)
    return Edited(masks, tuple(keys) or (None,) * len(masks), stays, torch.tensor(gone, dtype=torch.int64), apart)


def label_maps(leaves: Leaves) -> list[np.ndarray]:
    ids = leaves.masks.instance_ids.clamp(min=0)
    return [leaves.masks.regions.label_map(view, ids, (SIZE, SIZE)).numpy() for view in range(len(CAMERAS))]


def same_partition(leaves: Leaves, truth: list[np.ndarray] = TRUE) -> bool:
    """The same pixels, and one number here for one there."""
    found = np.stack(label_maps(leaves)).ravel()
    pairs = {*zip(found.tolist(), np.stack(truth).ravel().tolist(), strict=True)}
    return len(pairs) == len({a for a, _ in pairs}) == len({b for _, b in pairs})


def test_right_masks_are_chosen_as_they_are_and_views_agree_less_where_half_lack() -> None:
    leaves = choose(matched_of(PROPOSALS, IDS))
    assert same_partition(leaves)
    assert len(leaves.masks) == len(REGIONS)
    assert all(chance > 0.9 for chance in leaves.probabilities.values())
    assert leaves.surfaces.keys() == {1, 2, 3}
    assert leaves.agreement > 0.9
    rows = ((IDS != 1) | (REGIONS.view_index % 2 == 0)).nonzero()[:, 0]
    proposals = proposals_of(REGIONS.select(rows), torch.full((len(rows),), 0.8))
    leaves = choose(matched_of(proposals, IDS[rows]), proposals, fit=lambda *_: LEAVES)
    assert leaves.agreement == pytest.approx(1 - 0.5 / 3, abs=0.06)


def test_weak_proposals_fill_what_the_sure_ones_lack() -> None:
    """Half of the masks of one leaf score low, and were never matched: its surface finds them."""
    weak = (IDS == 2) & (torch.arange(len(IDS)) % 2 == 0)
    proposals = proposals_of(REGIONS, torch.where(weak, 0.06, 0.8))
    rows = (~weak).nonzero()[:, 0]
    assert same_partition(choose(matched_of(proposals, IDS[rows], rows), proposals))


def test_a_duplicate_and_a_stray_instance_fall() -> None:
    """Eroded copies form instances of their own, and one is made of masks where nothing is."""
    rng = np.random.default_rng(0)
    maps = [np.where(rng.random((SIZE, SIZE)) < 0.97, labels, 0) for labels in TRUE]
    copies, copy_ids = as_regions(maps)
    corner = [np.zeros_like(labels) for labels in TRUE]
    for labels in corner[:2]:
        labels[2:14, 2:14] = 9
    strays, _ = as_regions(corner)
    every = Masks.concatenate([Masks.of(each) for each in (REGIONS, copies, strays)]).regions
    scored = (REGIONS, 0.8), (copies, 0.5), (strays, 0.3)
    scores = torch.cat([torch.full((len(each),), score) for each, score in scored])
    proposals = proposals_of(every, scores)
    ids = torch.cat((IDS, copy_ids + 3, torch.full((len(strays),), 7)))
    leaves = choose(matched_of(proposals, ids), proposals)
    assert same_partition(leaves)
    assert all(each.chance < 0.5 for each in leaves.rejected)


def test_two_masks_of_one_photo_never_show_the_same_pixels() -> None:
    whole = [np.where(labels > 0, 1, 0) for labels in TRUE]  # one mask over all leaves, in every photo
    over, _ = as_regions(whole)
    every = Masks.concatenate([Masks.of(REGIONS), Masks.of(over)]).regions
    proposals = proposals_of(every, torch.full((len(every),), 0.8))
    ids = torch.cat((IDS, torch.full((len(over),), -1)))
    leaves = choose(matched_of(proposals, ids), proposals)
    assert same_partition(leaves)


def test_the_user_is_right() -> None:
    """A mask that is confirmed stays with its instance, though no surface agrees; what was rejected does not return."""
    row, every = int(((REGIONS.view_index == 2) & (IDS == 3)).nonzero()[0, 0]), torch.arange(len(IDS))
    matched = matched_of(PROPOSALS, IDS)
    confirmed = replace(matched_of(PROPOSALS, IDS.where(every != row, 1)), origin=1 + 4 * (every == row))
    leaves = choose(matched, edited=edit(confirmed))
    stays = leaves.masks.origin == Origin.CONFIRMED
    assert int(stays.sum()) == 1
    partners = leaves.masks.instance_ids == leaves.masks.instance_ids[stays]
    assert leaves.probabilities[int(leaves.masks.instance_ids[stays])] == 1
    assert int(partners.sum()) >= 5
    without = choose(matched, edited=edit(matched.select(every != row), gone=[row]))
    assert len(without.masks) == len(REGIONS) - 1
    boxes = without.masks.regions.boxes[without.masks.view_index == 2]
    assert not (boxes == REGIONS.boxes[row]).all(1).any()


def test_an_edit_that_touches_nothing_changes_nothing() -> None:
    """Bit for bit; what the edited masks are matched to does not matter."""
    matched = matched_of(PROPOSALS, IDS)
    plain, edited = choose(matched), choose(matched, edited=edit(replace(matched, instance_ids=IDS % 3 + 1)))
    assert plain.probabilities == edited.probabilities
    assert plain.keys == edited.keys
    assert torch.equal(plain.masks.instance_ids, edited.masks.instance_ids)
    assert torch.equal(plain.masks.match_scores, edited.masks.match_scores)
    assert torch.equal(plain.masks.proposal, edited.masks.proposal)


def test_terms_have_no_order_and_one_that_is_left_out_has_no_weight(monkeypatch: pytest.MonkeyPatch) -> None:
    plain = choose(matched_of(PROPOSALS, IDS))
    for name in ("TERMS", "LEAF_TERMS"):
        monkeypatch.setattr(leaf_scores, name, dict(reversed(getattr(leaf_scores, name).items())))
    assert choose(matched_of(PROPOSALS, IDS)).probabilities == plain.probabilities
    terms = {"one": np.ones(3), "other": np.arange(3.0)}
    without = leaf_scores.sum_terms({"one": 2.0}, terms)
    np.testing.assert_array_equal(leaf_scores.sum_terms({"other": 0.0, "one": 2.0}, terms), without)


def test_masks_are_added_where_the_others_show_nothing() -> None:
    matched = matched_of(PROPOSALS, IDS)
    two, third = matched.select(IDS < 3), matched.select(IDS == 3)
    for others in (matched, third):
        both = add_beside(two, others, CAMERAS)
        assert sorted(both.regions.labels.tolist()) == list(range(len(IDS)))
        assert both.view_index.tolist() == sorted(both.view_index.tolist())
    assert add_beside(two, two, CAMERAS).regions.labels.tolist() == two.regions.labels.tolist()


def drawn_by_the_user(maps: list[np.ndarray]) -> Masks:
    drawn = Masks.of(as_regions(maps)[0], origin=Origin.CORRECTED)
    return replace(drawn, proposal=-1 - drawn.proposal)


def test_a_drawn_mask_that_was_matched_to_nothing_shows_the_leaf_that_the_views_say_or_none() -> None:
    square = np.zeros((SIZE, SIZE), np.int64)
    square[2:14, 2:14] = 1
    row = int(((REGIONS.view_index == 2) & (IDS == 2)).nonzero()[0, 0])
    matched = matched_of(PROPOSALS, torch.where(torch.arange(len(IDS)) == row, -1, IDS))
    redrawn = replace(matched, proposal=matched.proposal.clone())
    redrawn.origin[row], redrawn.proposal[row] = Origin.CORRECTED, -2
    drawn = drawn_by_the_user([square * (view == 2) for view in range(6)])
    leaves = choose(matched_of(PROPOSALS, IDS), edited=edit(Masks.concatenate((redrawn, drawn)), gone=[row]))
    of_user = leaves.masks.origin == Origin.CORRECTED
    assert sorted(leaves.masks.regions.areas[of_user].tolist()) == sorted([144, int(REGIONS.areas[row])])
    assert leaves.masks.instance_ids[leaves.masks.proposal == -1].tolist() == [-1]
    assert same_partition(leaves)


def test_edits_about_a_leaf_that_stays_as_it_was_change_no_other_mask() -> None:
    """Bit for bit, but that the mask is certain now, and the leaf."""
    matched = matched_of(PROPOSALS, IDS)
    plain = choose(matched)
    keys = [key for leaf in IDS.tolist() for key in plain.keys.values() if key[0] == int((leaf == IDS).nonzero()[0, 0])]
    said = replace(matched, instance_ids=IDS % 3 + 1, is_linked=torch.arange(len(IDS)) == 3)
    same = choose(matched, edited=edit(said, keys=keys))
    is_said = same.masks.proposal == 3
    (leaf,) = same.masks.instance_ids[is_said].tolist()
    scores = {row: score for row, score in zip(plain.masks.proposal.tolist(), plain.masks.match_scores, strict=True)}
    for row, score in zip(same.masks.proposal.tolist(), same.masks.match_scores, strict=True):
        assert score == (1 if row == 3 else scores[row])
    assert same.probabilities[leaf] == 1
    assert same_partition(same)
    assert {key: plain.probabilities[number] for number, key in plain.keys.items() if key != same.keys[leaf]} == {
        key: same.probabilities[number] for number, key in same.keys.items() if number != leaf
    }
    assert same.masks.is_linked.tolist() == is_said.tolist()


def test_a_cut_mask_of_a_leaf_that_stays_as_it_was_seen_stays_in_it() -> None:
    """The user confirms a mask that was cut since it was proposed, and that no other matching has."""
    row = int(((REGIONS.view_index == 2) & (IDS == 2)).nonzero()[0, 0])
    x1, y1, x2, y2 = REGIONS.boxes[row].tolist()
    maps = [labels.copy() for labels in TRUE]
    maps[2][y1 : (y1 + y2) // 2, x1 : (x1 + x2) // 2][maps[2][y1 : (y1 + y2) // 2, x1 : (x1 + x2) // 2] == 2] = 0
    first = matched_of(PROPOSALS, IDS)
    plain = choose(first)
    keys = [key for leaf in IDS.tolist() for key in plain.keys.values() if key[0] == int((leaf == IDS).nonzero()[0, 0])]
    cut = replace(first, regions=as_regions(maps)[0], proposal=first.proposal.clone())
    cut.origin[row], cut.proposal[row] = Origin.CONFIRMED, -1
    assert same_partition(choose(first, edited=edit(cut, keys=keys, gone=[row])), maps)


def test_a_mask_that_the_user_keeps_apart_from_a_leaf_does_not_return_to_it() -> None:
    """Nor does a copy of it; where no other leaf takes it, it goes."""
    row = int(((REGIONS.view_index == 2) & (IDS == 2)).nonzero()[0, 0])
    other = int(((REGIONS.view_index == 3) & (IDS == 2)).nonzero()[0, 0])
    proposals = Masks.concatenate((PROPOSALS, PROPOSALS.select(torch.tensor([row]))))
    proposals = replace(proposals, proposal=torch.arange(len(proposals)))
    first = matched_of(proposals, torch.cat((IDS, torch.tensor([-1]))))
    edited = matched_of(PROPOSALS, torch.where(torch.arange(len(IDS)) == row, -1, IDS))
    edited = replace(edited, is_linked=torch.isin(torch.arange(len(IDS)), torch.tensor([row, other])))
    leaves = choose(first, proposals, edited=edit(edited))
    assert set(leaves.masks.proposal.tolist()) == set(range(len(IDS))) - {row}
    without = [np.where((labels == 2) & (view == 2), 0, labels) for view, labels in enumerate(TRUE)]
    assert same_partition(leaves, without)


def test_proposals_under_a_mask_of_the_user_go() -> None:
    """The user draws half of a leaf, which is matched to nothing."""
    row = int(((REGIONS.view_index == 2) & (IDS == 2)).nonzero()[0, 0])
    is_left = np.arange(SIZE) < REGIONS.boxes[row, 0::2].float().mean().item()
    half = [np.where((labels == 2) & is_left & (view == 2), 1, 0) for view, labels in enumerate(TRUE)]
    drawn = drawn_by_the_user(half)
    matched = matched_of(PROPOSALS, IDS)
    rest = matched.select(torch.arange(len(IDS)) != row)
    leaves = choose(matched, edited=edit(Masks.concatenate((rest, drawn)), gone=[row]))
    here = leaves.masks.select(leaves.masks.view_index == 2).regions
    assert int(here.areas.sum()) == int((here.label_map(2, torch.ones(len(here)), (SIZE, SIZE)) > 0).sum())


def test_the_order_of_masks_does_not_matter_and_classes_are_never_mixed() -> None:
    order = torch.randperm(len(REGIONS), generator=torch.Generator().manual_seed(0))
    proposals = proposals_of(REGIONS.select(order), torch.full((len(REGIONS),), 0.8))
    global TRUTH
    TRUTH = IDS[order]
    try:
        assert same_partition(choose(matched_of(proposals, IDS[order]), proposals))
    finally:
        TRUTH = IDS
    other = (REGIONS.view_index == 3) & (IDS == 1)
    proposals = replace(PROPOSALS, classes=torch.where(other, 2, 1))
    ids = torch.where(other, -1, IDS)
    leaves = choose(matched_of(proposals, ids), proposals)
    assert set(leaves.masks.classes.tolist()) == {1}
    assert len(leaves.masks) == len(REGIONS) - 1


def test_a_probability_of_ones_own() -> None:
    matched = matched_of(PROPOSALS, IDS)
    assert len(choose(matched, min_probability=1.0).masks) == 0
    assert same_partition(choose(matched, min_probability=0.0))


def test_without_surfaces_matching_and_scores_decide_and_nothing_is_an_answer() -> None:
    empty = PROPOSALS.select(torch.zeros(0, dtype=torch.int64))
    assert len(choose(empty, empty).masks) == 0
    assert len(choose(matched_of(PROPOSALS, -torch.ones_like(IDS))).masks) == 0
    leaves = choose(matched_of(PROPOSALS, IDS), fit=lambda *_: {})
    assert same_partition(leaves)
    assert leaves.surfaces == {}


def test_cameras_on_one_side_are_said() -> None:
    alike = replace(CAMERAS, R=CAMERAS.R[[0] * 6], t=CAMERAS.t[[0] * 6] + 1e-3 * torch.arange(6)[:, None])
    with warns_of("leaves_seen_from_one_side"):
        leaves = choose(matched_of(PROPOSALS, IDS), cameras=alike)
    none = matched_of(PROPOSALS, torch.full_like(IDS, -1))
    with pytest.warns(InputWarning, match="from one side only"):  # also where nothing was matched after an edit
        edited = choose(matched_of(PROPOSALS, IDS), cameras=alike, edited=edit(none))
    assert leaves.surfaces == edited.surfaces == {}
    assert torch.equal(leaves.masks.instance_ids, edited.masks.instance_ids)
    assert len(leaves.masks) == len(REGIONS)


@pytest.mark.parametrize("half_widths", [(0.45, 0.4), (0.08, 0.1)])
def test_a_stem_among_leaves_is_not_chosen(half_widths: tuple[float, ...]) -> None:
    """Unless all leaves are as slender: a strap is no stem."""
    cameras, apart = ring_cameras(6), torch.tensor([0.0, 1.1, 0.0], dtype=torch.float64)
    masks = [
        blade_masks(EllipticBlade(half_width=width, bend=0.9), replace(cameras, t=cameras.t + side * cameras.R @ apart))
        for width, side in zip(half_widths, (-1, 1), strict=True)
    ]
    masks.append(tube_masks(0.8 * BENT, np.full(len(BENT), 0.05), cameras))
    every = Masks.concatenate([Masks.of(as_regions(each)[0]) for each in masks]).regions
    proposals = proposals_of(every, torch.full((len(every),), 0.8))
    matched = matched_of(proposals, torch.arange(1, 4).repeat_interleave(len(cameras)))
    judges = Judges(cameras)
    stem = gather_candidates({"matched": matched}, proposals, judges.fit).stem
    leaves = choose_leaves(proposals, {"matched": matched}, judges)
    is_stem_told = max(half_widths) > 0.2
    assert (stem[:2] < 0.01).all()
    assert stem[2] > 0.9 if is_stem_told else stem[2] < 0.01
    assert leaves.masks.num_instances == 3 - is_stem_told


def test_the_best_expected_f1() -> None:
    rng = np.random.default_rng(0)
    for _ in range(20):
        chances = rng.random(rng.integers(1, 12)).round(3)
        f1 = {cut: 2 * chances[chances >= cut].sum() / ((chances >= cut).sum() + chances.sum()) for cut in chances}
        found = least_chance(chances)
        assert f1[found] == pytest.approx(max(f1.values()))
    assert least_chance(np.array([0.9, 0.8, 0.05])) == 0.8
    assert least_chance(np.zeros(3)) == least_chance(np.zeros(0)) == 1


def test_assignment_is_the_best_one_per_view() -> None:
    """Against every permutation, where no two masks show the same."""
    drawn = draw_views(REGIONS, [None] * 3, CAMERAS)
    q = np.random.default_rng(1).uniform(0.3, 1, (len(REGIONS), 3)).round(4)
    leaf, shown = assign_masks(q, drawn)
    for each in drawn:
        best = max(sum(q[row, k] for row, k in zip(each.rows, order, strict=False))
                   for order in permutations(range(3), min(len(each.rows), 3)))  # fmt: skip
        assert shown[each.rows].sum() == pytest.approx(best)
        assert len({k for k in leaf[each.rows] if k >= 0}) == (leaf[each.rows] >= 0).sum()


def test_a_mask_may_show_a_leaf_by_less_than_half_a_chance() -> None:
    is_leaf, is_likelier = IDS.numpy() == 1, REGIONS.view_index.numpy() < 3
    q = np.where(is_leaf, np.where(is_likelier, 0.25, 0.17), 0)[:, None]
    leaf, _ = assign_masks(q, draw_views(REGIONS, [None], CAMERAS))
    np.testing.assert_array_equal(leaf, np.where(is_leaf & is_likelier, 0, -1))
