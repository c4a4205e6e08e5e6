"""Stage 5f: matching that all views must agree on.

Pairs of views cannot tell leaves apart that share their epipolar lines; a third view can. A start comes from a soft
multi-view stereo on region labels: how likely two regions are one instance, and which row of a ray is the right one,
explain each other (expectation maximisation) before there is any cluster. Then one assignment problem per view, as in
`one_per_view.py`, is decided by how well the clusters explain the regions in all views (`hypotheses.py`), and by the
epipolar weights. Regions that are left over may join a cluster whose place in their view is taken, if it expects to be
seen there too: the pieces of an instance that the segmenter split, or that a stem in front of it divides.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mvseg.matching.affinity import Affinity
from mvseg.matching.nview.cluster_scores import (
    Bounds,
    Costs,
    Known,
    known_landings,
    known_own_scores,
    known_scores,
    nothing_known,
    partition_value,
    view_bounds,
)
from mvseg.matching.nview.label_rows import RowTable, em_affinities, row_table
from mvseg.matching.nview.match_scores import Support, match_scores
from mvseg.matching.nview.merged_masks import merged_regions, second_part
from mvseg.matching.one_per_view import (
    assign_one_to_one,
    dense_ids,
    drop_singletons,
    join_alone,
    link_average,
    one_per_view_clusters,
    view_order,
)
from mvseg.matching.symnmf import renumber
from mvseg.regions import Regions
from mvseg.scene import Cameras

Floats = NDArray[np.floating]
Ints = NDArray[np.int64]

EARLY = 2  # iterations of `em_affinities` after which the affinity is a start of its own
STARTS = ((-1, 0.3), (EARLY - 1, 0.1))  # iteration whose affinity is clustered, and where agglomeration stops
AS_GOOD = 0.99  # share of the best value that pairwise clusters must reach
SECOND_CHANCE = 0.4  # mean epipolar weight with which regions that are left alone join after all
CONFIDENT = 0.5  # match score from which a region counts for its instance's support
MANY_VIEWS = 8  # more than these need no second start
WIDENINGS = (1, 2, 4, 8)  # pixels of reprojection error that are tried
EXPLAINED, UNEXPLAINED = 0.5, 0.3  # mean scores above which the poses are sound, below which the rows are of no use
# Log-odds that two regions show one instance against their epipolar weight, on degraded masks of development plants.
WEIGHTS = (0.0, 0.01, 0.05, 0.1, 0.25, 0.45, 0.65, 0.75, 0.85, 0.95, 1.0)
LOG_ODDS = (-9.0, -7.0, -6.0, -5.5, -4.2, -3.3, -2.6, -2.1, -1.0, 0.5, 1.2)
PRIOR, SPAN = 2.5, 6.0  # added to the log-odds; what divides them


@dataclass(frozen=True, eq=False)
class NViewMatching:
    """Which region shows which instance, and how sure that is.

    Attributes:
        instance_ids: (D,) int64 in [0, K), clusters numbered by their first region; -1 = matched to nothing.
        match_scores: (D,) float32 in [0, 1], the chance that the id is right; 0 for -1.
        support: (K,) int64, in how many views each instance has a region whose match score is at least 0.5.
        merged: (M, 3) int64, masks that seem to cover two instances: region, its instance, the other one;
            `merged.merged_regions` says how they are found.
        merged_parts: M (h, w) bool tensors on the CPU, where in the region's box each of these masks shows the other
            instance.
        explained: mean score of the matched regions in their clusters, 1 = every pixel is seen in all other views.
        residual_px: reprojection error that the label maps were widened by, pixels.
        method: "nview", or "one-per-view" where the rows do not explain the regions (poses too far off, two views).
    """

    instance_ids: Tensor
    match_scores: Tensor
    support: Tensor
    merged: Tensor
    merged_parts: tuple[Tensor, ...]
    explained: float
    residual_px: int
    method: str


def match_nview(regions: Regions, cameras: Cameras, affinity: Affinity, *, costs: Costs | None = None) -> NViewMatching:
    """Match the regions of V >= 2 views by what all views show.

    Args:
        regions: D regions in V views, in any order.
        cameras: V cameras.
        affinity: the epipolar weights of the regions.
        costs: None for the default ones.

    Returns:
        The matching, on the device of the regions. It does not depend on the order of views and regions, unless two
        choices are worth exactly the same, and there is no randomness in it. Without regions or edges all are -1.
    """
    order = regions.view_index.argsort(stable=True)
    ordered = regions.select(order)
    W = affinity.to_dense()[order][:, order].cpu().double().numpy()
    pairwise = one_per_view_clusters(affinity, regions.view_index, len(cameras))[order].cpu().numpy()
    costs = view_costs(len(cameras), costs or Costs())
    table, residual_px = _table_of_poses(ordered, cameras, pairwise, costs)
    known, apart = nothing_known(), dense_ids(_alone_apart(pairwise))
    ids = search(table, W, costs, apart, known) if len(cameras) > 2 else apart
    method, explained = "nview", _explained(table, ids, costs, known)
    if explained < UNEXPLAINED or len(cameras) == 2:
        ids, method, explained = apart, "one-per-view", _explained(table, apart, costs, known)
    merged = torch.from_numpy(merged_regions(table, ids, costs, known))
    parts = [second_part(ordered, table, ids, one, other, costs) for one, _, other in merged.tolist()]
    scores = torch.from_numpy(match_scores(support(table, W, ids, costs, known))).float()
    back = order.argsort().cpu()
    final = renumber(drop_singletons(ids)[back])
    confidence = scores[back] * (final >= 0)
    number = final[order.cpu()[np.unique(ids, return_index=True)[1]]]  # of each cluster
    merged = torch.cat((order.cpu()[merged[:, :1]], number[merged[:, 1:]]), 1)
    is_matched = (merged >= 0).all(1)
    return NViewMatching(
        final.to(regions.device),
        confidence.to(regions.device),
        _count_views(final, regions.view_index.cpu(), confidence).to(regions.device),
        merged[is_matched].to(regions.device),
        tuple(part for part, keep in zip(parts, is_matched.tolist(), strict=True) if keep),
        explained,
        residual_px,
        method,
    )


def _count_views(ids: Tensor, view_index: Tensor, scores: Tensor) -> Tensor:
    """(K,) int64: in how many views a region of each instance scores at least CONFIDENT."""
    seen = torch.zeros(int(ids.max()) + 1 if len(ids) else 0, int(view_index.max()) + 1 if len(ids) else 0)
    sure = (ids >= 0) & (scores >= CONFIDENT)
    seen[ids[sure], view_index[sure]] = 1
    return seen.sum(1).long()


def view_costs(num_views: int, costs: Costs) -> Costs:
    """The costs for a number of views: of three views, two do not suffice to tell a piece from a neighbour."""
    if num_views > 3:
        return costs
    return replace(costs, piece_landing=max(costs.piece_landing, 0.1), piece_score=max(costs.piece_score, 0.8))


def _table_of_poses(regions: Regions, cameras: Cameras, ids: Ints, costs: Costs) -> tuple[RowTable, int]:
    """The row table, its label maps widened by about the reprojection error, and that error in pixels.

    The error is the least widening with which the rows explain pairwise clusters nearly as well as with any.
    """
    table = row_table(regions, cameras, widen_px=WIDENINGS[0])
    apart = dense_ids(_alone_apart(ids))
    explained = [_explained(table, apart, costs)]
    if explained[0] >= EXPLAINED:
        return table, WIDENINGS[0]
    tables = [table] + [row_table(regions, cameras, widen_px=width) for width in WIDENINGS[1:]]
    explained = [_explained(wide, apart, costs) for wide in tables]
    best = int(np.argmax(np.array(explained) >= max(explained) - 0.05))
    return tables[best], WIDENINGS[best]


def _alone_apart(ids: Ints) -> Ints:
    """Ids in which each unmatched region (-1) has a number of its own."""
    return np.where(ids < 0, int(ids.max(initial=-1)) + 1 + np.arange(len(ids)), ids)


def _explained(table: RowTable, ids: Ints, costs: Costs, known: Known | None = None) -> float:
    """Mean score of the regions that are not alone in their cluster; 0 without any."""
    together = np.bincount(ids, minlength=1)[ids] > 1
    scores = known_own_scores(table, ids, costs, known or nothing_known())
    return float(scores[together].mean()) if together.any() else 0.0


def search(table: RowTable, W: Floats, costs: Costs, pairwise: Ints, known: Known | None = None) -> Ints:
    """The best partition that refinement finds from one start, or, with few views, two.

    Clusters from the weights alone are kept when they are worth nearly as much: then the masks are sound, and the
    weights know better what becomes of slivers that few views show.

    Args:
        table: rows of D regions.
        W: (D, D) symmetric epipolar weights.
        costs: of views that do not show a cluster.
        pairwise: (D,) int64, clusters from the weights alone, in [0, K).
        known: scores and landings of the same table and costs; what is found is added.

    Returns:
        (D,) int64 cluster of each region in [0, K), regions alone included.
    """
    known = known or nothing_known()
    history = em_affinities(table)
    evidence = weight_evidence(W)
    found = []
    for iteration, stop in STARTS[: 1 if table.num_views > MANY_VIEWS else None]:
        ids = link_average(history[iteration], table.view_index, table.num_views, stop)
        ids = refine(table, W, ids, costs, known=known)
        found.append(refine(table, W, ids, costs, join_pieces=True, known=known))
    values = [partition_value(table, evidence, ids, costs, known) for ids in (pairwise, *found)]
    best = pairwise
    if max(values) - values[0] > (1 - AS_GOOD) * abs(max(values)):
        best = found[int(np.argmax(values[1:]))]
        best = join_alone(W, table.view_index, table.num_views, best, SECOND_CHANCE)
    return join_few(table, W, best, costs, known)


def weight_evidence(W: Floats) -> Floats:
    """(D, D) for (> 0) or against (< 0) each pair of regions being one instance, from its epipolar weight."""
    return (np.interp(W, WEIGHTS, LOG_ODDS) + PRIOR) / SPAN


def refine(
    table: RowTable,
    W: Floats,
    ids: Ints,
    costs: Costs,
    *,
    num_sweeps: int = 3,
    join_pieces: bool = False,
    known: Known | None = None,
) -> Ints:
    """Re-assign the regions of one view after another to the clusters of the others.

    Args:
        table: rows of D regions.
        W: (D, D) symmetric epipolar weights.
        ids: (D,) clusters to start from.
        costs: of views that do not show a cluster.
        num_sweeps: at most so many times through all views; fewer when nothing changes.
        join_pieces: left-over regions may join a cluster whose place in their view is taken.
        known: scores and landings of the same table and costs; what is found is added.

    Returns:
        (D,) int64 cluster of each region in [0, K), numbered by their first region; regions alone included.
    """
    bounds, ids, evidence = view_bounds(table), dense_ids(ids), weight_evidence(W)
    known = known or nothing_known()
    order = view_order(W, table.view_index, table.num_views)
    for _ in range(num_sweeps):
        before = dense_ids(ids)
        ids, landing = before.copy(), known_landings(table, before, costs, known)
        for view in order.tolist():
            here = bounds.of(view)[0]
            if here.start == here.stop:
                continue
            gains = view_gains(table, evidence, ids, landing, view, bounds, costs, known)
            chosen = assign_one_to_one(gains.total, costs.alone)
            if join_pieces:
                chosen = _join_pieces(chosen, gains, costs)
            fresh = ids.max() + 1 + np.arange(len(chosen))
            ids[here] = np.append(gains.clusters, fresh)[chosen]
        if (dense_ids(ids) == before).all():
            break
    return dense_ids(ids)


@dataclass(frozen=True, eq=False)
class ViewGains:
    """What the N regions of one view gain from the K clusters that the other views form.

    Attributes:
        clusters: (K,) int64, their ids.
        score: (N, K), S(n, c).
        landing: (N, K), share of the best rows of c that land on n.
        total: (N, K), both and the epipolar evidence.
    """

    clusters: Ints
    score: Floats
    landing: Floats
    total: Floats


def view_gains(
    table: RowTable,
    evidence: Floats,
    ids: Ints,
    landing: Floats,
    view: int,
    bounds: Bounds,
    costs: Costs,
    known: Known,
) -> ViewGains:
    """The gains of one view. `landing` may know fewer clusters than `ids` has: the others expect to land nowhere."""
    here = bounds.of(view)[0]
    is_other = table.view_index != view
    clusters, inverse = np.unique(ids[is_other], return_inverse=True)
    compact = np.full(len(ids), len(clusters))
    compact[is_other] = inverse
    score = known_scores(table, compact, view, bounds, costs, known)
    expected = np.zeros_like(score)
    has_landing = clusters < len(landing)
    expected[:, has_landing] = landing[clusters[has_landing], here].T
    members = np.zeros((len(ids), len(clusters) + 1))
    members[np.arange(len(ids)), compact] = 1
    pairs = costs.pair_factor(table.num_views) * (evidence[here] @ members[:, :-1])
    return ViewGains(clusters, score, expected, score + costs.landing * expected + pairs)


def join_few(table: RowTable, W: Floats, ids: Ints, costs: Costs, known: Known) -> Ints:
    """Dissolve clusters that few views show into those that expect to be seen where they are.

    Pieces of split masks, and masks that are merged with something else, find each other across views and make up
    clusters that stand for nothing. A region of such a cluster joins the larger one that expects most to be seen on
    it and explains some of it, whether its place is taken or not; if there is one. With three views no cluster is
    seen often enough to be doubted.

    Args:
        table: rows of D regions.
        W: (D, D) symmetric epipolar weights.
        ids: (D,) cluster of each region in [0, K).
        costs: of views that do not show a cluster.
        known: what is found about clusters is added.

    Returns:
        (D,) int64 cluster of each region in [0, K), numbered by their first region.
    """
    ids, bounds, evidence = dense_ids(ids), view_bounds(table), weight_evidence(W)
    num_clusters, views = int(ids.max(initial=-1)) + 1, table.view_index
    is_shown = np.zeros((num_clusters, table.num_views), bool)
    is_shown[ids, views] = True
    is_few = is_shown.sum(1) <= max(1, costs.few * table.num_views)
    if table.num_views < 4 or not is_few.any():
        return ids
    landing, joined = known_landings(table, ids, costs, known), ids.copy()
    for view in np.unique(views[is_few[ids]]).tolist():
        here = bounds.of(view)[0]
        gains = view_gains(table, evidence, ids, landing, view, bounds, costs, known)
        fits = ~is_few[gains.clusters] & (gains.landing >= costs.few_landing) & (gains.score > 0)
        moves = is_few[ids[here]] & fits.any(1)
        if moves.any():
            joined[here][moves] = gains.clusters[np.where(fits, gains.landing, -1)[moves].argmax(1)]
    return dense_ids(joined)


def _join_pieces(chosen: Ints, gains: ViewGains, costs: Costs) -> Ints:
    """Put left-over regions into taken clusters that expect to be seen on them and explain them well."""
    is_in = chosen < len(gains.clusters)
    holder = np.full(len(gains.clusters), np.inf)
    holder[chosen[is_in]] = gains.score[is_in, chosen[is_in]]
    fits = (gains.landing >= costs.piece_landing) & (gains.score >= costs.piece_score * holder) & (gains.score > 0)
    value = np.where(fits, gains.score + costs.landing * gains.landing, -np.inf)
    joins = ~is_in & fits.any(1)
    chosen = chosen.copy()
    if joins.any():
        chosen[joins] = value[joins].argmax(1)
    return chosen


def support(table: RowTable, W: Floats, ids: Ints, costs: Costs, known: Known) -> Support:
    """What speaks for the id of each region: see `Support`. Regions alone in their cluster have no support."""
    bounds, evidence, landing = view_bounds(table), weight_evidence(W), known_landings(table, ids, costs, known)
    score, own, rival, landed = (np.zeros(len(ids)) for _ in range(4))
    for view in np.unique(table.view_index).tolist():
        here = bounds.of(view)[0]
        gains = view_gains(table, evidence, ids, landing, view, bounds, costs, known)
        is_own = ids[here][:, None] == gains.clusters
        score[here] = (gains.score * is_own).sum(1)
        own[here] = (gains.total * is_own).sum(1)
        rival[here] = np.where(is_own, costs.alone, gains.total).max(1, initial=costs.alone)
        landed[here] = (gains.landing * is_own).sum(1)
    together = (ids[:, None] == ids) & (table.view_index[:, None] != table.view_index)
    num_partners = together.sum(1)
    mean_weight = (W * together).sum(1) / np.maximum(num_partners, 1)
    num_pieces = ((ids[:, None] == ids) & (table.view_index[:, None] == table.view_index)).sum(1)
    return Support(score, own - rival, landed, mean_weight, num_partners, num_pieces, table.num_views)
