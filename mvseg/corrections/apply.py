"""Edits become masks and links.

In the order of the list, each edit finds the masks that it points at as the edits before it left them. What concerns
whole instances (`everywhere`) waits until they are known: see `mvseg.corrections.corrected.apply_everywhere`.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from mvseg.corrections.corrected import (
    APPLIED,
    CONTRADICTED,
    NOTHING,
    PASSED,
    Corrected,
    Fate,
    RejectedPixel,
    Whole,
    keep_latest,
)
from mvseg.corrections.edited_mask import EditedMask, Key, as_table, side_of
from mvseg.corrections.file import Confirm, Corrections, Edit, Link, Outline, Place, Point, Reject, Split, topic_of
from mvseg.corrections.numbers import EDITS
from mvseg.crop import Crop
from mvseg.errors import InputError
from mvseg.formats.coco import decode_segmentation
from mvseg.formats.find_views import find_view
from mvseg.formats.lens import pinhole_from_photo, undistort
from mvseg.masks import Masks, Origin
from mvseg.matching.links import Links
from mvseg.regions import Regions
from mvseg.scene import Scene
from mvseg.traits.stems import StemMark


class _Tie(NamedTuple):
    """Statement of an edit about two masks, by their keys: they must, or cannot, show one leaf."""

    edit: int
    must: bool
    one: Key
    other: Key


class _About(NamedTuple):
    edit: int
    mask: Key
    rejects: bool


@dataclass(frozen=True)
class _Edited:
    """A scene's masks as the edits so far leave them.

    Attributes:
        masks: in the order in which they are drawn.
        fates: {number of the edit: its fate}.
        ties: between masks, some of which may be gone.
        everywhere: about whole instances.
        words: (word for a leaf, edit, mask outlined with it).
        rejected: masks rejected in one photo, and by which edit.
        refused: rejected pixels in no mask.
    """

    masks: tuple[EditedMask, ...]
    fates: Mapping[int, Fate] = field(default_factory=dict)
    ties: tuple[_Tie, ...] = ()
    everywhere: tuple[_About, ...] = ()
    words: tuple[tuple[str, int, Key], ...] = ()
    rejected: tuple[tuple[int, EditedMask], ...] = ()
    refused: tuple[RejectedPixel, ...] = ()

    def is_rejected(self, mask: EditedMask) -> bool:
        """Whether it only stays to tell which instance is rejected."""
        return any(each.rejects and each.mask == mask.key for each in self.everywhere)

    def with_fate(self, fate: Fate) -> _Edited:
        return replace(self, fates={**self.fates, fate.edit: fate})

    def with_edit(self, number: int, keys: Collection[Key], *, origin: int | None = None) -> _Edited:
        """Masks that an edit names; they have a new origin, if there is one."""
        masks = (
            replace(mask, edits=(*mask.edits, number), origin=mask.origin if origin is None else origin)
            if mask.key in keys
            else mask
            for mask in self.masks
        )
        return replace(self, masks=tuple(masks))

    def contradict(self, number: int, edits: Collection[int]) -> _Edited:
        """An edit contradicts earlier ones."""
        fate = CONTRADICTED.format(number)
        return replace(self, fates={**self.fates, **{n: replace(self.fates[n], fate=fate) for n in edits}})

    def without(self, number: int, mask: EditedMask) -> _Edited:
        """An edit takes a mask away; those that made it, or linked it, are contradicted."""
        linked = [each.edit for each in self.ties if mask.key in (each.one, each.other)]
        about = [each.edit for each in self.everywhere if each.mask == mask.key]
        left = replace(self, masks=tuple(each for each in self.masks if each.key != mask.key))
        return left.contradict(number, [*mask.edits, *linked, *about])


class _Lost(Exception):
    """An edit points at nothing; the message says where."""


def apply(corrections: Corrections, masks: Masks, scene: Scene) -> Corrected:
    """Apply edits to the masks of a scene, one after the other. An edit that points at nothing changes nothing.

    Args:
        corrections: edits; links of dates are passed over. Points are in the photos' own pixels, with distortion.
        masks: D masks, detected or given; their ids are forgotten.

    Returns:
        The masks, without those that were rejected or that an outline replaced, and the links. Masks that the user
        drew, cut or confirmed have an `origin` from `Origin.CORRECTED` on.
    """
    masks = masks.to("cpu")
    rows = zip(masks.view_index.tolist(), masks.origin.tolist(), strict=True)
    edited = _Edited(tuple(EditedMask((0, n), view, masks.regions.placed(n), n, origin)
                           for n, (view, origin) in enumerate(rows)))  # fmt: skip
    for number, edit in enumerate(corrections.edits, start=1):
        if (topic := topic_of(edit)) != "masks":
            edited = edited.with_fate(Fate(number, edit.op, APPLIED if topic == "stem" else PASSED))
            continue
        try:
            edited = APPLY[type(edit)](edited.with_fate(Fate(number, edit.op, APPLIED)), number, edit, scene)
        except _Lost as error:
            edited = edited.with_fate(Fate(number, edit.op, NOTHING, str(error)))
    order = sorted(_clear_outlines(edited.masks), key=lambda mask: mask.view)
    place = {mask.key: n for n, mask in enumerate(order)}
    edited = replace(edited, ties=(*edited.ties, *_ties_of_words(edited.words, place)))
    edited, links = _agreeing_links(edited, place)
    is_linked, links = links.named(len(order)), _keep_outlines_apart(links, order)
    table = replace(as_table(masks, order), is_linked=is_linked)
    if len(links.must):
        component = links.components(len(order))
        first = np.unique(component, return_index=True)[1]
        table = replace(table, classes=table.classes[first[component]])  # those of different classes are never matched
    last_edits = torch.tensor([max(mask.edits, default=0) for mask in order], dtype=torch.int64)
    return Corrected(
        masks=table,
        links=links,
        last_edits=last_edits,
        everywhere=tuple(
            Whole(each.edit, place[each.mask], each.rejects) for each in edited.everywhere if each.mask in place
        ),
        refused=edited.refused,
        fates=tuple(edited.fates.values()),
    )


def read_stem_marks(corrections: Corrections | None, scene: Scene) -> dict[int, StemMark | None]:
    """{number of an edit about a stem: its statement}; None where no view shows its place."""
    marks: dict[int, StemMark | None] = {}
    for number, edit in enumerate(() if corrections is None else corrections.edits, start=1):
        if isinstance(edit, (Reject, Confirm)) and edit.stem:
            marks[number] = None
            with suppress(_Lost):
                marks[number] = StemMark(*_pixel_at(scene, (edit.view, *edit.at)), edit.op == "confirm")
    return marks


def is_on(edit: Edit, regions: Regions, rows: Sequence[int], *, scene: Scene) -> bool:
    """Whether an edit, not an outline, points at one of these masks."""
    places = edit.at if isinstance(edit, Link) else ()
    if isinstance(edit, (Reject, Confirm, Split)) and topic_of(edit) == "masks":
        places = ((edit.view, *edit.at),)
    for place in places:
        with suppress(_Lost):
            if set(rows) & set(regions.at(*_pixel_at(scene, place))):
                return True
    return False


def _confirm(edited: _Edited, number: int, edit: Confirm, scene: Scene) -> _Edited:
    edited, mask = _remaining_mask_at(edited, number, (edit.view, *edit.at), scene)
    origin = mask.origin if mask.origin >= Origin.CORRECTED else int(Origin.CONFIRMED)
    edited = edited.with_edit(number, {mask.key}, origin=origin)
    about = (_About(number, mask.key, False),) if edit.everywhere else ()
    return replace(edited, everywhere=(*edited.everywhere, *about))


def _outline(edited: _Edited, number: int, edit: Outline, scene: Scene) -> _Edited:
    view = _view(scene, edit.view)
    width, height = scene.cameras.sizes[view].tolist()
    polygon = [coordinate for point in edit.polygon for coordinate in point]
    try:
        drawn = decode_segmentation([polygon], width, height).astype(np.uint8)
    except InputError as error:
        raise _Lost(f"its polygon cannot be drawn ({error})") from None
    frame = undistort(drawn, scene.views[view].lens, scene.cameras.K[view].cpu().numpy()) > 0
    if not frame.any():
        raise _Lost(f"its polygon covers no pixel of view {edit.view}")
    crop = Crop.of(frame)
    there = [each for each in edited.masks if each.view == view and not edited.is_rejected(each)]
    covered = [mask for mask in there if mask.crop.intersect(crop).area > EDITS.covered * mask.crop.area]
    row = max(covered, key=lambda mask: mask.crop.area).row if covered else -1
    for mask in covered:
        edited = edited.without(number, mask)
    if len(covered) > EDITS.most_covered:
        edited = edited.with_fate(Fate(number, edit.op, APPLIED, f"it replaces {len(covered)} masks"))
    made = EditedMask((number, 0), view, crop, row, int(Origin.CORRECTED), (number,))
    words = () if edit.leaf is None else ((edit.leaf, number, made.key),)
    return replace(edited, masks=(*edited.masks, made), words=(*edited.words, *words))


def _reject(edited: _Edited, number: int, edit: Reject, scene: Scene) -> _Edited:
    place = edit.view, *edit.at
    try:
        mask = _mask_at(edited, place, scene)
    except _Lost as error:
        nothing = RejectedPixel(number, *_pixel_at(scene, place), edit.everywhere)
        lost = edited.with_fate(Fate(number, edit.op, NOTHING, str(error)))
        return replace(lost, refused=(*lost.refused, nothing))
    if edit.everywhere:
        edited = edited.contradict(number, mask.edits)
        return replace(edited, everywhere=(*edited.everywhere, _About(number, mask.key, True)))
    return replace(edited.without(number, mask), rejected=(*edited.rejected, (number, mask)))


def _split(edited: _Edited, number: int, edit: Split, scene: Scene) -> _Edited:
    edited, mask = _remaining_mask_at(edited, number, (edit.view, *edit.at), scene)
    line = _to_pinhole(scene, mask.view, edit.line)
    if np.ptp(line, axis=0).max() < 1:
        raise _Lost("its line is a point")
    pixels, is_left = mask.crop.pixels, side_of(line, mask.crop)
    halves = [replace(mask.crop, pixels=pixels & side) for side in (is_left, ~is_left)]
    if not all(half.area for half in halves):
        raise _Lost("its line does not cut the mask")
    one, other = (
        EditedMask((number, n), mask.view, half.tighten(), mask.row, int(Origin.CUT), (number,))
        for n, half in enumerate(halves)
    )
    edited = edited.without(number, mask)
    tie = _Tie(number, False, one.key, other.key)
    return replace(edited, masks=(*edited.masks, one, other), ties=(*edited.ties, tie))


def _link(edited: _Edited, number: int, edit: Link, scene: Scene) -> _Edited:
    keys_at = []
    for place in edit.at:
        edited, mask = _remaining_mask_at(edited, number, place, scene)
        keys_at.append(mask.key)
    keys = list(dict.fromkeys(keys_at))
    if edit.op == "same":
        ties = [_Tie(number, True, keys[0], key) for key in keys[1:]]
    elif len(keys) < len(keys_at):
        raise _Lost("two of its places show the same mask: split it")
    else:
        ties = [_Tie(number, False, one, other) for n, one in enumerate(keys) for other in keys[:n]]
    return replace(edited.with_edit(number, keys), ties=(*edited.ties, *ties))


APPLY: dict[type, Callable[[_Edited, int, Any, Scene], _Edited]] = {
    Outline: _outline, Reject: _reject, Confirm: _confirm, Split: _split, Link: _link
}  # fmt: skip


def _clear_outlines(masks: Sequence[EditedMask]) -> list[EditedMask]:
    """A pixel shows one leaf: what lies in an outline is taken from every mask drawn before it."""
    cleared = list(masks)
    for n, drawn in enumerate(masks):
        for earlier in range(n) if drawn.origin == Origin.CORRECTED else ():
            crop = cleared[earlier].crop
            both = crop.intersect(drawn.crop) if drawn.view == masks[earlier].view else None
            if both is not None and 0 < both.area < crop.area:
                crop = Crop(crop.box, crop.pixels & ~both.pixels).tighten()
                cleared[earlier] = replace(cleared[earlier], crop=crop)
    return cleared


def _ties_of_words(words: Sequence[tuple[str, int, Key]], place: Mapping[Key, int]) -> list[_Tie]:
    """Outlines that stay, of one word for a leaf, show one leaf."""
    first: dict[str, Key] = {}
    ties = []
    for word, edit, key in words:
        if key in place and first.setdefault(word, key) != key:
            ties.append(_Tie(edit, True, first[word], key))
    return ties


def _agreeing_links(edited: _Edited, place: Mapping[Key, int]) -> tuple[_Edited, Links]:
    ties = [each for each in edited.ties if each.one in place and each.other in place]

    def links_of(edits: Collection[int]) -> Links:
        chosen = [(each.must, (place[each.one], place[each.other])) for each in ties if each.edit in edits]
        return Links.of(*([pair for must, pair in chosen if must is kind] for kind in (True, False)))

    def agree(edits: Collection[int]) -> bool:
        with suppress(InputError):
            links_of(edits).components(len(place))
            return True
        return False

    held, losers = keep_latest(sorted({each.edit for each in ties}, reverse=True), agree)
    for number, winner in losers.items():
        edited = edited.contradict(winner, [number])
    return edited, links_of(held)


def _keep_outlines_apart(links: Links, masks: Sequence[EditedMask]) -> Links:
    """Keep each outline apart from the other masks of its photo, unless a link joins them: an outline is a leaf."""
    component, views = links.components(len(masks)), np.array([mask.view for mask in masks], np.int64)
    is_drawn = np.array([mask.origin == Origin.CORRECTED for mask in masks], bool)
    apart = is_drawn[:, None] & (views[:, None] == views) & (component[:, None] != component)
    pairs = np.argwhere(np.triu(apart | apart.T))
    return replace(links, cannot=torch.cat((links.cannot, torch.from_numpy(pairs))))


def _mask_at(edited: _Edited, place: Place, scene: Scene) -> EditedMask:
    here = _masks_at(place, edited.masks, scene)
    if not here:
        name, x, y = place
        raise _Lost(f"there is no mask at ({x:g}, {y:g}) in view {name}")
    return min(here, key=lambda mask: (edited.is_rejected(mask), mask.origin != Origin.CORRECTED, mask.crop.area))


def _remaining_mask_at(edited: _Edited, number: int, place: Place, scene: Scene) -> tuple[_Edited, EditedMask]:
    """The mask at a place, for an edit about a leaf. If all masks there were rejected, the last of them comes back, and
    its rejection is contradicted: the later edit wins."""
    gone = _masks_at(place, [mask for _, mask in edited.rejected], scene)
    if gone and not _masks_at(place, edited.masks, scene):
        edited = replace(edited, masks=(*edited.masks, gone[-1]))
    mask = _mask_at(edited, place, scene)
    overridden = [n for n, other in edited.rejected if other.key == mask.key]
    overridden += [each.edit for each in edited.everywhere if each.rejects and each.mask == mask.key]
    edited = edited.contradict(number, overridden)
    rejected = tuple(each for each in edited.rejected if each[1].key != mask.key)
    everywhere = tuple(each for each in edited.everywhere if each.mask != mask.key or not each.rejects)
    return replace(edited, rejected=rejected, everywhere=everywhere), mask


def _masks_at(place: Place, masks: Sequence[EditedMask], scene: Scene) -> list[EditedMask]:
    view, column, row = _pixel_at(scene, place)
    return [mask for mask in masks if mask.view == view and mask.crop.holds(column, row)]


def _pixel_at(scene: Scene, place: Place) -> tuple[int, int, int]:
    name, x, y = place
    view = _view(scene, name)
    column, row = np.floor(_to_pinhole(scene, view, [(x, y)])[0]).astype(int).tolist()
    return view, column, row


def _view(scene: Scene, name: str) -> int:
    if (view := find_view(name, scene)) is None:
        raise _Lost(f"there is no view {name[:60]!r}")
    return view


def _to_pinhole(scene: Scene, view: int, points: Sequence[Point]) -> NDArray[np.float64]:
    xy, lens = np.array(points, np.float64), scene.views[view].lens
    if lens is not None:
        xy = pinhole_from_photo(lens, scene.cameras.K[view].cpu().numpy(), xy)
    if not np.isfinite(xy).all():
        raise _Lost("the lens shows nothing there")
    return xy.clip(-1e6, 1e6)
