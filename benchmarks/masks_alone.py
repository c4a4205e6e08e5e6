"""Corrections as a tool applies them that knows no cameras: what `benchmarks/corrections.py` compares with."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch

from mvseg.corrections.apply import apply
from mvseg.corrections.corrected import apply_everywhere
from mvseg.corrections.file import Corrections, Edit
from mvseg.masks import Masks
from mvseg.matching.partition import separate_unmatched
from mvseg.scene import Scene


def change_masks_alone(masks: Masks, edits: Sequence[Edit], scene: Scene) -> Masks:
    """The same edits in a tool that knows no cameras: each changes the masks that it names, and nothing follows.

    An outline has the leaf of the mask that it replaces; `same` gives all of its masks the leaf of the first one,
    `different` takes the later ones out of their leaf, and the smaller part of a cut mask is another leaf.
    """
    numbered = replace(masks, regions=replace(masks.regions, labels=torch.arange(1, len(masks) + 1)))
    changed = apply(Corrections(tuple(edits)), numbered, scene)
    before = torch.from_numpy(separate_unmatched(masks.instance_ids.numpy())) + 1
    row, area = changed.masks.regions.labels, changed.masks.regions.areas  # label 0: a mask where none was
    new = int(before.max()) + 1 + torch.arange(len(row))
    ids = torch.where(row > 0, before[(row - 1).clamp(min=0)], new)
    for first, second in changed.links.must.tolist():
        ids[second] = ids[first]
    for first, second in changed.links.cannot.tolist():
        if ids[first] == ids[second]:
            is_cut = row[first] == row[second]
            leaves = second if is_cut and area[second] < area[first] else first
            ids[leaves] = new[leaves]
    scores = torch.where(row > 0, masks.match_scores[(row - 1).clamp(min=0)], 0.0)
    return apply_everywhere(changed, replace(changed.masks, instance_ids=ids, match_scores=scores))[0]
