"""Edits that point at no mask, once all is known that a person may be asked about."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

from mvseg.corrections.apply import APPLIED, Corrected
from mvseg.masks import Masks
from mvseg.reconstruction.surface.leaf_surface import LeafSurface
from mvseg.scene import Cameras
from mvseg.verification.choose import LeftOut
from mvseg.verification.evidence import paint_view


def settle(
    corrected: Corrected, left: Sequence[LeftOut], surfaces: Mapping[int, LeafSurface], *, cameras: Cameras
) -> tuple[tuple[LeftOut, ...], Corrected]:
    """The edits that say "no leaf" where no mask is, once all is known that a person may be asked about.

    They are applied where they answer a question: a candidate that was not chosen is shown there, which goes if the
    edit is about all photos, or a surface, of which no mask is there.

    Args:
        corrected: what came of all edits.
        left: candidates that were not chosen.
        surfaces: {instance id: surface}.
        cameras: V cameras.

    Returns:
        The candidates that are left, and the same with the final fates.
    """
    gone: set[int] = set()
    answers: set[int] = set()
    for number, view, column, row, is_about_all in corrected.refused:
        shown = [each for each in left if _is_shown(each.masks, view, column, row)]
        gone |= {id(each) for each in shown if is_about_all}
        width, height = cameras.sizes[view].tolist()
        is_in_photo = 0 <= column < width and 0 <= row < height
        if shown or (is_in_photo and paint_view(surfaces, cameras, view)[row, column] > 0):
            answers.add(number)
    fates = tuple(
        replace(each, fate=APPLIED, problem="") if each.edit in answers else each for each in corrected.fates
    )
    return tuple(each for each in left if id(each) not in gone), replace(corrected, fates=fates)


def _is_shown(masks: Masks, view: int, column: int, row: int) -> bool:
    """Whether one of the masks of a view has a pixel."""
    x1, y1, x2, y2 = masks.regions.boxes.T
    here = (masks.view_index == view) & (x1 <= column) & (column < x2) & (y1 <= row) & (row < y2)
    return any(
        bool(masks.regions.crop(index)[row - int(y1[index]), column - int(x1[index])])
        for index in here.nonzero()[:, 0].tolist()
    )
