"""Edits that point at no mask, once all is known that the user may be asked about."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

from mvseg.corrections.corrected import APPLIED, Fate, RejectedPixel
from mvseg.reconstruction.surface.leaf_surface import LeafSurface
from mvseg.scene import Cameras
from mvseg.verification.choose import RejectedCandidate
from mvseg.verification.evidence import paint_view


def settle_edits(
    edits: Sequence[Fate],
    refused: Sequence[RejectedPixel],
    rejected: Sequence[RejectedCandidate],
    surfaces: Mapping[int, LeafSurface],
    *,
    cameras: Cameras,
) -> tuple[tuple[RejectedCandidate, ...], tuple[Fate, ...]]:
    """The edits that say "no leaf" where no mask is, once all is known that the user may be asked about.

    They are applied where they answer a question: a candidate that was not chosen is shown there, which goes if the
    edit is about all photos, or a surface, of which no mask is there.

    Returns:
        The candidates that are left, and the final fates.
    """
    gone, answers = set[int](), set[int]()
    for each in refused:
        candidates = {n for n, other in enumerate(rejected) if other.masks.regions.at(each.view, each.column, each.row)}
        gone |= candidates if each.everywhere else set()
        width, height = cameras.sizes[each.view].tolist()
        is_in_photo = 0 <= each.column < width and 0 <= each.row < height
        if candidates or (is_in_photo and paint_view(surfaces, cameras, each.view)[each.row, each.column] > 0):
            answers.add(each.edit)
    fates = tuple(replace(each, fate=APPLIED, problem="") if each.edit in answers else each for each in edits)
    return tuple(other for n, other in enumerate(rejected) if n not in gone), fates
