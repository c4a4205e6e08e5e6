"""Apply the user's edits, then match and choose again."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from mvseg.corrections.apply import apply
from mvseg.corrections.corrected import Corrected, apply_everywhere
from mvseg.corrections.file import Corrections, topic_of
from mvseg.corrections.linked_halves import link_halves
from mvseg.errors import warn
from mvseg.findings.finding import Finding
from mvseg.masks import Masks
from mvseg.matching.match import match_masks
from mvseg.pipeline.plant import Plant
from mvseg.system.running import timed
from mvseg.verification.choose import Edited
from mvseg.verification.drawn_leaves import follow_drawn


def apply_edits(plant: Plant, corrections: Corrections | None) -> Plant:
    """Apply the user's edits (`mvseg.corrections.apply`), then match and choose again.

    Edits are about `Plant.editable`. Without any edits, the plant is returned as it is. The reprojection error is that
    of the masks before edits, unless the user drew more than half as many as there were.
    """
    if corrections is None or not corrections.edits:
        return plant
    opened, cameras, editable = plant.opened, plant.scene.cameras, plant.editable.to("cpu")
    with timed("correct"):
        corrected = apply(corrections, editable, plant.scene)
        if not any(topic_of(edit) == "masks" for edit in corrections.edits):
            return replace(plant, edits=corrected.fates)
        before = plant.ids_of(corrected.masks)
        corrected = link_halves(corrected, before, cameras.to("cpu"))
        stays = torch.isin(before, unchanged_leaves(corrected, before, plant.masks.to("cpu")))
    with timed("match"):
        edited, stays = _match_anew(plant, corrected, before.where(stays, -1))
    masks, done = apply_everywhere(corrected, edited.masks)
    if len(editable) and not len(masks):
        warn(Finding("no_leaf_left"))
    if opened.photos.exist and (not opened.holds or opened.config.reconstruct is not None):
        with timed("follow"):
            colors = plant.leaf_colors if plant.matching.num_instances else None
            masks = follow_drawn(masks, cameras=cameras, photos=opened.photos, colors=colors, cache=opened.cache)
    said = _gather_said(plant, corrected, stays, masks)
    return replace(edited, edits=done.fates, refused=done.refused).choose(said)


def _match_anew(plant: Plant, corrected: Corrected, previous: Tensor) -> tuple[Plant, Tensor]:
    """Match the edited masks anew, except those of leaves that stay: these keep their ids. Where the user speaks of
    such leaves only, nothing is matched. Without leaves that other masks join (`leave_joined`), `previous` is returned,
    too.

    `previous`: (D,) int64 on the CPU, ids of the leaves that stay; -1 for all other masks."""
    masks, rejects = corrected.masks, any(each.rejects for each in corrected.everywhere)
    if not rejects and not bool((masks.is_edited & (previous < 1)).any()):
        return replace(plant, matching=plant.matching.with_masks(replace(masks, instance_ids=previous))), previous
    residual_px, cameras, config = plant.matching.report.residual_px, plant.scene.cameras, plant.opened.config.match
    if 2 * int(masks.is_corrected.sum()) > len(plant.masks):  # the user's masks tell it better
        residual_px = None
    matching = match_masks(masks, cameras, config, links=corrected.links, residual_px=residual_px)
    matched = matching.masks.to("cpu")
    previous = leave_joined(previous, matched.instance_ids, masks.is_edited)
    ids = torch.where(previous > 0, previous + matched.num_instances, matched.instance_ids)
    disagreement = plant.opened.find_disagreement(matching)
    matching = matching.with_masks(replace(matched, instance_ids=ids))
    return replace(plant, matching=matching, disagreement=disagreement), previous


def unchanged_leaves(corrected: Corrected, ids: Tensor, before: Masks) -> Tensor:
    """Find the leaves that edits mention but do not change: none of their masks is gone, changed, kept apart from
    another one, or linked to one of another leaf, and the leaf is not rejected.

    Args:
        ids: (D,) int64, the leaves of the corrected masks before the edits.
        before: the masks before the edits, on the CPU, with the ids that the user saw.

    Returns:
        (L,) int64, their ids in `before`.
    """
    must, cannot = ids[corrected.links.must.reshape(-1, 2)], ids[corrected.links.cannot.reshape(-1, 2)]
    remaining, all_of = (
        torch.bincount(each.clamp(min=0), minlength=before.num_instances + 1) for each in (ids, before.instance_ids)
    )
    changed = (
        must[must[:, 0] != must[:, 1]].flatten(),
        cannot[cannot[:, 0] == cannot[:, 1]].flatten(),
        ids[[each.row for each in corrected.everywhere if each.rejects]],
        (remaining != all_of).nonzero()[:, 0],
    )
    named = ids[corrected.masks.is_edited]
    leaves = named[named > 0].unique()
    return leaves[~torch.isin(leaves, torch.cat(changed))]


def leave_joined(previous: Tensor, matched_ids: Tensor, is_held: Tensor) -> Tensor:
    """`previous` (D,), with -1 for every leaf that other masks join: at least half of its masks are matched
    (`matched_ids`) to a mask that the user speaks of (`is_held`), and that is of no unchanged leaf."""
    is_other = is_held & (previous < 1) & (matched_ids > 0)
    is_joined = torch.isin(matched_ids, matched_ids[is_other])
    num = int(previous.max().clamp(min=0)) + 1 if len(previous) else 1
    is_known = previous > 0
    joined, all_of = (torch.bincount(previous[each & is_known], minlength=num) for each in (is_joined, is_known))
    return previous.where((2 * joined < all_of)[previous.clamp(min=0)] & (previous > 0), -1)


def _gather_said(plant: Plant, corrected: Corrected, previous: Tensor, masks: Masks) -> Edited:
    """What edits say of the masks that are left, and of the proposals that are gone."""
    before, names = corrected.masks, corrected.masks.proposal
    row_of = {name: row for row, name in enumerate(masks.proposal.tolist())}
    pairs = [[row_of.get(name, -1) for name in pair] for pair in names[corrected.links.cannot].tolist()]
    apart = torch.tensor([pair for pair in pairs if min(pair) >= 0], dtype=torch.int64).reshape(-1, 2)
    stays = torch.isin(masks.proposal, names[previous > 0])
    changed = plant.ids_of(before)[before.is_edited & (previous < 1)].tolist()
    keys = tuple(None if leaf in changed else plant.keys.get(leaf) for leaf in plant.ids_of(masks).tolist())
    gone = plant.editable.proposal.cpu()
    return Edited(masks, keys, stays, gone=gone[~torch.isin(gone, masks.proposal)], apart=apart)
