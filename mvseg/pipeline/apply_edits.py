"""What a person says changes masks and links them, and these are matched, and chosen, anew."""

from __future__ import annotations

from dataclasses import replace

import torch

from mvseg.corrections.apply import apply
from mvseg.corrections.corrected import apply_everywhere
from mvseg.corrections.file import Corrections
from mvseg.corrections.linked_halves import link_halves
from mvseg.errors import warn
from mvseg.masks import Masks, Origin
from mvseg.matching.match import describe_disagreement, match_masks
from mvseg.pipeline.known import Known
from mvseg.results.result import Instances
from mvseg.system.running import timed
from mvseg.verification.choose import choose_leaves
from mvseg.verification.drawn_leaves import follow_drawn

NOTHING_LEFT = "the corrections reject every mask: no leaf is left"


def apply_edits(known: Known, corrections: Corrections | None) -> Known:
    """What a person says changes masks and links them, and these are matched anew, see `mvseg.corrections.apply`.

    Edits are about masks that a person sees, see `Known.shown`. Without any edits, all stays as it is. The reprojection
    error is that of the masks before edits, unless a person drew more than half as many as there were.
    """
    if corrections is None or not corrections.edits:
        return known
    opened, cameras, config = known.opened, known.scene.cameras, known.opened.config
    with timed("correct"):
        shown = known.shown
        corrected = apply(corrections, shown, known.scene)
    with timed("match"):
        corrected = link_halves(corrected, known.masks.to("cpu"), cameras.to("cpu"))
        is_known = 2 * int(corrected.masks.is_corrected.sum()) <= len(known.masks)  # else his masks tell it better
        residual_px = known.matching.report.residual_px if is_known else None
        matching = match_masks(corrected.masks, cameras, config.match, links=corrected.links, residual_px=residual_px)
    masks, corrected = apply_everywhere(corrected, matching.masks.to("cpu"))
    if len(shown) and not len(masks):
        warn(NOTHING_LEFT)
    edited = replace(
        known,
        matching=matching,
        instances=Instances(),
        left=(),
        edits=corrected.fates,
        refused=corrected.refused,
        disagreement=describe_disagreement(matching, opened.names),
    ).with_masks(masks)
    if opened.is_chosen or config.reconstruct is not None:
        with timed("follow"):
            photos = opened.photos if opened.photos.exist else None
            colors = known.leaf_colors if photos is not None and known.matching.num_instances else None
            masks, starts = follow_drawn(edited.masks, cameras=cameras, photos=photos, colors=colors)
            edited = replace(edited, instances=Instances(starts=starts)).with_masks(masks)
    edited = edited.cut_merged()
    if not opened.is_chosen:
        return edited
    with timed("choose"):
        masks = edited.masks.to("cpu")
        leaves = choose_leaves(
            masks,
            known.proposals,
            cameras=cameras,
            more=known.matched,
            gone=_taken_away(shown, masks),
            drawn=known.drawn,
            min_probability=config.detect.min_probability,
        )
    return edited.with_leaves(leaves)


def _taken_away(before: Masks, after: Masks) -> Masks:
    """The detected masks of a table that are not in it any more, after a person's edits."""
    is_left = torch.isin(after.origin.cpu(), torch.tensor([Origin.DETECTED, Origin.CONFIRMED]))
    return before.select(~torch.isin(before.regions.labels, after.regions.labels.cpu()[is_left]))
