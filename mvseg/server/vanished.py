"""Leaves that an edit of others takes away: no leaf goes without a word."""

from __future__ import annotations

from collections.abc import Sequence

from mvseg.corrections.apply import is_on
from mvseg.corrections.file import Edit
from mvseg.results.result import Result


def tell_vanished(before: Result, after: Result, *, new: Sequence[Edit]) -> list[str]:
    """A sentence for each leaf that is gone, though no new edit names one of its masks.

    Args:
        before: with the numbers of leaves that the page shows.
        after: the same scene with the new edits, too; leaves keep their numbers.
        new: edits that `before` was made without; without any, nothing is said: what was undone may go.
    """
    old, masks = before.masks.to("cpu"), after.masks.to("cpu")
    gone = sorted(set(old.instance_ids[old.instance_ids > 0].tolist()) - set(masks.instance_ids.tolist()))
    sentences = []
    for leaf in gone if new else ():
        rows = (old.instance_ids == leaf).nonzero()[:, 0].tolist()
        if not any(is_on(edit, old.regions, rows, scene=before.scene) for edit in new):
            sentences.append(f"Leaf {leaf} ({len(rows)} masks) went with your last edit: undo it if that is wrong.")
    return sentences
