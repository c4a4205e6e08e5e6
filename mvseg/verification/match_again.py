"""Masks that do not show their own leaf are matched once more, all others held. Not in the paper.

Where leaves are dense, the masks of one leaf may be scattered: each went to a leaf that has no mask in its view, and
along the rays it fits there. But the surface of that leaf lies elsewhere in its photo. Freed all at once, such masks
find each other.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from mvseg.errors import collect_warnings
from mvseg.masks import Masks
from mvseg.matching.config import MatchConfig
from mvseg.matching.links import Links
from mvseg.matching.match import match_masks
from mvseg.scene import Cameras
from mvseg.verification.evidence import Bools, Floats, Ints
from mvseg.verification.numbers import AGAIN


def match_again(masks: Masks, leaf: Ints, *, q: Floats, cameras: Cameras, config: MatchConfig) -> list[Masks]:
    """The same masks, with the ids of those instances only that masks form which do not show their own.

    Such masks are freed, with those matched to nothing. All others stay together as they are, instances stay apart, and
    no mask goes back to the one that it was taken from (`Links`).

    Args:
        masks: D masks on the CPU, matched by the method "nview": with any other, or with fewer than `AGAIN.least_views`
            views, nothing is found.
        leaf: (D,) int64, what each mask was matched to, from 0 on; -1 for nothing.
        q: (D,) how likely it shows that.
        config: that the masks were matched with.
    """
    matchings: list[Masks] = []
    if config.resolved_method != "nview" or masks.regions.num_views < AGAIN.least_views:
        return matchings
    for least in AGAIN.freed:
        is_free = (leaf < 0) | (q < least)
        if (is_free & (leaf >= 0)).any():
            with collect_warnings():  # the first matching has said it
                again = match_masks(masks, cameras, config, links=_links(leaf, is_free))
            ids = again.masks.instance_ids
            is_old = torch.isin(ids, ids[torch.from_numpy(~is_free)])
            if again.report.method == "nview":
                matchings.append(replace(again.masks.with_merged(()), instance_ids=ids.where(~is_old, -1)))
    return matchings


def _links(leaf: Ints, is_free: Bools) -> Links:
    """What stays together and apart."""
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
