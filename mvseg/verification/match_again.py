"""Masks that do not show their own leaf are matched once more, all others held. Not in the paper.

Where leaves are dense, the masks of one leaf may be scattered: each went to a leaf that has no mask in its view, and
along the rays it fits there. But the surface of that leaf lies elsewhere in its photo. Freed all at once, such masks
find each other, or the leaf that they show.
"""

from __future__ import annotations

import warnings
from dataclasses import replace

import numpy as np
import torch
from scipy.special import logit

from mvseg.errors import InputWarning
from mvseg.masks import Masks
from mvseg.matching.config import MatchConfig
from mvseg.matching.links import Links
from mvseg.matching.match import match_masks
from mvseg.scene import Cameras
from mvseg.verification.choose import SAME
from mvseg.verification.evidence import Bools, Floats, Ints
from mvseg.verification.leaf_scores import Candidates
from mvseg.verification.rough_surfaces import fit_roughly

# Masks are freed whose q for their own leaf is less: in turn, those that show another one as likely as not, and all
# that are not sure. What is found without need is not taken (`GivenScores.price`).
FREED = 0.5, 0.75


def match_again(
    masks: Masks, candidates: Candidates, leaf: Ints, *, odds: Floats, cameras: Cameras, config: MatchConfig
) -> Candidates:
    """The candidates, and after them the instances that masks form which do not show their own.

    Such masks are freed, with those matched to nothing. All others stay together as they are, instances stay apart, and
    no mask goes back to the one that it was taken from (`Links`). Where it joins another one, it counts as matched to
    that one, too.

    Args:
        masks: D masks on the CPU, matched by the method "nview": with any other, there are no more candidates.
        candidates: K instances.
        leaf: (D,) int64, the candidate that each mask was matched to; -1 for none.
        odds: (D,) log odds that it shows that one.
        cameras: V cameras.
        config: that the masks were matched with.
    """
    if config.resolved_method != "nview":
        return candidates
    for least in FREED:
        is_free = (leaf < 0) | (odds < logit(least))
        if (is_free & (leaf >= 0)).any():
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", InputWarning)  # the first matching has said it
                found = match_masks(masks, cameras, config, links=_links(leaf, is_free))
            if found.report.method == "nview":
                candidates = _with_found(candidates, found.masks, leaf, is_free=is_free, cameras=cameras)
    return candidates


def _links(leaf: Ints, is_free: Bools) -> Links:
    """What stays together and apart."""
    must: list[tuple[int, int]] = []
    cannot: list[tuple[int, int]] = []
    firsts: list[int] = []
    for instance in np.unique(leaf[leaf >= 0]).tolist():
        kept: list[int] = np.flatnonzero((leaf == instance) & ~is_free).tolist()
        if not kept:
            continue
        first, *others = kept
        must += [(first, other) for other in others]
        cannot += [(first, row) for row in np.flatnonzero((leaf == instance) & is_free).tolist()]
        cannot += [(first, earlier) for earlier in firsts]
        firsts.append(first)
    return Links.of(must, cannot)


def _with_found(candidates: Candidates, found: Masks, leaf: Ints, *, is_free: Bools, cameras: Cameras) -> Candidates:
    """The candidates, with the masks that joined them and after them the new ones with a credible surface."""
    ids, scores = found.instance_ids.numpy(), found.match_scores.double().numpy()
    matched, areas = candidates.matched.copy(), found.regions.areas.double().numpy()
    new = np.full(len(ids), -1)
    for number in np.unique(ids[is_free & (ids > 0)]).tolist():
        together = ids == number
        kept, joins = leaf[together & ~is_free], together & is_free
        if len(kept):
            matched[joins, kept[0]] = np.fmax(matched[joins, kept[0]], scores[joins])
        elif not _is_there(together, ~np.isnan(matched), areas):
            new[together] = number
    fitted = fit_roughly(replace(found, instance_ids=torch.from_numpy(new)), cameras) if (new > 0).any() else {}
    credible = {number: surface for number, surface in fitted.items() if surface.exists and surface.is_credible}
    columns = [np.where(new == number, scores, np.nan) for number in credible]
    return Candidates(
        surfaces=(*candidates.surfaces, *credible.values()),
        matched=np.column_stack((matched, *columns)),
        certain=np.column_stack((candidates.certain, *(np.zeros(len(ids), bool) for _ in columns))),
    )


def _is_there(together: Bools, others: Bools, areas: Floats) -> bool:
    """Whether one of the instances `others` (D, K) has nearly the same masks, by area."""
    both, either = (areas @ each for each in (others & together[:, None], others | together[:, None]))
    return bool((both > SAME * either).any())
