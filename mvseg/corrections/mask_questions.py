"""The queue of the user who corrects a result: the answers that are expected to change most come first."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import torch

from mvseg.arrays import Bools, Floats, Ints
from mvseg.corrections.numbers import QUESTIONS
from mvseg.corrections.rough_outline import trace_outline
from mvseg.corrections.unmasked import Unmasked, find_unmasked
from mvseg.formats.photos import ReadPhoto
from mvseg.masks import Masks
from mvseg.reconstruction.surface.leaf_surface import LeafSurface
from mvseg.scene import Cameras
from mvseg.verification.choose import RejectedCandidate
from mvseg.verification.evidence import Evidence, paint_view, see_instances
from mvseg.verification.numbers import CHOICE, DRAWN, EVIDENCE

Kind = Literal["place", "leaf", "half"]


@dataclass(frozen=True, eq=False)
class MaskQuestion:
    """One question to the user.

    Attributes:
        kind: "place": is there a leaf where no mask is? "leaf": does this mask show that leaf, or any; or, without a
            mask, is this candidate a leaf? "half": are places without a mask, beside masks of a leaf, halves of it?
        change: how many usual masks an answer is expected to change; rough, to sort by.
        view: index of the view.
        instance: id of the leaf; -1 for a candidate, and where any leaf may be shown.
        region: row of the mask; -1 without one.
        other: row of the mask of the same leaf in another view that shows it best; -1 for none.
        num_found, num_expected: views that have a mask of the leaf, and that should.
        outlines: views, `view` first, and (P, 2) float64 pixels, undistorted, where leaves may be that have no mask.
    """

    kind: Kind
    change: float
    view: int
    instance: int = -1
    region: int = -1
    other: int = -1
    num_found: int = 0
    num_expected: int = 0
    outlines: tuple[tuple[int, Floats], ...] = ()


def list_mask_questions(
    masks: Masks,
    surfaces: Mapping[int, LeafSurface] | None,
    *,
    cameras: Cameras,
    rejected: Sequence[RejectedCandidate] = (),
    photos: ReadPhoto | None = None,
) -> list[MaskQuestion]:
    """List questions about masks, at most `QUESTIONS.most`; those whose answer is expected to change most come first.
    Each leaf and each mask is asked about once, and no mask that the user made, confirmed or linked. Without `surfaces`
    (by instance id), only matching is doubted; without `photos`, nobody looks for large places without masks.
    """
    masks, surfaces_of, cameras = masks.to("cpu"), surfaces or {}, cameras.to("cpu")
    matched = masks.regions.areas[masks.instance_ids > 0].float()
    usual = max(float(matched.median()), 1.0) if len(matched) else 1.0
    size = (masks.regions.areas / usual).clamp(max=1).tolist()
    evidence = see_instances(masks.regions, surfaces_of, cameras)
    has_mask, should = np.zeros((2, masks.num_instances + 1, masks.regions.num_views), bool)
    has_mask[masks.instance_ids.clamp(min=0), masks.view_index] = True
    should[: evidence.share.shape[1]] = QUESTIONS.open <= evidence.share.T
    # Without a credible surface, all views should show a leaf.
    num_views = [has_mask.sum(1), np.where(should.any(1), (has_mask | should).sum(1), has_mask.shape[1])]
    questions, is_taken = [], list[Bools]()
    for view, shape in enumerate(cameras.sizes.tolist() if surfaces_of or rejected else ()):
        is_taken.append(masks.regions.label_map(view, torch.ones_like(masks.instance_ids), shape).numpy() > 0)
        if len(absent := np.flatnonzero(should[:, view] & ~has_mask[:, view])):
            painted = np.where(is_taken[view], -1, 1) * paint_view(surfaces_of, cameras, view)
            questions += _ask_absent(masks, absent, painted, view=view, evidence=evidence, usual=usual)
    questions += _ask_masks(masks, surfaces_of, num_views, size=size) + _ask_rejected(rejected, is_taken, usual=usual)
    if photos is not None:
        questions += _ask_unmasked(masks, find_unmasked(masks, photos, least_area=DRAWN.half * usual), usual=usual)
    is_settled, asked, queue = masks.is_edited.tolist(), set[tuple[str, int]](), []
    for each in sorted(questions, key=_order):
        if each.kind == "leaf" and each.region >= 0:
            names = {("mask", each.region), ("leaf", each.instance)} - {("leaf", -1)}
            if is_settled[each.region] or names & asked:
                continue
            asked |= names
        if each.instance > 0:
            found, expected = (int(number[each.instance]) for number in num_views)
            other = best_mask(masks, each.instance, but=each.view)
            each = replace(each, other=other, num_found=found, num_expected=expected)
        queue.append(each)
    return queue[: QUESTIONS.most]


def _order(question: MaskQuestion) -> tuple[float, bool, int, int]:
    return -round(question.change, QUESTIONS.digits), question.instance < 0, question.view, question.instance


def best_mask(masks: Masks, instance: int, *, but: int) -> int:
    """The row of the mask that shows an instance best: the largest of those whose score is at most 0.1 below the best;
    -1 if no view but `but` has one."""
    rows = ((masks.instance_ids == instance) & (masks.view_index != but) & (masks.regions.areas > 0)).nonzero()[:, 0]
    if not len(rows):
        return -1
    scores = masks.match_scores[rows]
    return int(rows[torch.where(scores >= scores.max() - QUESTIONS.as_good, masks.regions.areas[rows], -1).argmax()])


def _ask_masks(
    masks: Masks, surfaces: Mapping[int, LeafSurface], num_views: Sequence[Ints], *, size: Sequence[float]
) -> list[MaskQuestion]:
    """Ask about masks of no leaf, masks that score low or that the leaf's surface explains badly, and the masks of
    leaves with masks in few of the views that should show them: such a leaf may be none in any view."""
    questions, ids = [], masks.instance_ids.tolist()
    certain = {*masks.instance_ids[masks.is_edited].tolist(), -1}
    wrong = torch.where(masks.instance_ids > 0, 1 - masks.match_scores, torch.tensor(size)).tolist()
    for instance, surface in surfaces.items():
        fits = dict(zip(surface.views.tolist(), surface.iou.nan_to_num(1.0).tolist(), strict=True))
        for row in (masks.instance_ids == instance).nonzero()[:, 0].tolist():
            wrong[row] = max(wrong[row], 1 - fits.get(int(masks.view_index[row]), 1.0))
    for row, view in enumerate(masks.view_index.tolist()):
        num_found, num_expected = (int(number[ids[row]]) for number in num_views)
        few = 0.0 if ids[row] in certain else 1 - num_found / num_expected
        if max(wrong[row], few) >= QUESTIONS.least:
            change = max(wrong[row], few * num_found) * size[row]
            questions.append(MaskQuestion("leaf", change, view, ids[row], region=row))
    return questions


def _ask_unmasked(masks: Masks, parts: Sequence[Unmasked], *, usual: float) -> list[MaskQuestion]:
    """Large places without masks, all in one question, if two views have such; and leaves beside whose masks there are
    such places in several views, a question each."""
    ids, areas, drawn = masks.instance_ids.tolist(), masks.regions.areas.tolist(), masks.is_corrected.tolist()
    places, halves = [], defaultdict[int, dict[int, Unmasked]](dict)
    for part in sorted(parts, key=lambda one: (-one.area, one.view)):
        is_beside = part.row >= 0 and ids[part.row] > 0 and not drawn[part.row]
        if is_beside and part.area >= DRAWN.half * areas[part.row]:
            halves[ids[part.row]].setdefault(part.view, part)
        if part.area >= usual:
            places.append(part)
    questions = []
    for instance, views in sorted(halves.items()):
        if len(views) < QUESTIONS.least_halves:
            continue
        places = [part for part in places if part.row < 0 or ids[part.row] != instance]
        largest = max(views.values(), key=lambda one: one.area)
        outlines = tuple((part.view, part.outline) for part in views.values())
        change = len(views) * min(1.0, areas[largest.row] / usual)
        questions.append(MaskQuestion("half", change, largest.view, instance, largest.row, outlines=outlines))
    if len({part.view for part in places}) > 1:  # two outlines are a leaf
        outlines = tuple((part.view, part.outline) for part in places[: QUESTIONS.most_places])
        questions.append(MaskQuestion("place", len(outlines), outlines[0][0], outlines=outlines))
    return questions


def _ask_rejected(
    rejected: Sequence[RejectedCandidate], is_taken: Sequence[Bools], *, usual: float
) -> list[MaskQuestion]:
    """Ask about candidates that were not chosen, in views where no mask of the result lies (`is_taken`, (H, W))."""
    questions = []
    for each in rejected:
        regions, rows = each.masks.regions, list[int]()
        for row, view in enumerate(regions.view_index.tolist()):
            crop = regions.placed(row)
            if float(crop.cut(is_taken[view])[crop.pixels.numpy()].mean()) <= EVIDENCE.shared:
                rows.append(row)
        if each.chance < QUESTIONS.least_chance or len(rows) < CHOICE.least_views:
            continue
        areas = regions.areas[rows].double()
        order = areas.argsort(descending=True, stable=True).tolist()
        outlines = tuple(
            (int(regions.view_index[row]), trace_outline(regions.crop(row).numpy()) + regions.boxes[row, :2].numpy())
            for row in (rows[place] for place in order)
        )
        doubt = each.chance * min(1.0, float(areas.median()) / usual)
        questions.append(MaskQuestion("leaf", doubt * len(outlines), outlines[0][0], outlines=outlines))
    return questions


def _ask_absent(
    masks: Masks, absent: Ints, painted: Ints, *, view: int, evidence: Evidence, usual: float
) -> list[MaskQuestion]:
    """Ask about leaves (`absent`, ids) that one view should show and does not: is it a mask that lies there, or is no
    mask there? `painted` (H, W) is from `paint_view`, negative in masks."""
    members = ((masks.view_index == view) & (masks.regions.areas > 0)).nonzero()[:, 0].tolist()
    questions = []
    for instance in absent.tolist():
        mask = np.abs(painted) == instance
        nearest = max(members, key=lambda row: evidence.visible[row, instance], default=-1)
        if mask.sum() < EVIDENCE.open_pixels:
            continue
        if nearest >= 0 and evidence.visible[nearest, instance] >= QUESTIONS.similar:
            change = float(evidence.visible[nearest, instance]) * min(1.0, float(masks.regions.areas[nearest]) / usual)
            questions.append(MaskQuestion("leaf", change, view, instance, region=nearest))
        elif (empty := float((painted == instance).sum() / mask.sum())) >= QUESTIONS.empty:
            shown = float(evidence.share[view, instance]) * min(1.0, float(mask.sum()) / usual)
            outlines = ((view, trace_outline(mask)),)
            questions.append(MaskQuestion("place", empty * shown, view, instance, outlines=outlines))
    return questions
