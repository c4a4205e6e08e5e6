"""Edits become masks and links.

In the order of the list, each edit finds the masks that it points at as the edits before it left them. What concerns
whole instances (`everywhere`) waits until they are known: see `apply_everywhere`.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mvseg.corrections.edited_mask import EditedMask, as_table, cut_out, hang_together, side_of
from mvseg.corrections.file import Confirm, Corrections, Edit, Link, Outline, Place, Point, Reject, Split, TrackLink
from mvseg.errors import InputError
from mvseg.formats.coco import decode_segmentation
from mvseg.formats.lens import pinhole_from_photo, undistort
from mvseg.masks import Masks, Origin
from mvseg.matching.links import Links
from mvseg.scene import Scene

APPLIED, NOTHING, CONTRADICTED, PASSED = "applied", "points at nothing", "contradicted by edit {}", "not of a scene"
COVERED = 0.5  # of a mask, from which an outline replaces it


@dataclass(frozen=True)
class Fate:
    """What came of an edit: its number from 1 on, its operation, and "applied", "points at nothing", "contradicted by
    edit N" or, of links between dates, "not of a scene"; `problem` says which place it was, or why."""

    edit: int
    op: str
    fate: str
    problem: str = ""


@dataclass(frozen=True, eq=False)
class Corrected:
    """Masks as edits leave them.

    Attributes:
        masks: D masks on the CPU, by view, matched to nothing.
        links: of their rows.
        last_edits: (D,) int64, number of the last edit that drew, cut or confirmed each; 0 = none.
        everywhere: (edit number, row, whether its instance is rejected) of each edit about a whole instance.
        fates: of the edits, in their order.
    """

    masks: Masks
    links: Links
    last_edits: Tensor
    everywhere: tuple[tuple[int, int, bool], ...]
    fates: tuple[Fate, ...]

    @property
    def messages(self) -> list[str]:
        """A sentence for each edit that was not applied, or is odd."""
        return [
            f"correction {each.edit} ({each.op}): {': '.join(filter(None, (each.fate, each.problem)))}"
            for each in self.fates
            if each.problem or each.fate not in (APPLIED, PASSED)
        ]


@dataclass(eq=False)
class _Work:
    """All that edits change."""

    scene: Scene
    masks: list[EditedMask]
    fates: dict[int, Fate] = field(default_factory=dict)
    links: list[tuple[int, bool, EditedMask, EditedMask]] = field(default_factory=list)  # edit, must, the two
    everywhere: list[tuple[int, EditedMask, bool]] = field(default_factory=list)
    words: dict[str, list[tuple[int, EditedMask]]] = field(default_factory=dict)

    def is_rejected(self, mask: EditedMask) -> bool:
        """Whether it only stays to tell which instance is rejected."""
        return any(rejects and other is mask for _, other, rejects in self.everywhere)


class _Lost(Exception):
    """An edit points at nothing; the message says where."""


def apply(corrections: Corrections, masks: Masks, scene: Scene) -> Corrected:
    """Apply edits to the masks of a scene, one after the other.

    Args:
        corrections: the edits; those that link dates are passed over.
        masks: D masks, detected or given; what is known of their instances is forgotten.
        scene: their scene. Points and polygons of the edits are in its photos' own pixels, with distortion.

    Returns:
        The masks, without those that were rejected or that an outline replaced, and the links. Masks that a person
        drew, cut or confirmed have an `origin` from `Origin.CORRECTED` on.
    """
    masks = masks.to("cpu")
    regions, origins = masks.regions, masks.origin.tolist()
    views, boxes = regions.view_index.tolist(), regions.boxes.tolist()
    rows = range(len(masks))
    work = _Work(scene, [EditedMask(views[n], tuple(boxes[n]), regions.crop(n), n, origins[n]) for n in rows])
    for number, edit in enumerate(corrections.edits, start=1):
        try:
            work.fates[number] = Fate(number, edit.op, PASSED if isinstance(edit, TrackLink) else APPLIED)
            _apply_one(work, number, edit)
        except _Lost as error:
            work.fates[number] = Fate(number, edit.op, NOTHING, str(error))
    for outlines in work.words.values():
        alive = [(number, mask) for number, mask in outlines if mask in work.masks]
        work.links += [(number, True, alive[0][1], mask) for number, mask in alive[1:]]
    order = sorted(work.masks, key=lambda mask: mask.view)
    place = {id(mask): n for n, mask in enumerate(order)}
    must, cannot = _agreeing_links(work, place)
    links = Links.of(must, cannot)
    table = as_table(masks, order)
    if must:
        component = torch.from_numpy(links.components(len(order)))
        _tell_of_parts(work, order, component.tolist())
        first = torch.tensor([int((component == number).nonzero()[0, 0]) for number in component.tolist()])
        table = replace(table, classes=table.classes[first])  # masks of different classes are never matched
    everywhere = tuple((n, place[id(mask)], rejects) for n, mask, rejects in work.everywhere if id(mask) in place)
    last_edits = torch.tensor([max(mask.edits, default=0) for mask in order], dtype=torch.int64)
    return Corrected(table, links, last_edits, everywhere, tuple(work.fates.values()))


def apply_everywhere(corrected: Corrected, matched: Masks) -> Masks:
    """Edits about whole instances, once these are known, in the order of the list.

    `matched`: the corrected masks with ids, in their order. The masks of a rejected instance go, but for those that
    later edits drew, cut or confirmed; those of a confirmed one are confirmed. Ids are without gaps.
    """
    goes, confirmed, _ = _decide_everywhere(corrected, matched)
    origin = matched.origin.where(~confirmed | matched.is_corrected, int(Origin.CONFIRMED))
    return replace(matched, origin=origin).select(goes == 0).close_gaps()


def fates_everywhere(corrected: Corrected, matched: Masks) -> tuple[Fate, ...]:
    """The fates of all edits, once instances are known: an edit about a whole instance contradicts earlier ones that
    drew, cut or confirmed its masks and now are rejected with it, or that rejected what it confirms."""
    goes, _, undone = _decide_everywhere(corrected, matched)
    rows = zip(corrected.last_edits.tolist(), goes.tolist(), strict=True)
    undone |= {last: number for last, number in rows if 0 < last < number}
    overridden = {edit: CONTRADICTED.format(number) for edit, number in undone.items()}
    return tuple(replace(f, fate=overridden.get(f.edit, f.fate)) if f.fate == APPLIED else f for f in corrected.fates)


def _decide_everywhere(corrected: Corrected, matched: Masks) -> tuple[Tensor, Tensor, dict[int, int]]:
    """(D,) int64, the edit by which each mask goes, 0 for none; (D,) bool, those of confirmed instances; and {edit that
    rejects an instance: the later one that confirms it}."""
    ids, goes = matched.instance_ids, torch.zeros(len(matched), dtype=torch.int64)
    confirmed = torch.zeros(len(matched), dtype=torch.bool)
    undone: dict[int, int] = {}
    for number, row, rejects in corrected.everywhere:
        own = (ids == ids[row]) if ids[row] > 0 else torch.zeros_like(confirmed)
        own[row] = True
        if rejects:
            goes[own & (corrected.last_edits < number)] = number
        else:
            undone |= dict.fromkeys(goes[own & (goes > 0)].tolist(), number)
            goes[own] = 0
            confirmed |= own
    return goes, confirmed, undone


def _apply_one(work: _Work, number: int, edit: Edit) -> None:
    if isinstance(edit, Outline):
        _outline(work, number, edit)
    elif isinstance(edit, Reject):
        mask = _mask_at(work, (edit.view, *edit.at))
        if edit.everywhere:
            _contradict(work, number, mask.edits)
            work.everywhere.append((number, mask, True))
        else:
            _remove(work, number, mask)
    elif isinstance(edit, Confirm):
        mask = _mask_at(work, (edit.view, *edit.at))
        mask.origin = mask.origin if mask.origin >= Origin.CORRECTED else int(Origin.CONFIRMED)
        _contradict(work, number, [n for n, other, rejects in work.everywhere if rejects and other is mask])
        work.everywhere = [each for each in work.everywhere if each[1] is not mask or not each[2]]
        mask.edits.append(number)
        if edit.everywhere:
            work.everywhere.append((number, mask, False))
    elif isinstance(edit, Split):
        _split(work, number, edit)
    elif isinstance(edit, Link):
        _link(work, number, edit)


def _outline(work: _Work, number: int, edit: Outline) -> None:
    view = _view(work.scene, edit.view)
    width, height = work.scene.cameras.sizes[view].tolist()
    polygon = [coordinate for point in edit.polygon for coordinate in point]
    try:
        drawn = decode_segmentation([polygon], width, height).astype(np.uint8)
    except InputError as error:
        raise _Lost(f"its polygon cannot be drawn ({error})") from None
    frame = undistort(drawn, work.scene.views[view].lens, work.scene.cameras.K[view].cpu().numpy()) > 0
    if not frame.any():
        raise _Lost(f"its polygon covers no pixel of view {edit.view}")
    box, crop = cut_out(torch.from_numpy(frame), (0, 0))
    covered = []
    for mask in [each for each in work.masks if each.view == view and not work.is_rejected(each)]:
        x1, y1, x2, y2 = mask.box
        if int((mask.crop & torch.from_numpy(frame[y1:y2, x1:x2])).sum()) > COVERED * int(mask.crop.sum()):
            covered.append(mask)
    row = max(covered, key=lambda mask: int(mask.crop.sum())).row if covered else -1
    for mask in covered:
        _remove(work, number, mask)
    made = EditedMask(view, box, crop, row, int(Origin.CORRECTED), [number])
    work.masks.append(made)
    if edit.leaf is not None:
        work.words.setdefault(edit.leaf, []).append((number, made))


def _split(work: _Work, number: int, edit: Split) -> None:
    mask = _mask_at(work, (edit.view, *edit.at))
    line = _to_pinhole(work.scene, mask.view, edit.line)
    if np.ptp(line, axis=0).max() < 1:
        raise _Lost("its line is a point")
    is_left = side_of(line, mask) & mask.crop
    if not is_left.any() or not (mask.crop & ~is_left).any():
        raise _Lost("its line does not cut the mask")
    parts = []
    for part in (is_left, mask.crop & ~is_left):
        box, crop = cut_out(part, mask.box[:2])
        parts.append(EditedMask(mask.view, box, crop, mask.row, int(Origin.CUT), [number]))
    _remove(work, number, mask)
    work.masks += parts
    work.links.append((number, False, parts[0], parts[1]))


def _link(work: _Work, number: int, edit: Link) -> None:
    found = [_mask_at(work, place) for place in edit.at]
    masks = list({id(mask): mask for mask in found}.values())
    if edit.op == "same":
        work.links += [(number, True, masks[0], mask) for mask in masks[1:]]
    elif len(masks) < len(found):
        raise _Lost("two of its places show the same mask: split it")
    else:
        work.links += [(number, False, one, other) for n, one in enumerate(masks) for other in masks[:n]]


def _tell_of_parts(work: _Work, order: Sequence[EditedMask], component: Sequence[int]) -> None:
    """Masks of one photo that edits say are one leaf, but do not touch: the last of these edits says so."""
    place = {id(mask): row for row, mask in enumerate(order)}
    groups: dict[tuple[int, int], list[EditedMask]] = {}
    for mask, number in zip(order, component, strict=True):
        groups.setdefault((number, mask.view), []).append(mask)
    for (group, view), masks in groups.items():
        edits = [n for n, m, a, _ in work.links if m and id(a) in place and component[place[id(a)]] == group]
        if edits and not hang_together(masks):
            message = f"a contradiction: its masks in view {work.scene.views[view].name} do not touch"
            work.fates[max(edits)] = replace(work.fates[max(edits)], problem=message)


def _agreeing_links(work: _Work, place: dict[int, int]) -> tuple[list[tuple[int, int]], list[tuple[int, int]]]:
    """The links that hold, as rows: the latest first, and none that contradicts those; the edit of one that does not
    hold has that fate."""
    rows = [(m, place.get(id(a)), place.get(id(b))) for _, m, a, b in work.links]
    known = [(m, a, b) for m, a, b in rows if a is not None and b is not None]
    must, cannot = [(a, b) for m, a, b in known if m], [(a, b) for m, a, b in known if not m]
    with suppress(InputError):
        Links.of(must, cannot).components(len(place))
        return must, cannot
    must, cannot = [], []
    held: list[int] = []
    for number in sorted({each[0] for each in work.links}, reverse=True):
        own = [(m, place.get(id(a)), place.get(id(b))) for n, m, a, b in work.links if n == number]
        pairs = [(is_must, a, b) for is_must, a, b in own if a is not None and b is not None]
        more_must = [(a, b) for is_must, a, b in pairs if is_must]
        more_cannot = [(a, b) for is_must, a, b in pairs if not is_must]
        try:
            Links.of(must + more_must, cannot + more_cannot).components(len(place))
        except InputError:
            _contradict(work, _culprit(work, place, number, held), [number])
            continue
        must, cannot = must + more_must, cannot + more_cannot
        held.append(number)
    return must[::-1], cannot[::-1]


def _culprit(work: _Work, place: dict[int, int], number: int, held: Sequence[int]) -> int:
    """The latest edit without which the links of edit `number` would agree with the later ones; itself, if its own
    links contradict each other."""

    def agree(edits: Collection[int]) -> bool:
        rows = [(m, place.get(id(a), -1), place.get(id(b), -1)) for n, m, a, b in work.links if n in edits]
        must, cannot = ([(a, b) for m, a, b in rows if m == kind and min(a, b) >= 0] for kind in (True, False))
        try:
            Links.of(must, cannot).components(len(place))
        except InputError:
            return False
        return True

    if not agree({number}):
        return number
    return next((later for later in held if agree({number, *held} - {later})), max(held))


def _remove(work: _Work, number: int, mask: EditedMask) -> None:
    """Take a mask away; the edits that made it, or linked it, are contradicted."""
    work.masks = [other for other in work.masks if other is not mask]
    linked = [n for n, _, a, b in work.links if mask in (a, b)] + [n for n, m, _ in work.everywhere if m is mask]
    _contradict(work, number, [*mask.edits, *linked])


def _contradict(work: _Work, number: int, edits: Sequence[int]) -> None:
    for earlier in edits:
        work.fates[earlier] = replace(work.fates[earlier], fate=CONTRADICTED.format(number))


def _mask_at(work: _Work, place: Place) -> EditedMask:
    """The smallest mask at a place, as it would be drawn on top."""
    name, x, y = place
    view = _view(work.scene, name)
    column, row = np.floor(_to_pinhole(work.scene, view, [(x, y)])[0]).astype(int).tolist()
    here = [mask for mask in work.masks if mask.view == view and mask.holds(column, row)]
    if not here:
        raise _Lost(f"there is no mask at ({x:g}, {y:g}) in view {name}")
    return min(here, key=lambda mask: (work.is_rejected(mask), int(mask.crop.sum())))


def _view(scene: Scene, name: str) -> int:
    """The index of a view by its name, with or without the suffix of its photo, or the end of its path."""
    for fits in (
        [view.name == name for view in scene.views],
        [view.name + view.path.suffix == name for view in scene.views],
        [f"/{view.path.as_posix()}".endswith(f"/{name}") for view in scene.views],
        [view.path.stem == name for view in scene.views],
    ):
        if sum(fits) == 1:
            return fits.index(True)
    raise _Lost(f"there is no view {name[:60]!r}")


def _to_pinhole(scene: Scene, view: int, points: Sequence[Point]) -> NDArray[np.float64]:
    """(P, 2) points of a photo in its undistorted pixels."""
    xy, lens = np.array(points, np.float64), scene.views[view].lens
    if lens is not None:
        xy = pinhole_from_photo(lens, scene.cameras.K[view].cpu().numpy(), xy)
    if not np.isfinite(xy).all():
        raise _Lost("the lens shows nothing there")
    return xy.clip(-1e6, 1e6)
