"""Apply the user's edits, then match and choose again."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from mvseg.corrections.apply import apply
from mvseg.corrections.corrected import Corrected, apply_everywhere
from mvseg.corrections.file import Corrections
from mvseg.corrections.linked_halves import link_halves
from mvseg.corrections.unchanged_leaves import find_pairs, ids_before, leave_joined, unchanged_leaves
from mvseg.errors import warn
from mvseg.findings.finding import Finding
from mvseg.masks import Masks, Origin
from mvseg.matching.match import match_masks
from mvseg.pipeline.plant import Plant
from mvseg.results.result import Instances
from mvseg.system.running import timed
from mvseg.verification.choose import choose_leaves
from mvseg.verification.drawn_leaves import follow_drawn


def apply_edits(plant: Plant, corrections: Corrections | None) -> Plant:
    """Apply the user's edits (`mvseg.corrections.apply`), then match and choose again.

    Edits are about `Plant.editable`. Without any edits, the plant is returned as it is. The reprojection error is that
    of the masks before edits, unless the user drew more than half as many as there were.
    """
    if corrections is None or not corrections.edits:
        return plant
    opened, cameras, config = plant.opened, plant.scene.cameras, plant.opened.config
    with timed("correct"):
        editable, before = plant.editable, plant.masks.to("cpu")
        corrected = apply(corrections, editable, plant.scene)
        corrected = link_halves(corrected, before, cameras.to("cpu"))
        previous = torch.full_like(corrected.last_edits, -1)
        if opened.is_chosen:
            previous = ids_before(corrected.masks, before)
        previous = previous.where(torch.isin(previous, unchanged_leaves(corrected, previous, before)), -1)
    with timed("match"):
        matched, previous = _match_anew(plant, corrected, previous)
    masks, corrected = apply_everywhere(corrected, matched.masks)
    if len(editable) and not len(masks):
        warn(Finding("no_leaf_left"))
    edited = replace(
        matched, instances=Instances(), rejected=(), edits=corrected.fates, refused=corrected.refused
    ).with_masks(masks)
    if opened.is_chosen or config.reconstruct is not None:
        with timed("follow"):
            photos = opened.photos if opened.photos.exist else None
            colors = plant.leaf_colors if photos is not None and plant.matching.num_instances else None
            masks, starts = follow_drawn(
                edited.masks, cameras=cameras, photos=photos, colors=colors, cache=opened.surfaces
            )
            edited = replace(edited, instances=Instances(starts=starts)).with_masks(masks)
    if not opened.is_chosen:
        return edited
    with timed("choose"):
        masks = edited.masks.to("cpu")
        leaves = choose_leaves(
            masks,
            plant.proposals,
            cameras=cameras,
            more=plant.matched,
            removed=_removed_masks(editable, masks),
            previous=ids_before(masks, replace(corrected.masks, instance_ids=previous)),
            apart=find_pairs(corrected.masks, corrected.links.cannot, masks),
            drawn=plant.drawn,
            min_probability=config.detect.min_probability,
            cache=opened.surfaces,
        )
    return edited.with_leaves(leaves)


def _match_anew(plant: Plant, corrected: Corrected, previous: Tensor) -> tuple[Plant, Tensor]:
    """Match the edited masks anew, but for those of leaves that stay: these keep their ids.

    Where the views choose, and the user speaks of such leaves only, nothing is matched, and what matching said stays.

    Args:
        corrected: D masks and their links.
        previous: (D,) int64 on the CPU, the leaves that stay as they were seen; -1 for all other masks.

    Returns:
        What is known with the D masks, and `previous` without the leaves that other masks join, see `leave_joined`.
    """
    masks, rejects = corrected.masks, any(each.rejects for each in corrected.everywhere)
    is_held = masks.is_corrected | masks.is_linked
    if plant.opened.is_chosen and not rejects and not bool((is_held & (previous < 1)).any()):
        ids_only = replace(masks, instance_ids=previous).close_gaps()
        return replace(plant, matching=plant.matching.with_masks(ids_only)), previous
    is_known = 2 * int(masks.is_corrected.sum()) <= len(plant.masks)  # else the user's masks tell it better
    matching = match_masks(
        masks,
        plant.scene.cameras,
        plant.opened.config.match,
        links=corrected.links,
        residual_px=plant.matching.report.residual_px if is_known else None,
    )
    matched = matching.masks.to("cpu")
    previous = leave_joined(previous, matched.instance_ids, is_held)
    ids = torch.where(previous > 0, previous + matched.num_instances, matched.instance_ids)
    disagreement = plant.opened.find_disagreement(matching)
    matching = matching.with_masks(replace(matched, instance_ids=ids).close_gaps())
    return replace(plant, matching=matching, disagreement=disagreement), previous


def _removed_masks(before: Masks, after: Masks) -> Masks:
    is_left = torch.isin(after.origin.cpu(), torch.tensor([Origin.DETECTED, Origin.CONFIRMED]))
    return before.select(~torch.isin(before.regions.labels, after.regions.labels.cpu()[is_left]))
