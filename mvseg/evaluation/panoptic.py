"""How good the leaves are that come out of photos: masks, ids, misses and false leaves in one judgement.

`id_metrics` asks whether the masks at hand got the right ids. Here a missed leaf counts, too, and so does a mask of no
leaf. MV-PQ is the panoptic quality (Kirillov et al., "Panoptic Segmentation", CVPR 2019) of whole leaves: all pixels of
an id in all views are one segment. Pixels that the truth ignores count for nobody, and what lies mostly there is no
false leaf.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats.contingency import crosstab
from torch import Tensor

from mvseg.errors import InputError
from mvseg.evaluation.id_metrics import count_pairs, share
from mvseg.matching.partition import separate_unmatched
from mvseg.regions import IGNORE_LABEL, Regions

RIGHT_IOU = 0.5  # definition: above it, a segment finds a true one: never two, because the true ones do not overlap


@dataclass(frozen=True)
class LeafMetrics:
    """Agreement of estimated masks and ids with all true ones; every share is 1 where there is nothing to count.

    Attributes:
        mask_precision: share of the estimated masks that find a true mask of their view (IoU above 0.5; one each).
        mask_recall: share of the true masks that are found.
        all_pair_precision: of the pairs of estimated masks with one id, the share whose masks find the same instance.
        all_pair_recall: of the pairs of true masks of one instance, the share that are found under one id.
        all_pair_f1: their harmonic mean.
        mv_pq: sum of IoU / (TP + FP / 2 + FN / 2) over whole instances in all views.
        num_right: TP, estimated instances whose IoU with a true one exceeds 0.5.
        num_false: FP, the other estimated instances; every unmatched mask is one.
        num_missed: FN, true instances that no estimated one finds.
    """

    mask_precision: float
    mask_recall: float
    all_pair_precision: float
    all_pair_recall: float
    all_pair_f1: float
    mv_pq: float
    num_right: int
    num_false: int
    num_missed: int


@dataclass(frozen=True)
class SegmentMatches:
    """P estimated segments against T true ones.

    Attributes:
        true_segment: (P,) int64, the true segment that each one finds, -1 for none.
        iou: (P,) float64 with it, 0 for none.
        is_false: (P,) bool: finds nothing, and is not mostly ignored.
    """

    true_segment: np.ndarray
    iou: np.ndarray
    is_false: np.ndarray
    num_true: int

    @property
    def num_right(self) -> int:
        return int((self.true_segment >= 0).sum())


@dataclass(frozen=True)
class Judged:
    """D masks of P instances against all true ones.

    Attributes:
        ids: (P,) int64, of each instance; -1 for a mask that is matched to nothing, which is one of its own.
        instance: (D,) int64, the index of each mask's instance.
        labels: of the true instances, ascending.
        leaf_of_mask: the label of each true mask.
        masks: each mask against the true masks.
        leaves: each instance, in all views, against the true instances.
    """

    ids: np.ndarray
    instance: np.ndarray
    labels: tuple[int, ...]
    leaf_of_mask: tuple[int, ...]
    masks: SegmentMatches
    leaves: SegmentMatches


def leaf_metrics(regions: Regions, instance_ids: Tensor, truth: Sequence[np.ndarray]) -> LeafMetrics:
    """Judge masks with ids by true label maps. Raises InputError for another number of ids than of regions, or of maps
    than of views.

    Args:
        regions: D estimated masks in V views; they may overlap.
        instance_ids: (D,) int64, -1 = matched to nothing: an instance of its own.
        truth: V integer label maps (H, W) in the frames of the regions, the same number for the same instance in every
            view; 0 = no instance, 65535 = ignore.
    """
    judged = find_all(regions, instance_ids, truth)
    masks, leaves = judged.masks, judged.leaves
    right, estimated, true = count_shared_pairs(masks, judged.instance, np.array(judged.leaf_of_mask, np.int64))
    num_false, num_missed = int(leaves.is_false.sum()), leaves.num_true - leaves.num_right
    return LeafMetrics(
        mask_precision=share(masks.num_right, masks.num_right + int(masks.is_false.sum())),
        mask_recall=share(masks.num_right, masks.num_true),
        all_pair_precision=share(right, estimated),
        all_pair_recall=share(right, true),
        all_pair_f1=share(2 * right, estimated + true),
        mv_pq=share(float(leaves.iou.sum()), leaves.num_right + (num_false + num_missed) / 2),
        num_right=leaves.num_right,
        num_false=num_false,
        num_missed=num_missed,
    )


def find_all(regions: Regions, instance_ids: Tensor, truth: Sequence[np.ndarray]) -> Judged:
    """Match each mask, and each instance, to the truth; see `leaf_metrics` for the arguments and what is raised."""
    if len(instance_ids) != len(regions) or len(truth) != regions.num_views:
        raise InputError(
            f"{len(instance_ids)} ids and {len(truth)} true label maps, "
            f"expected {len(regions)} and {regions.num_views}, as many as regions and views"
        )
    numbers = instance_ids.cpu().numpy()
    ids, instance = np.unique(separate_unmatched(numbers), return_inverse=True)
    visible = [[label for label in np.unique(labels).tolist() if label not in (0, IGNORE_LABEL)] for labels in truth]
    true_masks = [(view, label) for view, of_view in enumerate(visible) for label in of_view]
    mask_number = {key: number for number, key in enumerate(true_masks)}
    leaf_number = {label: number for number, label in enumerate(sorted({label for _, label in true_masks}))}
    by_mask = [{label: mask_number[view, label] for label in of_view} for view, of_view in enumerate(visible)]
    by_leaf = [{label: leaf_number[label] for label in of_view} for of_view in visible]
    return Judged(
        ids=np.where(np.isin(ids, numbers), ids, -1),
        instance=instance,
        labels=tuple(leaf_number),
        leaf_of_mask=tuple(label for _, label in true_masks),
        masks=find_segments(regions, np.arange(len(regions)), truth, numbers=by_mask),
        leaves=find_segments(regions, instance, truth, numbers=by_leaf),
    )


def find_segments(
    regions: Regions, segments: np.ndarray, truth: Sequence[np.ndarray], *, numbers: Sequence[Mapping[int, int]]
) -> SegmentMatches:
    """Match estimated segments to true ones; of several, the one with the largest IoU counts. `segments` (D,) int64 is
    the segment that each mask is a part of, `truth` are V label maps, and `numbers` V mappings, label -> true segment;
    segments are numbered from 0 on without gaps."""
    num_segments = int(segments.max(initial=-1)) + 1
    num_true = len({number for of_view in numbers for number in of_view.values()})
    shared = np.zeros((num_segments, num_true), np.int64)
    sizes, ignored, true_sizes = (np.zeros(n, np.int64) for n in (num_segments, num_segments, num_true))
    for view, labels in enumerate(truth):
        for label, count in _count(labels):
            if label in numbers[view]:
                true_sizes[numbers[view][label]] += count
        for segment, covered in _covered_labels(regions, segments, view, labels=labels):
            for label, count in _count(covered):
                (ignored if label == IGNORE_LABEL else sizes)[segment] += count
                if label in numbers[view]:
                    shared[segment, numbers[view][label]] += count
    iou = shared / np.maximum(sizes[:, None] + true_sizes - shared, 1)
    finds, found_iou = np.full(num_segments, -1), np.zeros(num_segments)
    for number in range(num_true if num_segments else 0):
        best = int(iou[:, number].argmax())
        if iou[best, number] > RIGHT_IOU:
            finds[best], found_iou[best] = number, iou[best, number]
    is_false = (finds < 0) & (sizes >= ignored)
    return SegmentMatches(true_segment=finds, iou=found_iou, is_false=is_false, num_true=num_true)


def _count(labels: np.ndarray) -> Iterator[tuple[int, int]]:
    numbers, counts = np.unique(labels, return_counts=True)
    return zip(numbers.tolist(), counts.tolist(), strict=True)


def _covered_labels(
    regions: Regions, segments: np.ndarray, view: int, *, labels: np.ndarray
) -> Iterator[tuple[int, np.ndarray]]:
    members = (regions.view_index == view).nonzero()[:, 0].cpu().numpy()
    for segment in np.unique(segments[members]).tolist():
        covered = regions.union(members[segments[members] == segment].tolist())
        yield segment, covered.cut(labels)[covered.pixels.cpu().numpy()]


def count_shared_pairs(masks: SegmentMatches, ids: np.ndarray, leaf: np.ndarray) -> tuple[int, int, int]:
    """Count pairs of estimated masks with one id that find one instance; pairs with one id (masks that are mostly
    ignored and find nothing aside); and pairs of true masks of one instance. `ids` (D,) int64 is the estimated instance
    of each mask, `leaf` (T,) int64 the true instance of each true mask."""
    is_right = masks.true_segment >= 0
    together = crosstab(leaf[masks.true_segment[is_right]], ids[is_right]).count
    estimated = np.bincount(ids[is_right | masks.is_false])
    return count_pairs(together), count_pairs(estimated), count_pairs(np.unique(leaf, return_counts=True)[1])
