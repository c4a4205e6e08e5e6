"""What edits leave: masks, links, and what came of each edit; and the edits about whole instances, which come last."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from mvseg.findings.finding import Finding
from mvseg.masks import Masks, Origin
from mvseg.matching.links import Links

APPLIED, NOTHING, CONTRADICTED, PASSED = "applied", "points at nothing", "contradicted by edit {}", "not of a scene"


@dataclass(frozen=True)
class Fate:
    """Outcome of an edit: its number from 1 on, its operation, and "applied", "points at nothing", "contradicted by
    edit N" or, of links between dates, "not of a scene"; `problem` says which place it was, or why."""

    edit: int
    op: str
    fate: str
    problem: str = ""

    @property
    def finding(self) -> Finding | None:
        """If the edit was not applied, or is odd; None otherwise."""
        if not self.problem and self.fate in (APPLIED, PASSED):
            return None
        why = ": ".join(filter(None, (self.fate, self.problem)))
        return Finding("edit", values={"edit": self.edit, "op": self.op, "why": why})


@dataclass(frozen=True)
class RejectedPixel:
    """A pixel of an undistorted photo in no mask, where the user says that no leaf is, or none in any photo
    (`everywhere`): it may be the answer to a question, see `settle_edits`."""

    edit: int
    view: int
    column: int
    row: int
    everywhere: bool


@dataclass(frozen=True)
class Whole:
    """An edit about a whole instance: its number, the row of a mask of it, and whether it is rejected, or confirmed."""

    edit: int
    row: int
    rejects: bool


@dataclass(frozen=True, eq=False)
class Corrected:
    """Masks after all edits.

    Attributes:
        masks: D masks on the CPU, by view, matched to nothing.
        links: of their rows. Besides those of edits, links keep outlines apart from the other masks of their photos.
        last_edits: (D,) int64, number of the last edit that drew, cut or confirmed each; 0 = none.
        everywhere: about whole instances.
        refused: rejected pixels in no mask.
        fates: in the order of the edits.
    """

    masks: Masks
    links: Links
    last_edits: Tensor
    everywhere: tuple[Whole, ...]
    refused: tuple[RejectedPixel, ...]
    fates: tuple[Fate, ...]


def keep_latest(edits: Sequence[int], holds: Callable[[Collection[int]], bool]) -> tuple[list[int], dict[int, int]]:
    """Edits (latest first) that hold together, and {other edit: the latest without which it would hold, or itself}."""
    if holds(edits):
        return list(edits), {}
    held: list[int] = []
    losers: dict[int, int] = {}
    for number in edits:
        if holds([*held, number]):
            held.append(number)
        elif not holds([number]):
            losers[number] = number
        else:
            culprits = (later for later in held if holds({number, *held} - {later}))
            losers[number] = next(culprits, max(held))
    return held, losers


def apply_everywhere(corrected: Corrected, matched: Masks) -> tuple[Masks, Corrected]:
    """Edits about whole instances, once `matched` has the ids, in the order of the list.

    Returns:
        The masks: a rejected instance goes, except masks that later edits drew, cut or confirmed; a confirmed one is
        confirmed. And the final fates: such an edit contradicts earlier ones that drew, cut or confirmed masks that
        now go, or that rejected what it confirms.
    """
    ids, goes = matched.instance_ids, torch.zeros(len(matched), dtype=torch.int64)  # the edit by which each mask goes
    confirmed, last_edits = torch.zeros(len(matched), dtype=torch.bool), corrected.last_edits
    overridden: dict[int, int] = {}
    for each in corrected.everywhere:
        number, row = each.edit, each.row
        own = (ids == ids[row]) if ids[row] > 0 else torch.zeros_like(confirmed)
        own[row] = True
        if each.rejects:
            goes[own & (last_edits < number)] = number
        else:
            overridden |= dict.fromkeys(goes[own & (goes > 0)].tolist(), number)
            goes[own] = 0
            confirmed |= own
    rows = zip(last_edits.tolist(), goes.tolist(), strict=True)
    overridden |= {last: number for last, number in rows if 0 < last < number}
    fates = tuple(
        replace(each, fate=CONTRADICTED.format(overridden[each.edit]))
        if each.fate == APPLIED and each.edit in overridden
        else each
        for each in corrected.fates
    )
    origin = matched.origin.where(~confirmed | matched.is_corrected, int(Origin.CONFIRMED))
    masks = replace(matched, origin=origin).select(goes == 0)
    return masks, replace(corrected, fates=fates)
