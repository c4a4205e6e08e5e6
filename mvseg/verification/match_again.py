"""Masks that do not show their own leaf are matched once more, all others held. Not in the paper.

Where leaves are dense, the masks of one leaf may be scattered: each went to a leaf that has no mask in its view, and
along the rays it fits there, but the surface of that leaf lies elsewhere. Freed all at once, they find each other.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from mvseg.arrays import Bools, Floats, Ints
from mvseg.errors import collect_warnings
from mvseg.masks import SURE, Masks
from mvseg.matching.config import MatchConfig
from mvseg.matching.links import Links
from mvseg.matching.match import match_masks
from mvseg.scene import Cameras
from mvseg.verification.numbers import EVIDENCE


def match_again(masks: Masks, leaf: Ints, *, q: Floats, cameras: Cameras, config: MatchConfig) -> Masks | None:
    """Match the masks that do not show their own leaf (by `SURE`), and those without one, once more.

    All others stay together, instances stay apart, and no mask goes back to the one that it was taken from.

    Args:
        leaf: (D,) int64, the leaf that each mask was matched to, from 0 on; -1 for none.
        q: (D,) how likely it shows that.
        config: of the first matching.

    Returns:
        The same masks with the ids of new instances only, whose masks come from several leaves; None where no mask is
        freed, with another method than "nview", and with fewer than `EVIDENCE.least_views` views.
    """
    is_free = (leaf < 0) | (q < SURE)
    has_few_views = masks.regions.num_views < EVIDENCE.least_views
    if config.resolved_method != "nview" or has_few_views or not (is_free & (leaf >= 0)).any():
        return None
    with collect_warnings():  # the first matching has said it
        again = match_masks(masks, cameras, config, links=_links(leaf, is_free))
    if again.report.method != "nview":
        return None
    ids = again.masks.instance_ids
    is_old = torch.isin(ids, ids[torch.from_numpy(~is_free)]) | _comes_of_one(ids, leaf)
    return replace(again.masks, instance_ids=ids.where(~is_old, -1))


def _comes_of_one(ids: Tensor, leaf: Ints) -> Tensor:
    """(D,) bool, masks of instances most of whose masks were of one leaf: that leaf again, by fewer masks."""
    is_one = torch.zeros(int(ids.max().clamp(min=0)) + 1, dtype=torch.bool)
    for instance in ids[ids > 0].unique().tolist():
        sources = leaf[(ids == instance).numpy()]
        is_one[instance] = bool(2 * np.bincount(sources[sources >= 0], minlength=1).max() > len(sources))
    return is_one[ids.clamp(min=0)]


def _links(leaf: Ints, is_free: Bools) -> Links:
    must: list[tuple[int, int]] = []
    cannot: list[tuple[int, int]] = []
    firsts: list[int] = []
    for instance in np.unique(leaf[(leaf >= 0) & ~is_free]).tolist():
        first, *others = np.flatnonzero((leaf == instance) & ~is_free).tolist()
        must += [(first, other) for other in others]
        cannot += [(first, row) for row in np.flatnonzero((leaf == instance) & is_free).tolist()]
        cannot += [(first, earlier) for earlier in firsts]
        firsts.append(first)
    return Links.of(must, cannot)
