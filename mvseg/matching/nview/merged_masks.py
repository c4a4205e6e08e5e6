"""Masks that cover two instances, and which part of them shows the second one."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mvseg.masks import MergedMask
from mvseg.matching.numbers import PIECES
from mvseg.matching.nview.cluster_scores import ClusterScores
from mvseg.matching.partition import Clusters
from mvseg.regions import Regions


def find_merged(scores: ClusterScores, clusters: Clusters, regions: Regions) -> tuple[MergedMask, ...]:
    """Masks that cover two instances: two clusters explain disjoint parts of them.

    A cluster that has no region in a view, but covers one that belongs to another cluster, may share it. A pixel is
    explained by a cluster when it scores nearly as well as the cluster's regions do in the median, see `PIECES`. Of
    several such clusters, the one that explains most of the pixels that the region's own cluster does not is its
    second.

    Args:
        scores: of D regions, ordered by view.

    Returns:
        One entry per such mask, by view; the ids are cluster numbers plus one.
    """
    is_second = _may_be_second(scores, clusters)
    merged = []
    for view in range(scores.sweep.num_views):
        for region, second in _shared_in_view(scores, clusters, view, is_second=is_second):
            part = second_part(scores, clusters, regions, region=region, second=second)
            merged.append(MergedMask(region=region, own=int(clusters.ids[region]) + 1, other=second + 1, part=part))
    return tuple(merged)


def _may_be_second(scores: ClusterScores, clusters: Clusters) -> NDArray[np.bool_]:
    """(K, D) bool: the cluster is seen in enough views, has no region in the region's view, and covers the region."""
    views = scores.sweep.view_index
    coverages = scores.coverages(clusters)
    is_shown = np.zeros((len(clusters), scores.sweep.num_views), bool)
    is_shown[clusters.ids, views] = True
    is_seen_enough = is_shown.sum(1) >= max(2, PIECES.few * scores.sweep.num_views)
    is_second = (coverages >= PIECES.merged_coverage) & is_seen_enough[:, None] & is_seen_enough[clusters.ids]
    return is_second & ~is_shown[:, views]


def _shared_in_view(
    scores: ClusterScores, clusters: Clusters, view: int, *, is_second: NDArray[np.bool_]
) -> list[tuple[int, int]]:
    """Regions of one view that two clusters share, with the second cluster."""
    here = np.flatnonzero(scores.sweep.view_index == view)
    shared = here[is_second[:, here].any(0)]
    if not len(shared):
        return []
    asked = np.union1d(np.flatnonzero(is_second[:, here].any(1)), clusters.ids[shared])
    column = np.full(len(is_second), -1)
    column[asked] = np.arange(len(asked))
    own = scores.own(clusters)
    median_score = np.array([np.median(own[clusters.members[number]]) for number in asked])
    least = PIECES.as_good * median_score[:, None]
    is_explained = scores.pixel_scores(view, column[clusters.ids]) >= least
    pixel_region = scores.sweep.pixel_region[scores.sweep.bounds.pixels(view)]
    pairs = []
    for region in shared.tolist():
        candidates = np.append(clusters.ids[region], np.flatnonzero(is_second[:, region]))
        part = is_explained[column[candidates]][:, pixel_region == region]
        share = (part & ~part[0]).mean(1)
        best = int(share.argmax())
        if share[best] >= PIECES.merged_share:
            pairs.append((region, int(candidates[best])))
    return pairs


def second_part(scores: ClusterScores, clusters: Clusters, regions: Regions, *, region: int, second: int) -> Tensor:
    """Part of a merged mask that shows its second instance: where its cluster explains the nearest sampled pixels
    better.

    Args:
        scores: of D regions, ordered by view.

    Returns:
        (h, w) bool on the CPU, in the region's box and inside its mask; nowhere for a region without sampled pixels.
    """
    sweep = scores.sweep
    view = int(sweep.view_index[region])
    pixels = sweep.bounds.pixels(view)
    is_here = sweep.pixel_region[pixels] == region
    mask = regions.crop(region).cpu()
    part, mask_pixels = torch.zeros_like(mask), mask.nonzero()
    if not is_here.any():
        return part
    ids = clusters.ids
    pair = np.where(ids == ids[region], 0, np.where(ids == second, 1, -1))
    pixel_scores = scores.pixel_scores(view, pair)[:, is_here]
    sampled = torch.from_numpy(sweep.pixel_xy[pixels][is_here]) - regions.boxes[region, :2].cpu()
    distance, num = torch.cdist(mask_pixels.flip(1) + 0.5, sampled), min(PIECES.neighbours, len(sampled))
    nearest = distance.topk(num, largest=False).indices
    advantage = torch.from_numpy(pixel_scores[1] - pixel_scores[0])[nearest].mean(1)
    part[mask_pixels[:, 0], mask_pixels[:, 1]] = advantage > 0
    return part
