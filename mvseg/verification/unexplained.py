"""Leaf-coloured area in no mask: where it is most of it, leaves were missed. Not in the paper."""

from __future__ import annotations

from mvseg.findings.finding import Finding
from mvseg.formats.photos import ReadPhoto
from mvseg.masks import Masks
from mvseg.verification.leaf_color import has_leaf_color, thin_views
from mvseg.verification.numbers import COLORS, EVIDENCE


def share_unexplained(masks: Masks, photos: ReadPhoto) -> float:
    """Share of the leaf-coloured area that is in no mask; 0 without any.

    Args:
        masks: D masks, those of leaves with an id.
        photos: of the views; every second, third ... pixel of large ones counts.
    """
    views, colors = thin_views(masks.select(masks.instance_ids > 0), photos, most_px=EVIDENCE.most_px)
    beside = sum(int((has_leaf_color(photo, colors) & (rows < 0)).sum()) for photo, rows, _ in views)
    return beside / max(beside + sum(int((rows >= 0).sum()) for _, rows, _ in views), 1)


def is_familiar(masks: Masks, *, sure_score: float) -> bool:
    """Whether a detector knows the species: it is sure (a detection score of `sure_score` or more) of at least half of
    the masks of leaves that it found. Without any, it does not; masks that no detector scored are familiar."""
    found = masks.instance_ids > 0
    scores = masks.detection_scores[found]
    scores = scores[~scores.isnan()]
    return bool(found.any()) and (not len(scores) or float(scores.median()) >= sure_score)


def find_missing(masks: Masks, photos: ReadPhoto, *, sure_score: float) -> Finding | None:
    """Whether leaves were probably missed.

    Args:
        masks, photos: see `share_unexplained`.
        sure_score: detection score from which the detector is sure.
    """
    if not (masks.instance_ids > 0).any():
        return Finding("no_leaves")
    if not is_familiar(masks, sure_score=sure_score):
        return Finding("species_unknown", values={"score": sure_score})
    share = share_unexplained(masks, photos)
    return Finding("leaves_missed", values={"share": share}) if share > COLORS.unexplained else None
