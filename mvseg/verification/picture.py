"""Each pixel of a view shows a leaf, is leaf-coloured and free, or shows something else. Not in the paper.

Leaf-coloured pixels in no mask are leaves that were missed, or parts of leaves that their masks lack.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from mvseg.arrays import Bools, Pixels
from mvseg.findings.finding import Finding
from mvseg.formats.photos import ReadPhoto
from mvseg.masks import SURE, Masks
from mvseg.verification.leaf_color import count_colors, has_leaf_color, leaf_colors
from mvseg.verification.numbers import COLORS

Labels = NDArray[np.int32]  # a photo may have 50 million pixels
FREE, OTHER = -1, -2  # definition: pixels in no mask, with the colour of leaves and with another one


@dataclass(frozen=True, eq=False)
class ViewPicture:
    """Every `step`-th pixel of a view: its photo (h, w, 3), and the row (h, w) of the smallest mask there; -1: none."""

    photo: Pixels
    rows: Labels
    step: int

    @staticmethod
    def of(masks: Masks, photos: ReadPhoto, view: int, *, most_px: int | None = None) -> ViewPicture:
        """`most_px`: max. longer side that is left; None: all pixels."""
        photo = photos(view)
        size = photo.shape[1], photo.shape[0]
        step = 1 if most_px is None else -(-max(size) // most_px)
        rows = masks.regions.label_map(view, torch.arange(1, len(masks) + 1), size).numpy()[::step, ::step]
        return ViewPicture(np.ascontiguousarray(photo[::step, ::step]), rows.astype(np.int32) - 1, step)

    def show(self, colors: Bools) -> Labels:
        """(h, w) the row of the mask there, `FREE`, where a pixel in none has one of the `leaf_colors`, or `OTHER`."""
        return np.where((self.rows < 0) & ~has_leaf_color(self.photo, colors), OTHER, self.rows)


def picture_views(masks: Masks, photos: ReadPhoto) -> list[tuple[Labels, int]]:
    """V pictures of D masks, see `ViewPicture.show`, by the colours of the matched ones; and the step of each."""
    views = _thin(masks, photos)
    colors = _colors_of(masks, views)
    return [(each.show(colors), each.step) for each in views]


def colors_of_leaves(masks: Masks, photos: ReadPhoto) -> Bools:
    """The colours of masks that are surely matched; where there are none, those of all that are matched."""
    return _colors_of(masks, _thin(masks, photos))


def _thin(masks: Masks, photos: ReadPhoto) -> list[ViewPicture]:
    return [ViewPicture.of(masks, photos, view, most_px=COLORS.most_px) for view in range(masks.regions.num_views)]


def _colors_of(masks: Masks, views: list[ViewPicture]) -> Bools:
    is_matched = masks.instance_ids > 0
    is_sure = is_matched & (masks.match_scores >= SURE)
    is_leaf = np.append((is_sure if is_sure.any() else is_matched).numpy(), False)  # the last one is for row -1
    counts = [count_colors(each.photo, is_leaf[each.rows]) for each in views]
    return leaf_colors(np.sum(counts, 0))


def share_unexplained(masks: Masks, photos: ReadPhoto) -> float:
    """Share of the leaf-coloured area that is in no mask of a leaf; 0 without any."""
    pictures = picture_views(masks.select(masks.instance_ids > 0), photos)
    pixels = np.concatenate([rows.ravel() for rows, _ in pictures])
    return float((pixels == FREE).sum() / max((pixels != OTHER).sum(), 1))


def is_familiar(masks: Masks, *, sure_score: float) -> bool:
    """Whether a detector knows the species: it is sure (a detection score of `sure_score` or more) of at least half of
    the masks of leaves. Without any, it does not; masks that no detector scored are familiar."""
    scores = masks.detection_scores[masks.instance_ids > 0]
    scored = scores[~scores.isnan()]
    return bool(len(scores)) and (not len(scored) or float(scored.median()) >= sure_score)


def find_missing(masks: Masks, photos: ReadPhoto, *, sure_score: float) -> Finding | None:
    """Find out whether leaves were probably missed; `sure_score` as in `is_familiar`."""
    if not (masks.instance_ids > 0).any():
        return Finding("no_leaves")
    if not is_familiar(masks, sure_score=sure_score):
        return Finding("species_unknown", values={"score": sure_score})
    share = share_unexplained(masks, photos)
    return Finding("leaves_missed", values={"share": share}) if share > COLORS.unexplained else None
