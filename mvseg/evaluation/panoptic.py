"""How good the leaves are that come out of photos: masks, ids, misses and false leaves in one judgement.

`id_metrics` asks whether the masks at hand got the right ids. Here a missed leaf counts, too, and so does a mask of no
leaf. MV-PQ is the panoptic quality (Kirillov et al., "Panoptic Segmentation", CVPR 2019) of whole leaves: all pixels of
an id in all views are one segment. Pixels that the truth ignores count for nobody, and what lies mostly there is no
false leaf. Two annotators are compared leaf by leaf in the same way.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats.contingency import crosstab
from torch import Tensor

from mvseg.arrays import Ints
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
        leaf_of_mask: (T,) int64, the label of each true mask.
        masks: each mask against the true masks.
        leaves: each instance, in all views, against the true instances.
    """

    ids: np.ndarray
    instance: np.ndarray
    labels: tuple[int, ...]
    leaf_of_mask: np.ndarray
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
    right, estimated, true = count_shared_pairs(masks, judged.instance, judged.leaf_of_mask)
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
        given = f"{len(instance_ids)} ids and {len(truth)} true label maps"
        raise InputError(f"{given}, expected {len(regions)} and {regions.num_views}, as many as regions and views")
    numbers = instance_ids.cpu().numpy()
    ids, instance = np.unique(separate_unmatched(numbers), return_inverse=True)
    visible = [np.setdiff1d(labels, (0, IGNORE_LABEL)) for labels in truth]
    leaf_of_mask = np.concatenate([np.zeros(0, np.int64), *visible])
    labels, starts = np.unique(leaf_of_mask), np.cumsum([0, *map(len, visible)])
    by_mask = (_number(*view, len(leaf_of_mask)) for view in zip(truth, visible, starts, strict=False))
    by_leaf = (_number(each, labels, 0, len(labels)) for each in truth)
    return Judged(
        ids=np.where(np.isin(ids, numbers), ids, -1),
        instance=instance,
        labels=tuple(labels.tolist()),
        leaf_of_mask=leaf_of_mask,
        masks=find_segments(regions, np.arange(len(regions)), by_mask, num_true=len(leaf_of_mask)),
        leaves=find_segments(regions, instance, by_leaf, num_true=len(labels)),
    )


def _number(labels: np.ndarray, names: np.ndarray, start: int, num_true: int) -> np.ndarray:
    """(H, W) the true segment of each pixel of a label map, as `find_segments` takes it; label `names[k]` is segment
    `start` + k."""
    places = np.searchsorted(names, labels) + start
    return np.select([labels == 0, labels == IGNORE_LABEL], [num_true, num_true + 1], places)


def find_segments(regions: Regions, segments: Ints, truth: Iterable[Ints], *, num_true: int) -> SegmentMatches:
    """Match estimated segments to true ones; of several, the one with the largest IoU counts. `segments` (D,) int64 is
    the segment that each mask is a part of, numbered from 0 on without gaps. `truth` are V maps (H, W) of true segments
    from 0 to `num_true` - 1; `num_true` is none, and `num_true` + 1 is ignored."""
    num_segments = int(segments.max(initial=-1)) + 1
    counts, true_sizes = np.zeros((num_segments, num_true + 2), np.int64), np.zeros(num_true + 2, np.int64)
    for view, numbers in enumerate(truth):
        true_sizes += np.bincount(numbers.ravel(), minlength=num_true + 2)
        members = (regions.view_index == view).nonzero()[:, 0].cpu().numpy()
        for segment in np.unique(segments[members]).tolist():
            whole = regions.union(members[segments[members] == segment].tolist())
            covered = whole.cut(numbers)[whole.pixels.cpu().numpy()]
            counts[segment] += np.bincount(covered, minlength=num_true + 2)
    sizes, ignored, shared = counts[:, :-1].sum(1), counts[:, -1], counts[:, :-2]
    iou = shared / np.maximum(sizes[:, None] + true_sizes[:-2] - shared, 1)
    finds, found_iou = np.full(num_segments, -1), np.zeros(num_segments)
    for number in range(num_true if num_segments else 0):
        best = int(iou[:, number].argmax())
        if iou[best, number] > RIGHT_IOU:
            finds[best], found_iou[best] = number, iou[best, number]
    is_false = (finds < 0) & (sizes >= ignored)
    return SegmentMatches(true_segment=finds, iou=found_iou, is_false=is_false, num_true=num_true)


def count_shared_pairs(masks: SegmentMatches, ids: np.ndarray, leaf: np.ndarray) -> tuple[int, int, int]:
    """Count pairs of estimated masks with one id that find one instance; pairs with one id (masks that are mostly
    ignored and find nothing aside); and pairs of true masks of one instance. `ids` (D,) int64 is the estimated instance
    of each mask, `leaf` (T,) int64 the true instance of each true mask."""
    is_right = masks.true_segment >= 0
    together = crosstab(leaf[masks.true_segment[is_right]], ids[is_right]).count
    estimated = np.bincount(ids[is_right | masks.is_false])
    return count_pairs(together), count_pairs(estimated), count_pairs(np.unique(leaf, return_counts=True)[1])


@dataclass(frozen=True)
class Agreement:
    """Agreement of two annotators of the same photos.

    Attributes:
        shared: leaves that both have: id of the first, id of the second, and the IoU of all their pixels in all views,
            above 0.5; by the first's ids.
        alone: ids of leaves, ascending, that only the first has, but those that the second ignores; masks without an
            id are none.
        missed: ids of leaves that only the second has.
    """

    shared: tuple[tuple[int, int, float], ...]
    alone: tuple[int, ...]
    missed: tuple[int, ...]


def compare_annotators(regions: Regions, instance_ids: Tensor, truth: Sequence[np.ndarray]) -> Agreement:
    """Compare masks with ids, of one annotator, with the label maps of another; arguments and errors as in
    `leaf_metrics`. Exchanged, they have the same shared leaves, as long as masks of one view do not overlap."""
    judged = find_all(regions, instance_ids, truth)
    leaves = zip(judged.ids.tolist(), judged.leaves.true_segment.tolist(), judged.leaves.iou.tolist(), strict=True)
    shared = tuple((leaf, judged.labels[true], iou) for leaf, true, iou in sorted(leaves) if leaf > 0 and true >= 0)
    return Agreement(
        shared=shared,
        alone=tuple(leaf for leaf in judged.ids[judged.leaves.is_false].tolist() if leaf > 0),
        missed=tuple(label for label in judged.labels if label not in {true for _, true, _ in shared}),
    )
