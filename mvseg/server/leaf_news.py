"""News of leaves after an edit: those that went without being named, and the outcome of outlines."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

import numpy as np
import torch
from numpy.typing import NDArray

from mvseg.corrections.apply import is_on
from mvseg.corrections.file import Edit, Outline
from mvseg.masks import Origin
from mvseg.results.result import Result

PARTNERS = 20, 60  # chosen: degrees between two photos that both show a leaf, and tell its shape


def tell_vanished(before: Result, after: Result, *, new: Sequence[Edit]) -> list[str]:
    """A sentence for each leaf of `before`, with the numbers on the page, that is gone in `after`, the same scene with
    the `new` edits, too, though none of them names one of its masks. None without new edits: undone leaves may go."""
    old, masks = before.masks.to("cpu"), after.masks.to("cpu")
    gone = sorted(set(old.instance_ids[old.instance_ids > 0].tolist()) - set(masks.instance_ids.tolist()))
    sentences = []
    for leaf in gone if new else ():
        rows = (old.instance_ids == leaf).nonzero()[:, 0].tolist()
        if not any(is_on(edit, old.regions, rows, scene=before.scene) for edit in new):
            sentences.append(f"Leaf {leaf} ({len(rows)} masks) went with your last edit: undo it if that is wrong.")
    return sentences


def tell_drawn(result: Result, *, new: Sequence[Edit], angles: NDArray[np.int64]) -> list[str]:
    """A sentence for each leaf of new outlines: in how many other photos it was found, or why it was not. `angles` (V,
    V) are degrees between the photos, see `measure_angles`."""
    masks, views = result.masks.to("cpu"), {view.name: index for index, view in enumerate(result.scene.views)}
    drawn = {views[edit.view] for edit in new if isinstance(edit, Outline) and edit.view in views}
    is_drawn = masks.origin == int(Origin.CORRECTED)
    here = is_drawn & torch.isin(masks.view_index, torch.tensor(sorted(drawn), dtype=torch.int64))
    sentences = []
    for leaf in masks.instance_ids[here & (masks.instance_ids > 0)].unique().tolist():
        own = masks.instance_ids == leaf
        outlined = masks.view_index[own & is_drawn].unique().tolist()
        found = len(set(masks.view_index[own].tolist()) - set(outlined))
        photos = "one photo" if len(outlined) == 1 else f"{len(outlined)} photos"
        sentence = f"Leaf {leaf}: drawn in {photos}, found in {found} of {len(views) - len(outlined)} others"
        if not found:
            widest = max((int(angles[pair]) for pair in combinations(outlined, 2)), default=0)
            why = "one photo tells no shape" if len(outlined) == 1 else f"they are {widest} degrees apart"
            why = why if widest < PARTNERS[0] else "its shape fits no other photo"
            advice = f"Outline it in a photo {PARTNERS[0]} to {PARTNERS[1]} degrees away, too"
            if (walked := int(angles.max())) < PARTNERS[0]:
                advice = f"All photos are within {walked} degrees: outline it in more of them"
            sentence += f": {why}. {advice}"
        sentences.append(f"{sentence}.")
    return sentences
