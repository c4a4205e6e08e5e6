"""A person who knows the truth, and answers the questions of the page edit by edit: see `benchmarks/corrections.py`."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from mvseg.corrections.file import Confirm, Edit, Link, Outline, Reject, Split
from mvseg.corrections.mask_questions import MaskQuestion
from mvseg.evaluation.panoptic import RIGHT_IOU
from mvseg.evaluation.truth import region_crops, true_instances
from mvseg.formats.lens import photo_from_pinhole, pinhole_from_photo
from mvseg.masks import Masks
from mvseg.regions import IGNORE_LABEL
from mvseg.scene import Scene

Labels = NDArray[np.uint16]

LEAST_REPAIR = 0.03  # of what an outline holds, below which it shows nothing of a leaf
SHOWN = 0.5  # IoU from which an outline shows a leaf
OUTLINE_PX = 1.5  # that a drawn outline is off


@dataclass(frozen=True)
class Answer:
    """The answer to a question.

    Attributes:
        name: the same answer has the same name whatever the ids and rows of a result are.
        edits: in their order.
        change: of the question.
        leaves: true leaves concerned, 0 for what is none: no two answers of a round concern the same ones.
    """

    name: str
    edits: tuple[Edit, ...]
    change: float
    leaves: frozenset[int]


def choose_answers(found: Sequence[Answer], *, most: int, done: Collection[str]) -> list[Answer]:
    """Answers for the next round, at most so many, in the order of their questions."""
    chosen: list[Answer] = []
    touched: set[int] = set()
    for each in sorted((one for one in found if one.name not in done), key=lambda one: (-one.change, one.name)):
        if len(chosen) < most and not touched & each.leaves:
            chosen.append(each)
            touched |= each.leaves - {0}
    return chosen


class Look:
    """What a person sees who holds a result against the truth.

    Attributes:
        leaf: (D,) the leaf that each mask shows; 0 = none, 65535 = not judged.
        size: pixels of each leaf, in all views.
        home: {leaf: the instance that is that leaf}.
        owner: {instance: the leaf that most of its pixels show}.
        iou: {leaf: IoU with its home over all views}.
    """

    def __init__(self, masks: Masks, truth: Sequence[Labels], scene: Scene, doubts: Sequence[MaskQuestion]) -> None:
        self.masks, self.truth, self.scene = masks, truth, scene
        count = 1 + max(int(labels[labels != IGNORE_LABEL].max(initial=0)) for labels in truth)
        self.visible = np.stack([np.bincount(labels.ravel(), minlength=IGNORE_LABEL + 1)[:count] for labels in truth])
        self.visible[:, 0] = 0
        self.size = self.visible.sum(0)
        self.shares = np.zeros((len(masks), count), np.int64)  # pixels of each leaf under each mask; 0: of none
        for row, (labels, mask) in enumerate(region_crops(masks.regions, truth)):
            self.shares[row] = np.bincount(labels[mask], minlength=IGNORE_LABEL + 1)[:count]
        self.leaf = true_instances(masks.regions, truth).numpy()
        self.ids, self.views = masks.instance_ids.numpy(), masks.view_index.numpy()
        self.doubts = doubts
        self._find_homes()

    def _find_homes(self) -> None:
        self.owner: dict[int, int] = {}
        self.home: dict[int, int] = {}
        self.iou: dict[int, float] = {}
        for instance in np.unique(self.ids[self.ids > 0]).tolist():
            own = self.shares[self.ids == instance].sum(0)
            self.owner[instance] = int(own.argmax())
            leaf = self.owner[instance]
            iou = float(own[leaf] / max(own.sum() + self.size[leaf] - own[leaf], 1)) if leaf else 0.0
            if iou > self.iou.get(leaf, 0.0):
                self.home[leaf], self.iou[leaf] = instance, iou

    def place(self, row: int) -> tuple[str, float, float]:
        """Where a person clicks to name a mask: where it is widest, and no smaller one lies on it."""
        regions, view = self.masks.regions, int(self.views[row])
        x1, y1, x2, y2 = regions.boxes[row].tolist()
        free = regions.crop(row).numpy().copy()
        for other in np.flatnonzero(self.views == view).tolist():
            if other != row and regions.areas[other] < regions.areas[row]:
                a, b, c, d = regions.boxes[other].tolist()
                low_x, low_y, high_x, high_y = max(a, x1), max(b, y1), min(c, x2), min(d, y2)
                if low_x < high_x and low_y < high_y:
                    part = regions.crop(other).numpy()[low_y - b : high_y - b, low_x - a : high_x - a]
                    free[low_y - y1 : high_y - y1, low_x - x1 : high_x - x1] &= ~part
        shown = free if free.any() else regions.crop(row).numpy()
        depth = np.asarray(cv2.distanceTransform(np.pad(shown, 1).astype(np.uint8), cv2.DIST_L2, 5))
        y, x = np.unravel_index(int(depth.argmax()), depth.shape)
        (xy,) = self._to_photo(view, np.array([[x1 + x - 0.5, y1 + y - 0.5]]))
        return (self.scene.views[view].name, float(xy[0]), float(xy[1]))

    def outline(self, leaf: int, view: int) -> Outline:
        """The largest visible piece of a leaf, drawn by hand."""
        shown = np.pad(self.piece(leaf, view), 1).astype(np.uint8)
        lines, _ = cv2.findContours(shown, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        points = np.asarray(cv2.approxPolyDP(max(lines, key=len), OUTLINE_PX, True)[:, 0] - 0.5, np.float64)
        if len(points) < 3:
            x, y, w, h = cv2.boundingRect(max(lines, key=len))
            points = np.array([[x, y], [x + w, y], [x + w, y + h], [x, y + h]]) - 1.0
        polygon = [(float(x), float(y)) for x, y in self._to_photo(view, points)]
        return Outline(view=self.scene.views[view].name, polygon=tuple(polygon), leaf=f"leaf {leaf}")

    def piece(self, leaf: int, view: int) -> NDArray[np.bool_]:
        """(H, W) the largest piece of what a photo shows of a leaf."""
        count, pieces, stats, _ = cv2.connectedComponentsWithStats((self.truth[view] == leaf).astype(np.uint8))
        return np.asarray(pieces == (1 + int(stats[1:, cv2.CC_STAT_AREA].argmax()) if count > 1 else -1))

    def inside(self, view: int, outline: NDArray[np.float64]) -> NDArray[np.bool_]:
        """(H, W) the pixels in an outline of the queue."""
        frame = np.zeros(self.truth[view].shape, np.uint8)
        cv2.fillPoly(frame, [np.round(outline - 0.5).astype(np.int32)], 1)
        return frame > 0

    def middle(self, view: int, outline: NDArray[np.float64]) -> tuple[float, float]:
        """Where a person clicks in an outline."""
        inside = np.pad(self.inside(view, outline), 1).astype(np.uint8)
        depth = np.asarray(cv2.distanceTransform(inside, cv2.DIST_L2, 5))
        y, x = np.unravel_index(int(depth.argmax()), depth.shape)
        (xy,) = self._to_photo(view, np.array([[x - 0.5, y - 0.5]]))
        return float(xy[0]), float(xy[1])

    def pixel(self, view: int, xy: Sequence[float]) -> tuple[int, int, int]:
        """View, column and row that a point of a photo lies in, within the frame."""
        lens, (height, width) = self.scene.views[view].lens, self.truth[view].shape
        point = np.array([xy], np.float64)
        point = point if lens is None else pinhole_from_photo(lens, self.scene.cameras.K[view].numpy(), point)
        column, row = np.floor(point[0]).astype(int).clip(0, (width - 1, height - 1)).tolist()
        return view, column, row

    def draw(self, view: int, outline: NDArray[np.float64], word: str | None = None) -> Outline:
        """An outline of the queue, kept as it is."""
        polygon = tuple((float(x), float(y)) for x, y in self._to_photo(view, outline))
        return Outline(view=self.scene.views[view].name, polygon=polygon, leaf=word)

    def point(self, doubt: MaskQuestion) -> tuple[float, float]:
        """Where a question points at."""
        return self.middle(doubt.view, doubt.outlines[0][1]) if doubt.outlines else self.place(doubt.region)[1:]

    def _to_photo(self, view: int, xy: NDArray[np.floating]) -> NDArray[np.floating]:
        lens = self.scene.views[view].lens
        return xy if lens is None else photo_from_pinhole(lens, self.scene.cameras.K[view].numpy(), xy)

    @property
    def right(self) -> frozenset[int]:
        """The leaves that are right."""
        return frozenset(leaf for leaf, iou in self.iou.items() if iou > RIGHT_IOU)


def list_answers(look: Look, edits: Sequence[Edit] = ()) -> list[Answer]:
    """The true answers to the questions of the page, with the edits that its keys make; as the page does, without those
    that `edits` point at. Where no answer is quite true, and where a leaf is asked about that has another number
    already, the person goes on to the next."""
    found, said = [], _said(look, edits)
    for each in (doubt for doubt in look.doubts if not _is_answered(look, doubt, said)):
        made, leaves = _answer_outlines(look, each) if each.outlines else _answer_mask(look, each)
        if made:
            at = made[0].polygon[0] if isinstance(made[0], Outline) else look.point(each)
            name = f"{each.kind} {look.scene.views[each.view].name} {at[0]:.0f} {at[1]:.0f}"
            found.append(Answer(name, made, each.change, frozenset(leaves)))
    return found


def _said(look: Look, edits: Sequence[Edit]) -> list[tuple[int, int, int]]:
    """View, column and row of all that edits point at."""
    names, found = [view.name for view in look.scene.views], []
    for edit in edits:
        if isinstance(edit, Link):
            found += [look.pixel(names.index(name), xy) for name, *xy in edit.at]
        elif isinstance(edit, Outline):
            view = names.index(edit.view)
            polygon = np.array([look.pixel(view, point)[1:] for point in edit.polygon], np.float64) + 0.5
            found.append(look.pixel(view, look.middle(view, polygon)))
        elif isinstance(edit, Reject | Confirm | Split):
            found.append(look.pixel(names.index(edit.view), edit.at))
    return found


def _is_answered(look: Look, doubt: MaskQuestion, said: Sequence[tuple[int, int, int]]) -> bool:
    for view, outline in doubt.outlines:
        inside = look.inside(view, outline)
        if any(where == view and inside[row, column] for where, column, row in said):
            return True
    if doubt.outlines:
        return False
    x1, y1, x2, y2 = look.masks.regions.boxes[doubt.region].tolist()
    crop = look.masks.regions.crop(doubt.region)
    return any(
        view == doubt.view and x1 <= column < x2 and y1 <= row < y2 and bool(crop[row - y1, column - x1])
        for view, column, row in said
    )


def _answer_mask(look: Look, doubt: MaskQuestion) -> tuple[tuple[Edit, ...], set[int]]:
    """Of a question about a mask."""
    leaf, view = int(look.leaf[doubt.region]), look.place(doubt.region)
    if leaf == IGNORE_LABEL:
        return (), set()
    if leaf == 0:
        instance = int(look.ids[doubt.region])
        owner = look.owner.get(instance, 0)
        return (Reject(view=view[0], at=view[1:], everywhere=instance > 0 and owner == 0),), {owner}
    if doubt.other < 0:
        return (Confirm(view=view[0], at=view[1:]),), {leaf}
    other = int(look.leaf[doubt.other])
    if other in (0, IGNORE_LABEL):
        return (), set()
    edit = Link(op="same" if leaf == other else "different", at=(view, look.place(doubt.other)))
    return (edit,), {leaf, other}


def _answer_outlines(look: Look, doubt: MaskQuestion) -> tuple[tuple[Edit, ...], set[int]]:
    """Of a question about what has no mask: a leaf that should be there, or a candidate."""
    shown = [_leaf_inside(look, view, outline) for view, outline in doubt.outlines]
    view, outline = doubt.outlines[0]
    no = Reject(view=look.scene.views[view].name, at=look.middle(view, outline), everywhere=doubt.kind == "leaf")
    if doubt.kind == "place":
        leaf, (share, iou) = look.owner.get(doubt.instance, 0), (0.0, 0.0)
        if leaf:
            share, iou = _overlap(look, view, outline, leaf)
        if leaf and iou > SHOWN and doubt.other >= 0:
            drawn = look.draw(view, outline)
            same = Link(op="same", at=((drawn.view, *look.middle(view, outline)), look.place(doubt.other)))
            return (drawn, same), {leaf}
        return ((no,), {leaf}) if share < LEAST_REPAIR else ((), set())
    leaf = max(shown, key=shown.count)
    if not any(shown):
        return (no,), {0}
    if not leaf or 2 * shown.count(leaf) <= len(shown) or leaf in look.home:
        return (), set()
    word = f"offered {no.view} {no.at[0]:.0f} {no.at[1]:.0f}"
    return tuple(look.draw(view, outline, word) for view, outline in doubt.outlines), {leaf}


def _overlap(look: Look, view: int, outline: NDArray[np.float64], leaf: int) -> tuple[float, float]:
    """The share of what an outline holds that is a leaf, and their IoU."""
    inside, true = look.inside(view, outline), look.truth[view] == leaf
    both = float((inside & true).sum())
    return both / max(inside.sum(), 1), both / max((inside | true).sum(), 1)


def _leaf_inside(look: Look, view: int, outline: NDArray[np.float64]) -> int:
    """The leaf that an outline shows; 0 for none."""
    counts = np.bincount(look.truth[view][look.inside(view, outline)], minlength=IGNORE_LABEL + 1)
    counts[[0, IGNORE_LABEL]] = 0
    leaf = int(counts.argmax())
    return leaf if counts[leaf] and _overlap(look, view, outline, leaf)[1] > SHOWN else 0
