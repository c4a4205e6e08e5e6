"""Leaves that edits confirm as they are: they stay as the user saw them. Not in the paper."""

from __future__ import annotations

import torch
from torch import Tensor

from mvseg.corrections.corrected import Corrected
from mvseg.masks import Masks


def unchanged_leaves(corrected: Corrected, ids: Tensor, before: Masks) -> Tensor:
    """Find the leaves that edits mention but do not change: none of their masks is gone, changed, kept apart from
    another one, or linked to one of another leaf, and the leaf is not rejected.

    Args:
        corrected: D masks and their links.
        ids: (D,) int64, the leaves that they showed before the edits.
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
    named = ids[corrected.masks.is_corrected | corrected.masks.is_linked]
    leaves = named[named > 0].unique()
    return leaves[~torch.isin(leaves, torch.cat(changed))]


def leave_joined(previous: Tensor, matched_ids: Tensor, is_held: Tensor) -> Tensor:
    """`previous` (D,), with -1 for every leaf that other masks join: at least half of the masks of such a leaf are
    matched to a mask that the user speaks of, and that is of no unchanged leaf.

    Args:
        previous: (D,) int64, ids of unchanged leaves; -1 for all other masks.
        matched_ids: (D,) int64, the ids of the masks matched anew.
        is_held: (D,) bool, the masks that the user speaks of.
    """
    is_other = is_held & (previous < 1) & (matched_ids > 0)
    is_joined = torch.isin(matched_ids, matched_ids[is_other])
    num = int(previous.max().clamp(min=0)) + 1 if len(previous) else 1
    is_known = previous > 0
    joined, all_of = (torch.bincount(previous[each & is_known], minlength=num) for each in (is_joined, is_known))
    return previous.where((2 * joined < all_of)[previous.clamp(min=0)] & (previous > 0), -1)
