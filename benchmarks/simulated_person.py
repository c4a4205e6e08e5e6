"""A person who knows the truth, and says what is wrong in a result edit by edit: see `benchmarks/corrections.py`.

What an edit repairs is estimated as if all that it says came true: masks that are the same bring their instances
together, and a leaf that is outlined in two photos is found in all others.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from mvseg.corrections.doubtful import Doubt
from mvseg.corrections.edited_mask import side_of
from mvseg.corrections.file import Confirm, Edit, Link, Outline, Reject, Split
from mvseg.crop import Crop
from mvseg.evaluation.panoptic import RIGHT_IOU
from mvseg.evaluation.truth import region_crops, shown_instances
from mvseg.formats.lens import photo_from_pinhole, pinhole_from_photo
from mvseg.masks import Masks, Origin
from mvseg.regions import IGNORE_LABEL
from mvseg.scene import Scene

Order = Literal["repair", "ask"]
Labels = NDArray[np.uint16]

COSTS = {"outline": 3}  # of an edit; any other is 1
ANSWER = "answer"  # how the name of an answer to a question begins
LEAST_REPAIR = 0.03  # of a leaf's pixels, from which an edit is worth the while
LOST = 0.25  # IoU below which a leaf is drawn anew, in two photos
SHOWN = 0.5  # IoU from which a mask is left as it is; share of a leaf that a mask must cover to be worth a cut
FALSE_LEAF, FALSE_MASK = 0.1, 0.06  # what it is worth to be rid of a leaf that is none, and of a lone mask; in leaves
OUTLINE_PX = 1.5  # that a drawn outline is off


@dataclass(frozen=True)
class Repair:
    """Edits that belong together, with what they bring.

    Attributes:
        name: what they do; the same repair has the same name whatever the ids and rows of a result are.
        edits: in their order.
        gain: estimated, in leaves.
        doubt: of what they concern, as the queue has it; 0 = the queue does not ask.
        leaves: true leaves concerned, 0 for what is none: no two repairs of a round concern the same ones.
    """

    name: str
    edits: tuple[Edit, ...]
    gain: float
    doubt: float
    leaves: frozenset[int]

    @property
    def cost(self) -> int:
        return count_worth([edit.model_copy(update={"by": self.name}) for edit in self.edits])


def count_worth(edits: Sequence[Edit]) -> int:
    """What edits cost a person; all those of one answer cost 1."""
    answers = {edit.by for edit in edits if str(edit.by).startswith(ANSWER)}
    return len(answers) + sum(COSTS.get(edit.op, 1) for edit in edits if edit.by not in answers)


def choose_repairs(
    found: Sequence[Repair], *, order: Order, worth: tuple[int, int], done: Collection[str]
) -> list[Repair]:
    """Repairs for the next round: those that repair most for their cost first; answers in the order of their questions
    ("ask"). What they cost together is at most `worth[0]`; a single one may cost `worth[1]`."""

    def key(each: Repair) -> tuple[float, ...]:
        rate = each.gain / each.cost
        return (-round(rate, 2), -each.doubt) if order == "repair" else (-each.doubt, -rate)

    chosen: list[Repair] = []
    touched: set[int] = set()
    for each in sorted((one for one in found if one.name not in done), key=lambda one: (*key(one), one.name)):
        left = worth[0] - sum(one.cost for one in chosen) if chosen else worth[1]
        if each.cost <= left and not touched & each.leaves:
            chosen.append(each)
            touched |= each.leaves - {0}
    return chosen


class Look:
    """What a person sees who holds a result against the truth.

    Attributes:
        leaf: (D,) the leaf that each mask shows; 0 = none, 65535 = not judged.
        overlap: (D,) pixels of it.
        size: pixels of each leaf, in all views.
        home: {leaf: the instance that is that leaf}.
        owner: {instance: the leaf that most of its pixels show}.
        iou: {leaf: IoU with its home over all views}.
        second: (D,) the second leaf that a mask shows and no other mask does; 0 = none.
    """

    def __init__(self, masks: Masks, truth: Sequence[Labels], scene: Scene, doubts: Sequence[Doubt]) -> None:
        self.masks, self.truth, self.scene = masks, truth, scene
        count = 1 + max(int(labels[labels != IGNORE_LABEL].max(initial=0)) for labels in truth)
        self.visible = np.stack([np.bincount(labels.ravel(), minlength=IGNORE_LABEL + 1)[:count] for labels in truth])
        self.visible[:, 0] = 0
        self.size = self.visible.sum(0)
        self.shares = np.zeros((len(masks), count), np.int64)  # pixels of each leaf under each mask; 0: of none
        for row, (labels, mask) in enumerate(region_crops(masks.regions, truth)):
            self.shares[row] = np.bincount(labels[mask], minlength=IGNORE_LABEL + 1)[:count]
        self.leaf = shown_instances(masks.regions, truth).numpy()
        judged = np.where(self.leaf == IGNORE_LABEL, 0, self.leaf)
        self.overlap = self.shares[np.arange(len(masks)), judged]
        self.ids, self.views = masks.instance_ids.numpy(), masks.view_index.numpy()
        self.area = self.shares.sum(1)  # without pixels that the truth ignores
        self._find_homes()
        self.second = np.zeros(len(masks), np.int64)
        self._find_merged()
        self.doubt_of_row = {each.region: each.doubt for each in reversed(doubts) if each.region >= 0}
        self.doubts = doubts
        self.doubt_of_gap = {(each.view, each.instance): each.doubt for each in doubts if each.kind in GAPS}

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

    def _find_merged(self) -> None:
        for row, (view, leaf) in enumerate(zip(self.views.tolist(), self.leaf.tolist(), strict=True)):
            shares = self.shares[row].copy()
            shares[[0] if leaf == IGNORE_LABEL else [0, leaf]] = 0
            second = int(shares.argmax())
            is_shown = bool(((self.views == view) & (self.leaf == second)).any())
            if (
                leaf not in (0, IGNORE_LABEL)
                and not is_shown
                and shares[second] >= SHOWN * self.visible[view, second] > 0
            ):
                self.second[row] = second

    def anchor(self, leaf: int, *, but: int = -1) -> int:
        """The row of the mask that shows a leaf best in its home; -1 for none."""
        rows = np.flatnonzero((self.ids == self.home.get(leaf, 0)) & (self.leaf == leaf) & (self.views != but))
        return self.best(rows)

    def best(self, rows: NDArray[np.int64]) -> int:
        """Of some masks the one that a person clicks at: large, not one that only other views show, and not one that is
        to be cut."""
        if not len(rows):
            return -1
        is_poor = (self.masks.origin.numpy()[rows] == Origin.OTHER_VIEWS) | (self.second[rows] > 0)
        return int(rows[(self.overlap[rows] * np.where(is_poor, 0.01, 1)).argmax()])

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

    def cut_off(self, row: int, line: NDArray[np.float64], second: int) -> float:
        """Pixels of the mask's second leaf on its side of a line, less those of others that go with them."""
        x1, y1, x2, y2 = (int(each) for each in self.masks.regions.boxes[row])
        crop = Crop((x1, y1, x2, y2), self.masks.regions.crop(row))
        is_left, shown = side_of(line, crop).numpy(), crop.pixels.numpy()
        is_second = self.truth[int(self.views[row])][y1:y2, x1:x2] == second
        sides = (shown & is_left, shown & ~is_left)
        return float(max(int((side & is_second).sum()) - int((side & ~is_second).sum()) for side in sides))

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

    def point(self, doubt: Doubt) -> tuple[float, float]:
        """Where a question points at."""
        return self.middle(doubt.view, doubt.outlines[0][1]) if doubt.outlines else self.place(doubt.region)[1:]

    def _to_photo(self, view: int, xy: NDArray[np.floating]) -> NDArray[np.floating]:
        lens = self.scene.views[view].lens
        return xy if lens is None else photo_from_pinhole(lens, self.scene.cameras.K[view].numpy(), xy)

    @property
    def right(self) -> frozenset[int]:
        """The leaves that are right."""
        return frozenset(leaf for leaf, iou in self.iou.items() if iou > RIGHT_IOU)

    def worth(self, leaf: int, share: float) -> float:
        """What more of a leaf is worth: a leaf that becomes right counts half a leaf more."""
        before = self.iou.get(leaf, 0.0)
        return min(share, 1 - before) + 0.5 * (before <= RIGHT_IOU < before + share)

    def doubt(self, rows: Sequence[int] | NDArray[np.int64]) -> float:
        return max((self.doubt_of_row.get(int(row), 0.0) for row in rows), default=0.0)


GAPS = ("missing", "covered")


def list_repairs(look: Look) -> list[Repair]:
    """All that is wrong and worth the while, with the edits that say so."""
    found = [*_join_and_reject(look), *_move(look), *_cut(look), *_draw(look)]
    return [each for each in found if each.gain >= LEAST_REPAIR]


def _join_and_reject(look: Look) -> list[Repair]:
    """Instances, and masks that were matched to nothing: parts of a leaf that is another instance, or no leaves."""
    found = []
    groups = [np.flatnonzero(look.ids == instance) for instance in look.owner]
    groups += [np.array([row]) for row in np.flatnonzero(look.ids < 1)]
    for rows in groups:
        own = look.shares[rows].sum(0)
        leaf, instance = int(own.argmax()), int(look.ids[rows[0]])
        if not own.sum() or instance == look.home.get(leaf, 0):
            continue
        false = FALSE_LEAF if instance > 0 else FALSE_MASK
        row = look.best(rows[look.leaf[rows] == leaf] if (look.leaf[rows] == leaf).any() else rows)
        if look.second[row]:
            continue
        name, x, y = look.place(row)
        if leaf == 0:
            edit: Edit = Reject(view=name, at=(x, y), everywhere=len(rows) > 1)
            found.append(Repair(f"reject {name} {x:.0f} {y:.0f}", (edit,), false, look.doubt(rows), frozenset({0})))
            continue
        anchor = look.anchor(leaf)
        if anchor >= 0:
            edit = Link(op="same", at=(look.place(anchor), (name, x, y)))
            gain = look.worth(leaf, float(own[leaf] / look.size[leaf])) + false
            found.append(Repair(f"same {leaf} in {name}", (edit,), gain, look.doubt(rows), frozenset({leaf})))
    return found


def _move(look: Look) -> list[Repair]:
    """Masks in the instance of another leaf."""
    found = []
    for row, (instance, leaf) in enumerate(zip(look.ids.tolist(), look.leaf.tolist(), strict=True)):
        owner = look.owner.get(instance, 0)
        if owner in (0, leaf) or leaf == IGNORE_LABEL or look.second[row]:
            continue
        place, dirt = look.place(row), float(look.area[row] / look.size[owner])
        if leaf == 0:
            edits: tuple[Edit, ...] = (Reject(view=place[0], at=place[1:]),)
            gain, name = look.worth(owner, dirt), f"reject {place[0]} {place[1]:.0f} {place[2]:.0f}"
        elif (anchor := look.anchor(leaf, but=int(look.views[row]))) >= 0:
            edits = (Link(op="same", at=(look.place(anchor), place)),)
            gain = look.worth(leaf, float(look.overlap[row] / look.size[leaf])) + dirt
            name = f"same {leaf} in {place[0]}"
        else:
            stays = look.best(np.flatnonzero((look.ids == instance) & (look.leaf == owner)))
            if stays < 0:
                continue
            edits = (Link(op="different", at=(look.place(stays), place)),)
            others = (look.ids == instance) & (look.leaf == leaf)
            gain = look.worth(leaf, float(look.overlap[others].sum() / look.size[leaf])) + dirt
            name = f"different {leaf} in {place[0]}"
        found.append(Repair(name, edits, gain, look.doubt([row]), frozenset({leaf, owner})))
    return found


def _cut(look: Look) -> list[Repair]:
    """Masks that show two leaves, of which no other mask shows the second."""
    found = []
    for row in np.flatnonzero(look.second).tolist():
        view, leaf, second = int(look.views[row]), int(look.leaf[row]), int(look.second[row])
        name, x, y = look.place(row)
        line = cut_line(look.truth[view], leaf, second)
        pixels = look.cut_off(row, line, second)
        if pixels <= 0:
            continue
        gain = look.worth(second, pixels / look.size[second]) + pixels / look.size[leaf]
        edit = Split(view=name, at=(x, y), line=tuple((float(a), float(b)) for a, b in look._to_photo(view, line)))
        found.append(
            Repair(f"split {leaf} {second} in {name}", (edit,), gain, look.doubt([row]), frozenset({leaf, second}))
        )
    return found


def cut_line(labels: Labels, first: int, second: int) -> NDArray[np.float64]:
    """(2, 2) two points of the line that leaves most pixels of two leaves of a photo on its two sides, nearly: through
    the middle of where they touch, across the line between the two leaves' pixels around it."""
    points = [np.argwhere(labels == leaf)[:, ::-1] + 0.5 for leaf in (first, second)]
    steps = [
        np.asarray(cv2.distanceTransform((labels != leaf).astype(np.uint8), cv2.DIST_L2, 5)) for leaf in (first, second)
    ]
    middle = np.argwhere(steps[0] + steps[1] <= (steps[0] + steps[1]).min() + 2)[:, ::-1].mean(0) + 0.5
    near = 2 * np.sqrt(min(len(each) for each in points))
    sides = []
    for each in points:
        close = each[np.hypot(*(each - middle).T) <= near]
        sides.append((close if len(close) else each).mean(0))
    across = sides[1] - sides[0]
    along = np.array([-across[1], across[0]]) / max(float(np.hypot(*across)), 1e-9)
    return np.stack([middle - 10 * along, middle + 10 * along])


def _draw(look: Look) -> list[Repair]:
    """Leaves that no mask of their photo shows well enough; one without any instance is drawn in two photos, and then
    in others."""
    found = []
    for leaf in np.flatnonzero(look.size).tolist():
        covered = np.zeros(len(look.visible))
        for row in np.flatnonzero(look.leaf == leaf).tolist():
            view = look.views[row]
            union = look.area[row] + look.visible[view, leaf] - look.overlap[row]
            covered[view] = max(covered[view], look.overlap[row] / max(union, 1))
        gaps = [view for view in np.flatnonzero(look.visible[:, leaf]).tolist() if covered[view] < SHOWN]
        gaps.sort(key=lambda view: -look.visible[view, leaf])
        anchor = look.anchor(leaf)
        iou, two = look.iou.get(leaf, 0.0), _far_apart(look, gaps)
        is_drawn = bool(((look.leaf == leaf) & look.masks.is_corrected.numpy()).any())
        if iou < LOST and two and not is_drawn:  # where the first outlines did not suffice, another view is drawn
            edits: tuple[Edit, ...] = tuple(look.outline(leaf, view) for view in two)
            found.append(Repair(f"draw {leaf}", edits, look.worth(leaf, 1 - iou), 0.0, frozenset({leaf})))
            continue
        for view in gaps:
            drawn, name = look.outline(leaf, view), look.scene.views[view].name
            edits = (drawn,)
            if anchor >= 0:
                edits += (Link(op="same", at=(look.place(anchor), (name, *_inside(look, leaf, view)))),)
            share = float((1 - covered[view]) * look.visible[view, leaf] / look.size[leaf])
            doubt = look.doubt_of_gap.get((view, look.home.get(leaf, 0)), 0.0)
            found.append(Repair(f"draw {leaf} in {name}", edits, look.worth(leaf, share), doubt, frozenset({leaf})))
    return found


def _inside(look: Look, leaf: int, view: int) -> tuple[float, float]:
    """A point of a leaf's largest piece in a photo."""
    depth = np.asarray(cv2.distanceTransform(np.pad(look.piece(leaf, view), 1).astype(np.uint8), cv2.DIST_L2, 5))
    y, x = np.unravel_index(int(depth.argmax()), depth.shape)
    (xy,) = look._to_photo(view, np.array([[x - 0.5, y - 0.5]]))
    return float(xy[0]), float(xy[1])


def _far_apart(look: Look, views: Sequence[int]) -> list[int]:
    """The view that shows a leaf largest, and of those at least 30 degrees away (or all others) the next."""
    if not views:
        return []
    ahead = look.scene.cameras.R[:, 2].numpy()  # where each camera looks
    cosines = ahead @ ahead[views[0]]
    far = [view for view in views[1:] if cosines[view] <= np.cos(np.radians(30))]
    return [views[0], *(far or views[1:])[:1]]


# --- answers


def list_answers(look: Look, edits: Sequence[Edit] = ()) -> list[Repair]:
    """The true answers to the questions of the page, with the edits that its keys make; as the page does, without those
    that `edits` point at. Where no answer is quite true, and where a leaf is asked about that has another number
    already, the person goes on to the next."""
    found, said = [], _said(look, edits)
    for each in (doubt for doubt in look.doubts if not _is_answered(look, doubt, said)):
        made, leaves = _answer_outlines(look, each) if each.outlines else _answer_mask(look, each)
        if made:
            at = made[0].polygon[0] if isinstance(made[0], Outline) else look.point(each)
            name = f"{ANSWER} {each.kind} {look.scene.views[each.view].name} {at[0]:.0f} {at[1]:.0f}"
            found.append(Repair(name, made, 1.0, each.doubt, frozenset(leaves)))
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


def _is_answered(look: Look, doubt: Doubt, said: Sequence[tuple[int, int, int]]) -> bool:
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


def _answer_mask(look: Look, doubt: Doubt) -> tuple[tuple[Edit, ...], set[int]]:
    """Of a question about a mask."""
    leaf, view = int(look.leaf[doubt.region]), look.place(doubt.region)
    owner, is_few = look.owner.get(doubt.instance, 0), doubt.kind == "few"
    if leaf == IGNORE_LABEL or (is_few and owner and look.home[owner] != doubt.instance):
        return (), set()
    if is_few or doubt.other < 0:
        is_leaf = owner if is_few else leaf
        kind = Confirm if is_leaf else Reject
        return (kind(view=view[0], at=view[1:], everywhere=is_few),), {is_leaf}
    other = int(look.leaf[doubt.other])
    if leaf == 0 and doubt.kind != "covered":
        return (Reject(view=view[0], at=view[1:]),), {owner}
    if other in (0, IGNORE_LABEL):
        return (), set()
    edit = Link(op="same" if leaf == other else "different", at=(view, look.place(doubt.other)))
    return (edit,), {leaf, other}


def _answer_outlines(look: Look, doubt: Doubt) -> tuple[tuple[Edit, ...], set[int]]:
    """Of a question about what has no mask: a leaf that should be there, or a candidate."""
    shown = [_leaf_inside(look, view, outline) for view, outline in doubt.outlines]
    view, outline = doubt.outlines[0]
    no = Reject(view=look.scene.views[view].name, at=look.middle(view, outline), everywhere=doubt.kind == "leaf")
    if doubt.kind == "missing":
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
