"""Edits become masks and links.

In the order of the list, each edit finds the masks that it points at as the edits before it left them. What concerns
whole instances (`everywhere`) waits until they are known: see `mvseg.corrections.corrected.apply_everywhere`.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from mvseg.corrections.corrected import APPLIED, CONTRADICTED, NOTHING, PASSED, Corrected, Fate, Refused, Whole
from mvseg.corrections.edited_mask import EditedMask, as_table, hang_together, side_of
from mvseg.corrections.file import Confirm, Corrections, Edit, Link, Outline, Place, Point, Reject, Split, TrackLink
from mvseg.corrections.numbers import EDITS
from mvseg.crop import Crop
from mvseg.errors import InputError
from mvseg.formats.coco import decode_segmentation
from mvseg.formats.find_views import find_views
from mvseg.formats.lens import pinhole_from_photo, undistort
from mvseg.masks import Masks, Origin
from mvseg.matching.links import Links
from mvseg.regions import Regions
from mvseg.scene import Scene


class _Tie(NamedTuple):
    """What an edit says of two masks: that they must, or cannot, show one leaf."""

    edit: int
    must: bool
    one: EditedMask
    other: EditedMask


class _About(NamedTuple):
    """An edit about the whole instance of a mask."""

    edit: int
    mask: EditedMask
    rejects: bool


@dataclass(eq=False)
class _Work:
    """All that edits change."""

    scene: Scene
    masks: list[EditedMask]
    fates: dict[int, Fate] = field(default_factory=dict)
    ties: list[_Tie] = field(default_factory=list)
    everywhere: list[_About] = field(default_factory=list)
    words: dict[str, list[tuple[int, EditedMask]]] = field(default_factory=dict)
    rejected: list[tuple[int, EditedMask]] = field(default_factory=list)  # in one photo, by which edit
    refused: list[Refused] = field(default_factory=list)

    def is_rejected(self, mask: EditedMask) -> bool:
        """Whether it only stays to tell which instance is rejected."""
        return any(each.rejects and each.mask is mask for each in self.everywhere)


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
    views = regions.view_index.tolist()
    rows = range(len(masks))
    work = _Work(scene, [EditedMask(views[n], regions.placed(n), n, origins[n]) for n in rows])
    for number, edit in enumerate(corrections.edits, start=1):
        try:
            work.fates[number] = Fate(number, edit.op, PASSED if isinstance(edit, TrackLink) else APPLIED)
            _apply_one(work, number, edit)
        except _Lost as error:
            work.fates[number] = Fate(number, edit.op, NOTHING, str(error))
    for outlines in work.words.values():
        alive = [(number, mask) for number, mask in outlines if mask in work.masks]
        work.ties += [_Tie(number, True, alive[0][1], mask) for number, mask in alive[1:]]
    _clear_outlines(work.masks)
    order = sorted(work.masks, key=lambda mask: mask.view)
    place = {mask: n for n, mask in enumerate(order)}
    links = _agreeing_links(work, place)
    is_linked, links = links.named(len(order)), _keep_outlines_apart(links, order)
    table = replace(as_table(masks, order), is_linked=is_linked)
    if len(links.must):
        component = links.components(len(order))
        _tell_of_parts(work, place, component)
        first = np.unique(component, return_index=True)[1]
        table = replace(table, classes=table.classes[first[component]])  # those of different classes are never matched
    everywhere = tuple(
        Whole(each.edit, place[each.mask], each.rejects) for each in work.everywhere if each.mask in place
    )
    last_edits = torch.tensor([max(mask.edits, default=0) for mask in order], dtype=torch.int64)
    return Corrected(
        masks=table,
        links=links,
        last_edits=last_edits,
        everywhere=everywhere,
        refused=tuple(work.refused),
        fates=tuple(work.fates.values()),
    )


def is_on(edit: Edit, regions: Regions, rows: Sequence[int], *, scene: Scene) -> bool:
    """Whether an edit, not an outline, points at one of these masks."""
    places = edit.at if isinstance(edit, Link) else ()
    if isinstance(edit, (Reject, Confirm, Split)):
        places = ((edit.view, *edit.at),)
    work = _Work(scene, [])
    for place in places:
        with suppress(_Lost):
            if set(rows) & set(regions.at(*_pixel_at(work, place))):
                return True
    return False


def _apply_one(work: _Work, number: int, edit: Edit) -> None:
    if isinstance(edit, Outline):
        _outline(work, number, edit)
    elif isinstance(edit, Reject):
        place = edit.view, *edit.at
        pixel = _pixel_at(work, place)
        if not _masks_at(work, place, work.masks):
            work.refused.append(Refused(number, *pixel, edit.everywhere))
        mask = _mask_at(work, place)
        if edit.everywhere:
            _contradict(work, number, mask.edits)
            work.everywhere.append(_About(number, mask, True))
        else:
            _remove(work, number, mask)
            work.rejected.append((number, mask))
    elif isinstance(edit, Confirm):
        mask = _kept_mask_at(work, number, (edit.view, *edit.at))
        mask.origin = mask.origin if mask.origin >= Origin.CORRECTED else int(Origin.CONFIRMED)
        mask.edits.append(number)
        if edit.everywhere:
            work.everywhere.append(_About(number, mask, False))
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
    crop = Crop.of(frame)
    covered = []
    for mask in [each for each in work.masks if each.view == view and not work.is_rejected(each)]:
        if mask.crop.intersect(crop).area > EDITS.covered * mask.crop.area:
            covered.append(mask)
    row = max(covered, key=lambda mask: mask.crop.area).row if covered else -1
    for mask in covered:
        _remove(work, number, mask)
    if len(covered) > EDITS.most_covered:
        work.fates[number] = Fate(number, edit.op, APPLIED, f"it replaces {len(covered)} masks")
    made = EditedMask(view, crop, row, int(Origin.CORRECTED), [number])
    work.masks.append(made)
    if edit.leaf is not None:
        work.words.setdefault(edit.leaf, []).append((number, made))


def _clear_outlines(masks: Sequence[EditedMask]) -> None:
    """A pixel shows one leaf: what lies in an outline is taken from every mask drawn before it."""
    for n, drawn in enumerate(masks):
        for mask in masks[:n] if drawn.origin == Origin.CORRECTED else []:
            both = mask.crop.intersect(drawn.crop) if mask.view == drawn.view else None
            if both is not None and 0 < both.area < mask.crop.area:
                mask.crop = Crop(mask.crop.box, mask.crop.pixels & ~both.pixels).tighten()


def _split(work: _Work, number: int, edit: Split) -> None:
    mask = _kept_mask_at(work, number, (edit.view, *edit.at))
    line = _to_pinhole(work.scene, mask.view, edit.line)
    if np.ptp(line, axis=0).max() < 1:
        raise _Lost("its line is a point")
    pixels, is_left = mask.crop.pixels, side_of(line, mask.crop)
    halves = [replace(mask.crop, pixels=pixels & side) for side in (is_left, ~is_left)]
    if not all(half.area for half in halves):
        raise _Lost("its line does not cut the mask")
    parts = [EditedMask(mask.view, half.tighten(), mask.row, int(Origin.CUT), [number]) for half in halves]
    _remove(work, number, mask)
    work.masks += parts
    work.ties.append(_Tie(number, False, parts[0], parts[1]))


def _link(work: _Work, number: int, edit: Link) -> None:
    found = [_kept_mask_at(work, number, place) for place in edit.at]
    masks = list(dict.fromkeys(found))
    for mask in masks:
        mask.edits.append(number)
    if edit.op == "same":
        work.ties += [_Tie(number, True, masks[0], mask) for mask in masks[1:]]
    elif len(masks) < len(found):
        raise _Lost("two of its places show the same mask: split it")
    else:
        work.ties += [_Tie(number, False, one, other) for n, one in enumerate(masks) for other in masks[:n]]


def _tell_of_parts(work: _Work, place: dict[EditedMask, int], component: NDArray[np.int64]) -> None:
    """Masks of one photo that edits say are one leaf, but do not touch: the last of these edits says so."""
    groups: dict[tuple[int, int], list[EditedMask]] = {}
    for mask, row in place.items():
        groups.setdefault((int(component[row]), mask.view), []).append(mask)
    for (group, view), masks in groups.items():
        edits = [tie.edit for tie in work.ties if tie.must and tie.one in place and component[place[tie.one]] == group]
        if edits and not hang_together(masks):
            message = f"a contradiction: its masks in view {work.scene.views[view].name} do not touch"
            work.fates[max(edits)] = replace(work.fates[max(edits)], problem=message)


def _agreeing_links(work: _Work, place: dict[EditedMask, int]) -> Links:
    """The links that hold, of rows: the latest first, and none that contradicts those. The edit of one that does not
    hold is contradicted by the latest edit without which it would; or by itself."""
    ties = [each for each in work.ties if each.one in place and each.other in place]

    def links_of(edits: Collection[int]) -> Links | None:
        said = [each for each in ties if each.edit in edits]
        must, cannot = (
            [(place[each.one], place[each.other]) for each in said if each.must is kind] for kind in (True, False)
        )
        links = Links.of(must, cannot)
        with suppress(InputError):
            links.components(len(place))
            return links
        return None

    edits = sorted({each.edit for each in ties}, reverse=True)
    if (links := links_of(edits)) is not None:
        return links
    held: list[int] = []
    links = Links.of()
    for number in edits:
        agreeing = links_of([*held, number])
        if agreeing is not None:
            links, held = agreeing, [*held, number]
        elif links_of([number]) is None:
            _contradict(work, number, [number])
        else:
            culprits = (later for later in held if links_of({number, *held} - {later}) is not None)
            _contradict(work, next(culprits, max(held)), [number])
    return links


def _keep_outlines_apart(links: Links, masks: Sequence[EditedMask]) -> Links:
    """An outline is a leaf: other masks of its photo show other ones, but for those that links join to it."""
    component, views = links.components(len(masks)), np.array([mask.view for mask in masks], np.int64)
    is_drawn = np.array([mask.origin == Origin.CORRECTED for mask in masks], bool)
    apart = is_drawn[:, None] & (views[:, None] == views) & (component[:, None] != component)
    pairs = np.argwhere(np.triu(apart | apart.T))
    return replace(links, cannot=torch.cat((links.cannot, torch.from_numpy(pairs))))


def _remove(work: _Work, number: int, mask: EditedMask) -> None:
    """Take a mask away; the edits that made it, or linked it, are contradicted."""
    work.masks.remove(mask)
    linked = [each.edit for each in work.ties if mask in (each.one, each.other)]
    about = [each.edit for each in work.everywhere if each.mask is mask]
    _contradict(work, number, [*mask.edits, *linked, *about])


def _contradict(work: _Work, number: int, edits: Sequence[int]) -> None:
    for earlier in edits:
        work.fates[earlier] = replace(work.fates[earlier], fate=CONTRADICTED.format(number))


def _mask_at(work: _Work, place: Place) -> EditedMask:
    """The mask at a place: what a person outlined there, or else the smallest one, as it would be drawn on top."""
    here = _masks_at(work, place, work.masks)
    if not here:
        name, x, y = place
        raise _Lost(f"there is no mask at ({x:g}, {y:g}) in view {name}")
    return min(here, key=lambda mask: (work.is_rejected(mask), mask.origin != Origin.CORRECTED, mask.crop.area))


def _kept_mask_at(work: _Work, number: int, place: Place) -> EditedMask:
    """The same for an edit that says something of a leaf: a mask that was rejected there comes back, if there is no
    other, and its rejection is contradicted. The later edit wins."""
    gone = _masks_at(work, place, [mask for _, mask in work.rejected])
    if gone and not _masks_at(work, place, work.masks):
        work.masks.append(gone[-1])
    mask = _mask_at(work, place)
    _contradict(work, number, [n for n, other in work.rejected if other is mask])
    _contradict(work, number, [each.edit for each in work.everywhere if each.rejects and each.mask is mask])
    work.rejected = [each for each in work.rejected if each[1] is not mask]
    work.everywhere = [each for each in work.everywhere if each.mask is not mask or not each.rejects]
    return mask


def _masks_at(work: _Work, place: Place, masks: Sequence[EditedMask]) -> list[EditedMask]:
    """Those of these masks that a place lies in."""
    view, column, row = _pixel_at(work, place)
    return [mask for mask in masks if mask.view == view and mask.crop.holds(column, row)]


def _pixel_at(work: _Work, place: Place) -> tuple[int, int, int]:
    """View, column and row of a place in the undistorted photo."""
    name, x, y = place
    view = _view(work.scene, name)
    column, row = np.floor(_to_pinhole(work.scene, view, [(x, y)])[0]).astype(int).tolist()
    return view, column, row


def _view(scene: Scene, name: str) -> int:
    """The index of the view that a name refers to, see `find_views`."""
    with suppress(InputError):  # it fits several
        (view,) = find_views([name], scene, source=Path("corrections"))
        if view is not None:
            return view
    raise _Lost(f"there is no view {name[:60]!r}")


def _to_pinhole(scene: Scene, view: int, points: Sequence[Point]) -> NDArray[np.float64]:
    """(P, 2) points of a photo in its undistorted pixels."""
    xy, lens = np.array(points, np.float64), scene.views[view].lens
    if lens is not None:
        xy = pinhole_from_photo(lens, scene.cameras.K[view].cpu().numpy(), xy)
    if not np.isfinite(xy).all():
        raise _Lost("the lens shows nothing there")
    return xy.clip(-1e6, 1e6)
