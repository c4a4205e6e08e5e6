"""How well clusters of regions explain what all views show.

A cluster explains a pixel of a region when some point of the pixel's ray shows members of the cluster in the other
views: the rows of `label_rows.py`, so that neither a volume nor a surface is needed. A region's own view never counts.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise

import numpy as np
import torch
from numpy.typing import NDArray

from mvseg.matching.nview.config import NViewConfig
from mvseg.matching.nview.label_rows import EMPTY, RowTable, run_starts
from mvseg.matching.one_per_view import ViewGraph

# Log-odds that two regions show one instance, by epipolar weight; measured on degraded masks of development plants.
WEIGHTS = (0.0, 0.01, 0.05, 0.1, 0.25, 0.45, 0.65, 0.75, 0.85, 0.95, 1.0)
LOG_ODDS = (-9.0, -7.0, -6.0, -5.5, -4.2, -3.3, -2.6, -2.1, -1.0, 0.5, 1.2)
PRIOR, SPAN = 2.5, 6.0  # evidence = (log-odds + PRIOR) / SPAN

Floats = NDArray[np.floating]
Ints = NDArray[np.int64]


def members_of(clusters: Ints, num_clusters: int) -> list[Ints]:
    """The members of clusters 0 .. K - 1 in ascending order; an unused number has none, -1 is left out."""
    order = np.argsort(clusters, kind="stable")
    starts = np.searchsorted(clusters[order], np.arange(num_clusters + 1))
    return [order[start:stop] for start, stop in pairwise(starts)]


@dataclass(frozen=True, eq=False)
class ViewGains:
    """What the N regions of one view would gain by joining the K clusters that the other views form.

    Attributes:
        clusters: (K,) int64, their numbers.
        score: (N, K), S(n, c): see `ClusterScores.scores`.
        landing: (N, K), share of the best rows of c that land on n.
        total: (N, K), the gain: score, weighted landing and epipolar evidence.
    """

    clusters: Ints
    score: Floats
    landing: Floats
    total: Floats


@dataclass(frozen=True, eq=False)
class ClusterScores:
    """Scores of any clusters of the D regions of one table.

    Results depend only on the members of a cluster and are cached by members: while the search moves some regions,
    unchanged clusters cost nothing.

    Attributes:
        table: rows of D regions, ordered by view.
        graph: their epipolar weights.
        config: costs, gains and thresholds for this number of views.
    """

    table: RowTable
    graph: ViewGraph
    config: NViewConfig
    _scores: dict[tuple[int, bytes], Floats] = field(default_factory=dict, init=False, repr=False)
    _landings: dict[bytes, Floats] = field(default_factory=dict, init=False, repr=False)
    _own: dict[bytes, Floats] = field(default_factory=dict, init=False, repr=False)

    @cached_property
    def evidence(self) -> Floats:
        """(D, D) evidence for (> 0) or against (< 0) a pair of regions being one instance, from its epipolar weight."""
        return (np.interp(self.graph.weights, WEIGHTS, LOG_ODDS) + PRIOR) / SPAN

    def scores(self, view: int, clusters: Ints) -> Floats:
        """Leave-one-out scores of the regions of one view in clusters, S(n, c).

        A row scores (views that show c - hidden * views that show others - missing or absent * views that show nothing)
        / (views that the point lies in); a pixel takes the score of its best row, but at least -hidden; a region
        takes the mean of its pixels, or -hidden without pixels.

        Args:
            view: the view.
            clusters: (D,) cluster of each region in [0, K), -1 for regions to leave out. Regions of the view itself do
                not count.

        Returns:
            (N, K) float32 in [-hidden, 1].
        """
        members = self._members_elsewhere(view, clusters)
        keys = [(view, cluster.tobytes()) for cluster in members]
        new = [k for k, key in enumerate(keys) if key not in self._scores]
        if new:
            fresh = self._score_clusters(view, [members[k] for k in new])
            self._scores.update({keys[k]: fresh[:, column] for column, k in enumerate(new)})
        regions = self.table.bounds.regions(view)
        return np.stack([self._scores[key] for key in keys], 1) if keys else np.zeros((regions.stop - regions.start, 0))

    def pixel_scores(self, view: int, clusters: Ints) -> Floats:
        """(P, K) float32: the scores of the view's P sampled pixels, see `scores`."""
        return self._score_pixels(view, self._members_elsewhere(view, clusters))

    def landings(self, clusters: Ints) -> Floats:
        """Where clusters expect to be seen in each view, R(c, n).

        Args:
            clusters: (D,) cluster of each region in [0, K).

        Returns:
            (K, D) float32 in [0, 1]: of the pixels of c in other views than n's, the share whose best row shows n. The
            best row is chosen without n's view; pixels whose best row scores below 0 do not count, and rows that
            tie share the pixel.
        """
        keys = [members.tobytes() for members in members_of(clusters, int(clusters.max(initial=-1)) + 1)]
        new = np.array([k for k, key in enumerate(keys) if key not in self._landings], np.int64)
        if len(new):
            fresh = self._land(clusters, new)
            self._landings.update({keys[k]: fresh[row] for row, k in enumerate(new.tolist())})
        return np.stack([self._landings[key] for key in keys]) if keys else np.zeros((0, len(clusters)), np.float32)

    def landed_clusters(self) -> list[Ints]:
        """The members of every cluster whose landings were asked for: all that a search has seen."""
        return [np.frombuffer(key, np.int64) for key in self._landings]

    def own(self, clusters: Ints) -> Floats:
        """(D,) score of each region in its own cluster, its own view left out; `clusters` (D,) in [0, K)."""
        key = clusters.tobytes()
        if key not in self._own:
            self._own[key] = self._score_own(clusters)
        return self._own[key]

    def value(self, clusters: Ints) -> float:
        """What a partition is worth: the scores of all regions that are not alone, and the epipolar evidence for all
        pairs in one cluster; `clusters` (D,) in [0, K)."""
        is_alone = np.bincount(clusters)[clusters] < 2
        pairs = self.pair_factor * float((self.evidence * self.together(clusters)).sum()) / 2
        return float(self.own(clusters)[~is_alone].sum()) + pairs

    def explained(self, clusters: Ints) -> float:
        """Mean score of the regions that are not alone in their cluster; 0 without any."""
        is_together = np.bincount(clusters, minlength=1)[clusters] > 1
        return float(self.own(clusters)[is_together].mean()) if is_together.any() else 0.0

    def explained_per_view(self, clusters: Ints) -> Floats:
        """(V,) float64: `explained` of the regions of each view; NaN without any."""
        is_together = np.bincount(clusters, minlength=1)[clusters] > 1
        views, scores = self.table.view_index[is_together], self.own(clusters)[is_together]
        counts, total = (np.bincount(views, weights, self.table.num_views) for weights in (None, scores))
        return np.where(counts > 0, total / np.maximum(counts, 1), np.nan)

    def gains(self, view: int, clusters: Ints, landings: Floats) -> ViewGains:
        """What the regions of one view would gain by joining the clusters of the other views.

        Args:
            view: the view.
            clusters: (D,) cluster of each region in [0, K).
            landings: `landings` of an earlier partition; newer clusters, which have no row there, land nowhere.
        """
        here = self.table.bounds.regions(view)
        is_other = self.table.view_index != view
        numbers, inverse = np.unique(clusters[is_other], return_inverse=True)
        compact = np.full(len(clusters), -1)
        compact[is_other] = inverse
        score = self.scores(view, compact)
        landing = np.zeros_like(score)
        has_landing = numbers < len(landings)
        landing[:, has_landing] = landings[numbers[has_landing], here].T
        members = np.zeros((len(clusters), len(numbers) + 1))
        members[np.arange(len(clusters)), compact] = 1  # the last column collects the view itself
        pairs = self.pair_factor * (self.evidence[here] @ members[:, :-1])
        return ViewGains(numbers, score, landing, score + self.config.gains.landing * landing + pairs)

    @property
    def pair_factor(self) -> float:
        """Gain per unit of epipolar evidence for a pair, in this number of views."""
        return self.config.gains.pair_factor(self.table.num_views)

    def together(self, clusters: Ints) -> NDArray[np.bool_]:
        """(D, D) whether two regions of different views are in one cluster."""
        views = self.table.view_index
        return (clusters[:, None] == clusters) & (views[:, None] != views)

    def _members_elsewhere(self, view: int, clusters: Ints) -> list[Ints]:
        """The members of clusters 0 .. K - 1 in other views."""
        elsewhere = np.where(self.table.view_index == view, -1, clusters)
        return members_of(elsewhere, int(clusters.max(initial=-1)) + 1)

    def _score_clusters(self, view: int, members: list[Ints]) -> Floats:
        """(N, C) float32: the scores of the view's regions in C clusters."""
        best = self._score_pixels(view, members)
        regions, pixels = self.table.bounds.regions(view), self.table.bounds.pixels(view)
        owner = self.table.pixel_region[pixels] - regions.start
        start = run_starts(owner)
        score = np.full((regions.stop - regions.start, len(members)), -self.config.costs.hidden, np.float32)
        if len(start):
            counts = np.diff(np.append(start, len(best)))[:, None].astype(np.float32)
            score[owner[start]] = np.add.reduceat(best, start, 0) / counts
        return score

    def _score_pixels(self, view: int, members: list[Ints]) -> Floats:
        """(P, C) float32: the scores of the view's pixels in C clusters without members in this view."""
        table, hidden, num_clusters = self.table, self.config.costs.hidden, len(members)
        pixels, rows = table.bounds.pixels(view), table.bounds.rows(view)
        number_of = np.full(len(table.view_index) + 2, num_clusters)  # the last two for EMPTY and OUTSIDE
        for number, regions in enumerate(members):
            number_of[regions] = number
        # torch on the CPU: NumPy has no match for its scatter_add
        labels = torch.from_numpy(table.labels[rows].T.astype(np.int64))
        cluster = torch.from_numpy(number_of)[labels]
        shown = torch.zeros(num_clusters + 1, labels.shape[1])  # rows vary fastest: the maximum runs over them
        shown.scatter_add_(0, cluster, torch.ones(1).expand(cluster.shape))
        is_empty = (labels == EMPTY).float()
        num_labels = (labels >= 0).sum(0).float()
        num_inside = num_labels + is_empty.sum(0)
        cost = torch.from_numpy(self._empty_costs(members)) @ is_empty
        score = shown[:num_clusters].mul_(1 + hidden).sub_(cost).sub_(hidden * num_labels).div_(num_inside)
        best = np.full((pixels.stop - pixels.start, num_clusters), -hidden, np.float32)
        start = run_starts(table.pixel[rows])
        if len(start):
            pixel = table.pixel[rows][start] - pixels.start
            best[pixel] = np.maximum(np.maximum.reduceat(score.numpy(), start, 1), -hidden).T
        return best

    def _empty_costs(self, members: list[Ints]) -> Floats:
        """(C, V) float32: what a view without a region costs each cluster."""
        has_mask = np.zeros((len(members), self.table.num_views), bool)
        for number, regions in enumerate(members):
            has_mask[number, self.table.view_index[regions]] = True
        return np.where(has_mask, self.config.costs.missing, self.config.costs.absent).astype(np.float32)

    def _land(self, clusters: Ints, asked: Ints) -> Floats:
        """(C, D) float32: the landings of the C clusters in `asked`."""
        table = self.table
        row_of = np.full(int(clusters.max(initial=-1)) + 1, -1)
        row_of[asked] = np.arange(len(asked))
        region = table.pixel_region[table.pixel]
        rows = np.flatnonzero(row_of[clusters[region]] >= 0)
        labels, region, pixel = table.labels[rows], region[rows], table.pixel[rows]
        cluster = row_of[clusters[region]]
        gain, is_inside = self._row_gains(clusters, rows)
        total, count = gain.sum(1), is_inside.sum(1)
        start = run_starts(pixel)
        run = np.repeat(np.arange(len(start)), np.diff(np.append(start, len(total))))
        landing = np.zeros((len(asked), len(clusters)), np.float32)
        for view in np.unique(table.view_index).tolist() if len(start) else ():
            score = (total - gain[:, view]) / np.maximum(count - is_inside[:, view], 1)
            best = np.maximum.reduceat(score, start)
            use = np.flatnonzero((score >= best[run] - 1e-6) & (best[run] >= 0) & (table.view_index[region] != view))
            share = 1 / np.bincount(run[use], minlength=len(start))[run[use]]
            pixels = np.bincount(cluster[use], share, len(asked))
            hit = labels[use, view] >= 0
            flat = cluster[use][hit] * len(clusters) + labels[use, view][hit]
            landed = np.bincount(flat, share[hit], len(asked) * len(clusters)).reshape(landing.shape)
            landing += landed / np.maximum(pixels, 1e-9)[:, None]
        return landing

    def _score_own(self, clusters: Ints) -> Floats:
        """(D,) score of each region in its own cluster."""
        table, hidden = self.table, self.config.costs.hidden
        gain, is_inside = self._row_gains(clusters)
        score = gain.sum(1) / np.maximum(is_inside.sum(1), 1)
        best = np.full(len(table.pixel_region), -hidden)
        start = run_starts(table.pixel)
        if len(start):
            best[table.pixel[start]] = np.maximum(np.maximum.reduceat(score, start), -hidden)
        counts = np.bincount(table.pixel_region, minlength=len(clusters))
        return np.bincount(table.pixel_region, best, len(clusters)) / np.maximum(counts, 1)

    def _row_gains(self, clusters: Ints, rows: Ints | slice = slice(None)) -> tuple[Floats, NDArray[np.bool_]]:
        """(I, V) float32, what each view of each row adds to the score of the region in its own cluster; and (I, V)
        bool, whether the point lies in that view. The sum of the gains over the number of these views is the score."""
        table, hidden = self.table, self.config.costs.hidden
        labels, own = table.labels[rows], clusters[table.pixel_region[table.pixel[rows]]]
        empty = self._empty_costs(members_of(clusters, int(clusters.max(initial=-1)) + 1))
        gain = np.full(labels.shape, -hidden, np.float32)
        gain[np.append(clusters, [-1, -1])[labels] == own[:, None]] = 1
        gain = np.where(labels == EMPTY, -empty[own], gain)
        is_inside = labels >= EMPTY
        return gain * is_inside, is_inside
