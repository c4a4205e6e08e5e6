"""Stage 5c: how well clusters of regions explain what all views show.

A cluster explains a pixel of a region when some point of the pixel's ray shows members of the cluster in the other
views: the rows of `rows.py`, so that neither a volume nor a surface is needed. A region's own view never counts for it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from mvseg.matching.nview.label_rows import EMPTY, RowTable, run_starts

Floats = NDArray[np.floating]
Ints = NDArray[np.int64]


@dataclass(frozen=True)
class Costs:
    """What a view counts that does not show the cluster, when one that does counts 1; the other gains, and thresholds.

    Attributes:
        missing: cost of no region there, although the cluster has one in this view.
        absent: cost of no region there when the cluster has none in this view (its mask may be missed).
        hidden: cost of the region of another cluster there; also the most that a pixel without any good row costs.
        landing: gain of a region on which all best rows of a cluster land.
        weight: gain of each region of a cluster whose epipolar weight exceeds 0.5 by 1, over V - 1; few views have
            little else to go by, and there it is larger by `weight_few` / (V - 1).
        weight_few: see `weight`.
        alone: gain of a region in no cluster.
        piece_landing: least landing on a left-over region that joins a cluster whose place is taken.
        piece_score: least score of such a region, as a share of the score of the region that holds the place.
        few: share of the views; clusters that no more of them show are doubted.
        few_landing: least landing of a cluster on a region of such a one that it takes over.
        merged_landing: least landing of a cluster on a region that it may share with another cluster.
        merged_share: least share of the pixels of such a region that it alone explains.
    """

    missing: float = 0.7
    absent: float = 0.3
    hidden: float = 0.15
    landing: float = 0.5
    weight: float = 2.0
    weight_few: float = 2.0
    alone: float = 0.0
    piece_landing: float = 0.05
    piece_score: float = 0.5
    few: float = 0.25
    few_landing: float = 0.02
    merged_landing: float = 0.25
    merged_share: float = 0.2

    def pair_factor(self, num_views: int) -> float:
        """What an epipolar weight of 1.5 in place of 0.5 gains."""
        others = max(num_views - 1, 1)
        return (self.weight + self.weight_few / others) / others


@dataclass(frozen=True, eq=False)
class Bounds:
    """Where the views stand in a `RowTable`: (V + 1,) starts of their regions, pixels and rows."""

    regions: Ints
    pixels: Ints
    rows: Ints

    def of(self, view: int) -> tuple[slice, slice, slice]:
        """Regions, pixels and rows of one view."""
        return (
            slice(int(self.regions[view]), int(self.regions[view + 1])),
            slice(int(self.pixels[view]), int(self.pixels[view + 1])),
            slice(int(self.rows[view]), int(self.rows[view + 1])),
        )


def view_bounds(table: RowTable) -> Bounds:
    """The bounds of all views of a table."""
    numbers = np.arange(table.num_views + 1)
    pixels = np.searchsorted(table.view_index[table.pixel_region], numbers)
    return Bounds(np.searchsorted(table.view_index, numbers), pixels, np.searchsorted(table.pixel, pixels))


@dataclass(frozen=True, eq=False)
class Known:
    """What was found out about clusters so far. It depends on nothing but their members, so that a cluster that stays
    as it is need not be looked at again.

    Attributes:
        scores: by view and members in other views (their indices as bytes): (N,) float32, the scores of the view's
            regions.
        landings: by members: (D,) float32, where the cluster expects to be seen.
        own: by the ids of all regions as bytes: (D,) scores of the regions in their own clusters.
    """

    scores: dict[tuple[int, bytes], Floats]
    landings: dict[bytes, Floats]
    own: dict[bytes, Floats]


def nothing_known() -> Known:
    """To start from, for one table and its costs."""
    return Known({}, {}, {})


def members_of(ids: Ints, num_clusters: int) -> list[Ints]:
    """The members of clusters 0 .. K - 1 in rising order; `ids` (D,) is K for regions that are in none."""
    order = np.argsort(ids, kind="stable")
    return np.split(order, np.searchsorted(ids[order], np.arange(1, num_clusters + 1)))[:num_clusters]


def known_scores(table: RowTable, ids: Ints, view: int, bounds: Bounds, costs: Costs, known: Known) -> Floats:
    """What `score_matrix` returns, by looking only at clusters that are not known yet; they are added to `known`."""
    num_clusters = int(ids.max(initial=0))
    keys = [(view, members.tobytes()) for members in members_of(ids, num_clusters)]
    new = np.array([k for k, key in enumerate(keys) if key not in known.scores], np.int64)
    if len(new):
        place = np.full(num_clusters + 1, len(new))
        place[new] = np.arange(len(new))
        fresh = score_matrix(table, place[ids], view, bounds, costs)
        known.scores.update({keys[k]: fresh[:, i] for i, k in enumerate(new.tolist())})
    here = bounds.of(view)[0]
    return np.stack([known.scores[key] for key in keys], 1) if keys else np.zeros((here.stop - here.start, 0))


def score_matrix(table: RowTable, ids: Ints, view: int, bounds: Bounds, costs: Costs) -> Floats:
    """Leave-one-out scores of the regions of one view in some clusters, S(n, c).

    A row scores (views that show c - hidden * views that show others - missing or absent * views that show nothing)
    / (views that the point lies in); a pixel scores as its best row, but not below -hidden; a region as the mean of its
    pixels, and -hidden without pixels.

    Args:
        table: rows of D regions.
        ids: (D,) cluster of each region in [0, K); K for regions of no cluster that is asked for, and for the regions
            of the view itself, whatever they are.
        view: the view.
        bounds: of the table.
        costs: of views that do not show the cluster.

    Returns:
        (N, K) float32 in [-hidden, 1].
    """
    best = pixel_scores(table, ids, view, bounds, costs)
    regions, pixels, _ = bounds.of(view)
    owner = table.pixel_region[pixels] - regions.start
    start = run_starts(owner)
    found = np.full((regions.stop - regions.start, best.shape[1]), -costs.hidden, np.float32)
    if len(start):
        counts = np.diff(np.append(start, len(best)))[:, None].astype(np.float32)
        found[owner[start]] = np.add.reduceat(best, start, 0) / counts
    return found


def pixel_scores(table: RowTable, ids: Ints, view: int, bounds: Bounds, costs: Costs) -> Floats:
    """(P, K) float32: the same for each of the view's pixels, see `score_matrix`."""
    _, pixels, rows = bounds.of(view)
    num_clusters = int(ids.max(initial=0))
    labels = torch.from_numpy(table.labels[rows].T.astype(np.int64))
    cluster = torch.from_numpy(np.append(ids, [num_clusters, num_clusters]))[labels]
    shown = torch.zeros(num_clusters + 1, labels.shape[1])  # rows run fastest: they are what is maximised over
    shown.scatter_add_(0, cluster, torch.ones(1).expand(cluster.shape))
    is_empty = (labels == EMPTY).float()
    num_labels = (labels >= 0).sum(0).float()
    num_inside = num_labels + is_empty.sum(0)
    cost = torch.from_numpy(_empty_costs(table, ids, num_clusters, costs)) @ is_empty
    score = shown[:num_clusters].mul_(1 + costs.hidden).sub_(cost).sub_(costs.hidden * num_labels).div_(num_inside)
    best = np.full((pixels.stop - pixels.start, num_clusters), -costs.hidden, np.float32)
    start = run_starts(table.pixel[rows])
    if len(start):
        place = table.pixel[rows][start] - pixels.start
        best[place] = np.maximum(np.maximum.reduceat(score.numpy(), start, 1), -costs.hidden).T
    return best


def _empty_costs(table: RowTable, ids: Ints, num_clusters: int, costs: Costs) -> Floats:
    """(K, V) float32: what a view without a region costs each cluster."""
    has_mask = np.zeros((num_clusters + 1, table.num_views), bool)
    has_mask[ids, table.view_index] = True
    return np.where(has_mask[:num_clusters], costs.missing, costs.absent).astype(np.float32)


def known_landings(table: RowTable, ids: Ints, costs: Costs, known: Known) -> Floats:
    """What `landing_matrix` returns, by looking only at clusters that are not known yet; they are added to `known`."""
    keys = [members.tobytes() for members in members_of(ids, int(ids.max(initial=-1)) + 1)]
    new = np.array([k for k, key in enumerate(keys) if key not in known.landings], np.int64)
    if len(new):
        fresh = landing_matrix(table, ids, costs, new)
        known.landings.update({keys[k]: fresh[i] for i, k in enumerate(new.tolist())})
    return np.stack([known.landings[key] for key in keys]) if keys else np.zeros((0, len(ids)), np.float32)


def landing_matrix(table: RowTable, ids: Ints, costs: Costs, clusters: Ints | None = None) -> Floats:
    """Where clusters expect to be seen in each view, R(c, n).

    Args:
        table: rows of D regions.
        ids: (D,) cluster of each region in [0, K).
        costs: of views that do not show the cluster.
        clusters: (C,) the clusters that are asked for; None for all K.

    Returns:
        (C, D) float32 in [0, 1]: of the pixels of c in other views than n's, the share whose best row shows n. The best
        row is chosen without n's view; pixels whose best row scores below 0 do not count, and equal rows share.
    """
    num_clusters = int(ids.max(initial=-1)) + 1
    clusters = np.arange(num_clusters) if clusters is None else clusters
    place = np.full(num_clusters, -1)
    place[clusters] = np.arange(len(clusters))
    region = table.pixel_region[table.pixel]
    rows = np.flatnonzero(place[ids[region]] >= 0)
    labels, region, pixel = table.labels[rows], region[rows], table.pixel[rows]
    own = place[ids[region]]
    gain, is_inside = own_row_gains(table, ids, costs, rows)
    total, count = gain.sum(1), is_inside.sum(1)
    start = run_starts(pixel)
    run = np.repeat(np.arange(len(start)), np.diff(np.append(start, len(total))))
    found = np.zeros((len(clusters), len(ids)), np.float32)
    for view in np.unique(table.view_index).tolist() if len(start) else ():
        score = (total - gain[:, view]) / np.maximum(count - is_inside[:, view], 1)
        best = np.maximum.reduceat(score, start)
        use = np.flatnonzero((score >= best[run] - 1e-6) & (best[run] >= 0) & (table.view_index[region] != view))
        share = 1 / np.bincount(run[use], minlength=len(start))[run[use]]
        pixels = np.bincount(own[use], share, len(clusters))
        hit = labels[use, view] >= 0
        flat = own[use][hit] * len(ids) + labels[use, view][hit]
        landed = np.bincount(flat, share[hit], len(clusters) * len(ids)).reshape(found.shape)
        found += landed / np.maximum(pixels, 1e-9)[:, None]
    return found


def own_row_gains(
    table: RowTable, ids: Ints, costs: Costs, rows: Ints | slice = slice(None)
) -> tuple[Floats, NDArray[np.bool_]]:
    """(I, V) float32, what each view of each row adds to the score of the region in its own cluster; and (I, V) bool,
    whether the point lies in that view. The sum of the gains over the number of these views is the score of the row.

    `ids` (D,) is the cluster of each region in [0, K); `rows` (I,) are the rows that are asked for, all by default.
    """
    labels, own = table.labels[rows], ids[table.pixel_region[table.pixel[rows]]]
    empty = _empty_costs(table, ids, int(ids.max(initial=-1)) + 1, costs)
    gain = np.full(labels.shape, -costs.hidden, np.float32)
    gain[np.append(ids, [-1, -1])[labels] == own[:, None]] = 1
    gain = np.where(labels == EMPTY, -empty[own], gain)
    is_inside = labels >= EMPTY
    return gain * is_inside, is_inside


def known_own_scores(table: RowTable, ids: Ints, costs: Costs, known: Known) -> Floats:
    """What `own_scores` returns, looked for once."""
    key = ids.tobytes()
    if key not in known.own:
        known.own[key] = own_scores(table, ids, costs)
    return known.own[key]


def own_scores(table: RowTable, ids: Ints, costs: Costs) -> Floats:
    """(D,) score of each region in its own cluster, its own view left out: see `nview.score_matrix`."""
    gain, is_inside = own_row_gains(table, ids, costs)
    score = gain.sum(1) / np.maximum(is_inside.sum(1), 1)
    best = np.full(len(table.pixel_region), -costs.hidden)
    start = run_starts(table.pixel)
    if len(start):
        best[table.pixel[start]] = np.maximum(np.maximum.reduceat(score, start), -costs.hidden)
    counts = np.bincount(table.pixel_region, minlength=len(ids))
    return np.bincount(table.pixel_region, best, len(ids)) / np.maximum(counts, 1)


def partition_value(
    table: RowTable, evidence: Floats, ids: Ints, costs: Costs, known: Known | None = None
) -> float:
    """What a partition is worth: the scores of all regions that are not alone, and the epipolar evidence for all pairs
    that are put together.

    Args:
        table: rows of D regions.
        evidence: (D, D) symmetric, for (> 0) or against (< 0) each pair.
        ids: (D,) cluster of each region in [0, K).
        costs: of views that do not show the cluster.
        known: what is found about the ids is added.
    """
    is_alone = np.bincount(ids)[ids] < 2
    together = (ids[:, None] == ids) & (table.view_index[:, None] != table.view_index)
    pairs = costs.pair_factor(table.num_views) * float((evidence * together).sum()) / 2
    return float(known_own_scores(table, ids, costs, known or nothing_known())[~is_alone].sum()) + pairs
