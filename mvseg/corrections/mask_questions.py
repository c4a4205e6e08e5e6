"""The queue of the user who corrects a result: the answers that are expected to change most come first."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from operator import attrgetter
from typing import Literal

import numpy as np
import torch
from scipy.ndimage import find_objects

from mvseg.arrays import Bools, Floats, Ints
from mvseg.corrections.numbers import QUESTIONS
from mvseg.corrections.rough_outline import trace_outline
from mvseg.corrections.unmasked import Unmasked, find_unmasked
from mvseg.formats.photos import ReadPhoto
from mvseg.masks import Masks, Origin
from mvseg.reconstruction.surface.leaf_surface import LeafSurface
from mvseg.scene import Cameras
from mvseg.verification.choose import RejectedCandidate
from mvseg.verification.evidence import Evidence, paint_view, see_instances
from mvseg.verification.numbers import CHOICE, EVIDENCE

Kind = Literal["place", "half", "match", "unmatched", "few", "surface", "covered", "missing", "leaf"]
FIRST = ("place", "half")  # what nothing but an outline mends, and all photos follow
Outlines = tuple[tuple[int, Floats], ...]


@dataclass(frozen=True, eq=False)
class MaskQuestion:
    """One question to the user.

    Attributes:
        kind: "place": large places have the colour of leaves, and no mask: are there leaves? "half": does a leaf have
            half masks only? (such places are beside them in several views; or another leaf was missed there);
            "match": is the mask of that leaf? "unmatched": is it a leaf, and which? "few": is this a leaf? (it was
            found in few of the views that should show it); "surface": does the mask show that leaf? (the leaf's
            surface explains it badly); "covered": the leaf should be where a mask of another one is; "missing": it
            should be where no mask is; "leaf": is this a leaf? (a candidate that was not chosen).
        doubt: how likely something is wrong, from 0 to 1; rough, to sort by.
        view: index of the view.
        instance: id of the leaf; -1 for "unmatched" without a guess, for "place" and "leaf".
        region: row of the mask; -1 for "place", "missing" and "leaf".
        other: row of the mask of the same leaf in another view that shows it best; -1 for none.
        num_found, num_expected: views that have a mask of the leaf, and that should; of "half", those that have half
            a mask, and that have any.
        size: area of its place, relative to a usual mask, at most 1.
        outlines: views, `view` first, and (P, 2) float64 pixels, undistorted: where the leaf should be; one of
            "missing", two or more of "leaf", those of "place" and "half", none of the others.
    """

    kind: Kind
    doubt: float
    view: int
    instance: int
    region: int = -1
    other: int = -1
    num_found: int = 0
    num_expected: int = 0
    outlines: Outlines = ()
    size: float = 1.0

    @property
    def change(self) -> float:
        """How many usual masks an answer is expected to change."""
        return round(self.doubt * self.size * max(1, self.num_found, len(self.outlines)), QUESTIONS.digits)


def list_mask_questions(
    masks: Masks,
    surfaces: Mapping[int, LeafSurface] | None,
    *,
    cameras: Cameras,
    rejected: Sequence[RejectedCandidate] = (),
    photos: ReadPhoto | None = None,
) -> list[MaskQuestion]:
    """List questions about masks, at most `QUESTIONS.most`: first places without masks and half masks, then those whose
    answer is expected to change most (`MaskQuestion.change`). Masks that the user made or confirmed are not asked
    about, and every other mask once.

    Args:
        surfaces: {instance id: surface}; None where there are none: only matching is doubted then.
        photos: photos of the views; None: nobody looks for places without masks.
    """
    masks, surfaces_of, cameras = masks.to("cpu"), surfaces or {}, cameras.to("cpu")
    usual, areas = _usual_area(masks), masks.regions.areas.tolist()
    questions = _ask_matches(masks, usual)
    should = np.zeros((masks.num_instances + 1, masks.regions.num_views), bool)
    evidence = see_instances(masks.regions, surfaces_of, cameras)
    free: list[list[int]] = [[] for _ in rejected]  # rows of each candidate's masks where none of the result lies
    for view, size in enumerate(cameras.sizes.tolist() if surfaces_of or rejected else ()):
        taken = masks.regions.label_map(view, torch.ones_like(masks.instance_ids), size).numpy() > 0
        if surfaces_of:
            painted = paint_view(surfaces_of, cameras, view)
            questions += _ask_view(masks, painted, should, view=view, taken=taken, evidence=evidence)
        for rows, candidate in zip(free, rejected, strict=True):
            rows += _free_rows(candidate.masks, view, taken)
    questions += _ask_surfaces(masks, surfaces_of) + _ask_rare(masks, should)
    if photos is not None:
        questions += _ask_unmasked(masks, find_unmasked(masks, photos, least_area=QUESTIONS.half * usual), usual=usual)
    questions = [
        replace(each, size=min(1.0, areas[each.region] / usual)) if each.region >= 0 else each for each in questions
    ]
    is_corrected = (masks.origin >= int(Origin.CORRECTED)).tolist()
    asked: set[tuple[int, ...]] = set()
    queue = _ask_rejected(rejected, free, usual=usual)
    place = attrgetter("view", "instance", "region")
    for each in sorted(questions, key=lambda one: (*_order(one), one.instance < 0, *place(one))):
        name = (each.region,) if each.region >= 0 else (-1, each.view, each.instance)
        if each.doubt >= QUESTIONS.least and name not in asked and not (each.region >= 0 and is_corrected[each.region]):
            asked.add(name)
            queue.append(each)
    queue.sort(key=_order)
    return [
        each if each.instance < 0 else replace(each, other=best_mask(masks, each.instance, but=each.view))
        for each in queue[: QUESTIONS.most]
    ]


def _order(question: MaskQuestion) -> tuple[bool, float]:
    return question.kind not in FIRST, -question.change


def best_mask(masks: Masks, instance: int, *, but: int) -> int:
    """The row of the mask that shows an instance best: the largest of those whose score is at most 0.1 below the best;
    -1 if no view but `but` has one."""
    rows = ((masks.instance_ids == instance) & (masks.view_index != but) & (masks.regions.areas > 0)).nonzero()[:, 0]
    if not len(rows):
        return -1
    scores = masks.match_scores[rows]
    return int(rows[torch.where(scores >= scores.max() - QUESTIONS.as_good, masks.regions.areas[rows], -1).argmax()])


def _ask_matches(masks: Masks, usual: float) -> list[MaskQuestion]:
    ids, areas, views = masks.instance_ids.tolist(), masks.regions.areas, masks.view_index.tolist()
    questions = []
    for row, score in enumerate(masks.match_scores.tolist()):
        if ids[row] > 0:
            questions.append(MaskQuestion("match", 1 - score, views[row], ids[row], region=row))
        elif areas[row] > 0:
            doubt = min(1.0, float(areas[row]) / usual)
            questions.append(MaskQuestion("unmatched", doubt, views[row], -1, region=row))
    return questions


def _usual_area(masks: Masks) -> float:
    matched = masks.regions.areas[masks.instance_ids > 0].float()
    return max(float(matched.median()), 1.0) if len(matched) else 1.0


def _ask_unmasked(masks: Masks, parts: Sequence[Unmasked], *, usual: float) -> list[MaskQuestion]:
    """Large places without masks, all in one question, if two views have such; and leaves beside whose masks there are
    such places in several views, a question each."""
    ids, areas, drawn = masks.instance_ids.tolist(), masks.regions.areas.tolist(), masks.is_corrected.tolist()
    places, halves = [], defaultdict[int, dict[int, Unmasked]](dict)
    for part in sorted(parts, key=lambda one: (-one.area, one.view)):
        is_beside = part.row >= 0 and ids[part.row] > 0 and not drawn[part.row]
        if is_beside and part.area >= QUESTIONS.half * areas[part.row]:
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
        num_all = len(masks.view_index[masks.instance_ids == instance].unique())
        half = MaskQuestion("half", 1.0, largest.view, instance, region=largest.row, outlines=outlines)
        questions.append(replace(half, num_found=len(views), num_expected=num_all))
    if len({part.view for part in places}) > 1:  # two outlines are a leaf
        outlines = tuple((part.view, part.outline) for part in places[: QUESTIONS.most_places])
        questions.append(MaskQuestion("place", 1.0, outlines[0][0], -1, outlines=outlines))
    return questions


def _free_rows(masks: Masks, view: int, taken: Bools) -> list[int]:
    free = []
    for row in (masks.view_index == view).nonzero()[:, 0].tolist():
        crop = masks.regions.placed(row)
        if float(crop.cut(taken)[crop.pixels.numpy()].mean()) <= EVIDENCE.shared:
            free.append(row)
    return free


def _ask_rejected(
    rejected: Sequence[RejectedCandidate], free: Sequence[Sequence[int]], *, usual: float
) -> list[MaskQuestion]:
    """Candidates that were not chosen, in the views where no mask of the result lies, the largest mask first; `usual`
    as `_usual_area` says."""
    questions = []
    for each, rows in zip(rejected, free, strict=True):
        if each.chance < QUESTIONS.least_chance or len(rows) < CHOICE.least_views:
            continue
        regions = each.masks.regions
        areas = regions.areas[rows].double()
        order = areas.argsort(descending=True, stable=True).tolist()
        outlines = tuple(
            (int(regions.view_index[row]), trace_outline(regions.crop(row).numpy()) + regions.boxes[row, :2].numpy())
            for row in (rows[place] for place in order)
        )
        doubt = each.chance * min(1.0, float(areas.median()) / usual)
        questions.append(MaskQuestion("leaf", doubt, outlines[0][0], -1, outlines=outlines))
    return questions


def _ask_view(
    masks: Masks, painted: Ints, should: Bools, *, view: int, taken: Bools, evidence: Evidence
) -> list[MaskQuestion]:
    """Questions about leaves that one view should show and does not.

    `should` (K + 1, V) gets True where it should show one; `painted` (H, W) is from `paint_view`, `taken` (H, W) is
    True in masks, the columns of `evidence` are ids.
    """
    members = ((masks.view_index == view) & (masks.regions.areas > 0)).nonzero()[:, 0].tolist()
    here = {int(masks.instance_ids[row]) for row in members}
    questions = []
    for instance, box in enumerate(find_objects(painted, max_label=len(should) - 1), 1):
        if box is None:
            continue
        mask, share = painted[box] == instance, float(evidence.share[view, instance])
        if share < QUESTIONS.open or mask.sum() < EVIDENCE.open_pixels:
            continue
        should[instance, view] = True
        if instance in here:
            continue
        empty = float((mask & ~taken[box]).sum() / mask.sum())
        nearest = max(members, key=lambda row: evidence.visible[row, instance], default=-1)
        if nearest >= 0 and evidence.visible[nearest, instance] >= QUESTIONS.similar:
            doubt = min(1.0, float(evidence.visible[nearest, instance]) / QUESTIONS.surely)
            questions.append(MaskQuestion("covered", doubt, view, instance, region=nearest))
        elif empty >= QUESTIONS.empty:
            outlines = ((view, trace_outline(mask) + (box[1].start, box[0].start)),)
            size = min(1.0, float(mask.sum()) / _usual_area(masks))
            questions.append(MaskQuestion("missing", empty * share, view, instance, outlines=outlines, size=size))
    return questions


def _ask_surfaces(masks: Masks, surfaces: Mapping[int, LeafSurface]) -> list[MaskQuestion]:
    questions = []
    for instance, surface in surfaces.items():
        if not surface.exists:
            continue
        worst = int(surface.iou.nan_to_num(1.0).argmin())
        view, doubt = int(surface.views[worst]), 1 - float(surface.iou[worst].nan_to_num(1.0))
        rows = ((masks.instance_ids == instance) & (masks.view_index == view)).nonzero()[:, 0]
        if len(rows):
            row = int(rows[masks.regions.areas[rows].argmax()])
            questions.append(MaskQuestion("surface", doubt, view, instance, region=row))
    return questions


def _ask_rare(masks: Masks, should: Bools) -> list[MaskQuestion]:
    """Leaves that were found in few of the views that should show them; without a credible surface, of all views."""
    questions = []
    for instance in range(1, masks.num_instances + 1):
        best = best_mask(masks, instance, but=-1)
        if best < 0:
            continue
        views = set(masks.view_index[masks.instance_ids == instance].tolist())
        expected = views | set(np.flatnonzero(should[instance]).tolist())
        number = len(expected) if should[instance].any() else masks.regions.num_views
        doubt, view = 1 - len(views) / number, int(masks.view_index[best])
        few = MaskQuestion("few", doubt, view, instance, region=best)
        questions.append(replace(few, num_found=len(views), num_expected=number))
    return questions
