"""A person who says that two halves show one leaf says so of all photos. Not in the paper.

Where masks show a leaf in two halves in many photos, each half is an instance of its own. A link would join the two
linked masks, and leave the others to either half.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace

import torch
from torch import Tensor

from mvseg.corrections.as_seen import seen_ids
from mvseg.corrections.corrected import Corrected
from mvseg.corrections.numbers import EDITS
from mvseg.errors import InputError
from mvseg.masks import Masks
from mvseg.matching.links import Links
from mvseg.reconstruction.surface.fit_surfaces import fit_surfaces
from mvseg.scene import Cameras
from mvseg.verification.join_halves import are_one_leaf


def link_halves(corrected: Corrected, before: Masks, cameras: Cameras) -> Corrected:
    """The masks as edits leave them, with the links that follow between halves of a leaf.

    A link that joins masks of two instances is about all of their masks where several photos show both, and one surface
    shows the masks of both as well as two do (`are_one_leaf`): then both are linked in each of these photos. Elsewhere
    it says that one mask has the wrong id, and the two instances are two leaves.

    Args:
        corrected: D masks and their links.
        before: the masks before the edits, on the CPU, with the ids that the person saw.
        cameras: V cameras on the CPU.

    Returns:
        The same with more links; a link that would contradict those of the person is left out.
    """
    masks, links = corrected.masks, corrected.links
    if not len(links.must):
        return corrected
    ids = seen_ids(masks, before)
    is_linked = masks.is_linked
    for one, other in sorted({(min(pair), max(pair)) for pair in ids[links.must].tolist()}):
        halves = _in_one_photo(masks, ids == one, ids == other) if 0 < one < other else []
        if len({int(masks.view_index[row]) for row, _ in halves}) < EDITS.least_halves:
            continue
        own = torch.where(ids == one, 1, torch.where(ids == other, 2, -1))
        surfaces = fit_surfaces(masks.regions, own, cameras)  # not kept: what hides a leaf is not here
        if are_one_leaf(masks.regions, own, surfaces, cameras=cameras):
            more = Links(torch.cat((links.must, torch.tensor(halves))), links.cannot)
            with suppress(InputError):
                more.components(len(masks))
                links, is_linked = more, is_linked | Links.of(halves).named(len(masks))
    return replace(corrected, links=links, masks=replace(masks, is_linked=is_linked))


def _in_one_photo(masks: Masks, is_one: Tensor, is_other: Tensor) -> list[tuple[int, int]]:
    """The pairs of masks, one of each of two instances, in the same photo."""
    first, second = is_one.nonzero()[:, 0].tolist(), is_other.nonzero()[:, 0].tolist()
    views = masks.view_index.tolist()
    return [(row, other) for row in first for other in second if views[row] == views[other]]
