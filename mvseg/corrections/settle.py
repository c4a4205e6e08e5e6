"""Edits that point at no mask, once all is known that a person may be asked about."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

from mvseg.corrections.apply import APPLIED, Corrected
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
        shown = [each for each in left if each.masks.regions.at(view, column, row)]
        gone |= {id(each) for each in shown if is_about_all}
        width, height = cameras.sizes[view].tolist()
        is_in_photo = 0 <= column < width and 0 <= row < height
        if shown or (is_in_photo and paint_view(surfaces, cameras, view)[row, column] > 0):
            answers.add(number)
    fates = tuple(
        replace(each, fate=APPLIED, problem="") if each.edit in answers else each for each in corrected.fates
    )
    return tuple(each for each in left if id(each) not in gone), replace(corrected, fates=fates)

