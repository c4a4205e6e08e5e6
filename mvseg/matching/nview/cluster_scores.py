"""How well clusters of regions explain what all views show.

A cluster explains a pixel of a region when some point of the pixel's ray shows members of the cluster in the other
views: the hypotheses of `plane_sweep.py`, so that neither a volume nor a surface is needed. A region's own view never
counts.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from mvseg.matching.nview.config import NViewConfig
from mvseg.matching.nview.plane_sweep import EMPTY, PlaneSweep, blocks_of_runs, run_starts
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
        coverage: (N, K), share of the best hypotheses of c that show n.
        total: (N, K), the gain: score, weighted coverage and epipolar evidence.
    """

    clusters: Ints
    score: Floats
    coverage: Floats
    total: Floats


@dataclass(frozen=True, eq=False)
class ClusterScores:
    """Scores of any clusters of the D regions of one sweep.

    Results depend only on the members of a cluster and are cached by members: while the search moves some regions,
    unchanged clusters cost nothing.

    Attributes:
        sweep: hypotheses of D regions, ordered by view.
        graph: their epipolar weights.
        config: costs, gains and thresholds for this number of views.
    """

    sweep: PlaneSweep
    graph: ViewGraph
    config: NViewConfig
    _scores: dict[tuple[int, bytes], Floats] = field(default_factory=dict, init=False, repr=False)
    _coverages: dict[bytes, Floats] = field(default_factory=dict, init=False, repr=False)
    _own: dict[bytes, Floats] = field(default_factory=dict, init=False, repr=False)

    def with_graph(self, graph: ViewGraph) -> ClusterScores:
        """The same scores, with all that is cached, for a graph of other links."""
        scores = replace(self, graph=graph)
        for name in ("_scores", "_coverages", "_own"):
            getattr(scores, name).update(getattr(self, name))
        return scores

    @cached_property
    def evidence(self) -> Floats:
        """(D, D) evidence for (> 0) or against (< 0) a pair of regions being one instance, from its epipolar weight."""
        return (np.interp(self.graph.weights, WEIGHTS, LOG_ODDS) + PRIOR) / SPAN

    def scores(self, view: int, clusters: Ints) -> Floats:
        """Leave-one-out scores of the regions of one view in clusters, S(n, c).

        A hypothesis scores (views that show c - hidden * views that show others - missing or absent * views that show
        nothing) / (views that the point lies in); a pixel takes the score of its best hypothesis, but at least -hidden;
        a region takes the mean of its pixels, or -hidden without pixels.

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
        regions = self.sweep.bounds.regions(view)
        return np.stack([self._scores[key] for key in keys], 1) if keys else np.zeros((regions.stop - regions.start, 0))

    def pixel_scores(self, view: int, clusters: Ints) -> Floats:
        """(P, K) float32: the scores of the view's P sampled pixels, see `scores`."""
        return self._score_pixels(view, self._members_elsewhere(view, clusters))

    def coverages(self, clusters: Ints) -> Floats:
        """Where clusters expect to be seen in each view, R(c, n).

        Args:
            clusters: (D,) cluster of each region in [0, K).

        Returns:
            (K, D) float32 in [0, 1]: of the pixels of c in other views than n's, the share whose best hypothesis shows
            n. The best hypothesis is chosen without n's view; pixels whose best hypothesis scores below 0 do not count,
            and hypotheses that tie share the pixel.
        """
        keys = [members.tobytes() for members in members_of(clusters, int(clusters.max(initial=-1)) + 1)]
        new = np.array([k for k, key in enumerate(keys) if key not in self._coverages], np.int64)
        if len(new):
            fresh = self._cover(clusters, new)
            self._coverages.update({keys[k]: fresh[n] for n, k in enumerate(new.tolist())})
        return np.stack([self._coverages[key] for key in keys]) if keys else np.zeros((0, len(clusters)), np.float32)

    def covered_clusters(self) -> list[Ints]:
        """The members of every cluster whose coverages were asked for: all that a search has seen."""
        return [np.frombuffer(key, np.int64) for key in self._coverages]

    def own(self, clusters: Ints) -> Floats:
        """(D,) score of each region in its own cluster, its own view left out; `clusters` (D,) in [0, K)."""
        members = members_of(clusters, int(clusters.max(initial=-1)) + 1)
        keys = [cluster.tobytes() for cluster in members]
        new = np.array([k for k, key in enumerate(keys) if key not in self._own], np.int64)
        if len(new):
            fresh = self._score_own(clusters, new)
            self._own.update({keys[k]: fresh[members[k]] for k in new.tolist()})
        own = np.zeros(len(clusters))
        for key, cluster in zip(keys, members, strict=True):
            own[cluster] = self._own[key]
        return own

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
        views, scores = self.sweep.view_index[is_together], self.own(clusters)[is_together]
        counts, total = (np.bincount(views, weights, self.sweep.num_views) for weights in (None, scores))
        return np.where(counts > 0, total / np.maximum(counts, 1), np.nan)

    def gains(self, view: int, clusters: Ints, coverages: Floats) -> ViewGains:
        """What the regions of one view would gain by joining the clusters of the other views.

        Args:
            view: the view.
            clusters: (D,) cluster of each region in [0, K), -1 for regions to leave out.
            coverages: `coverages` of an earlier partition; newer clusters, which it does not have, cover nothing.
        """
        here = self.sweep.bounds.regions(view)
        is_other = (self.sweep.view_index != view) & (clusters >= 0)
        numbers, inverse = np.unique(clusters[is_other], return_inverse=True)
        compact = np.full(len(clusters), -1)
        compact[is_other] = inverse
        score = self.scores(view, compact)
        coverage = np.zeros_like(score)
        has_coverage = numbers < len(coverages)
        coverage[:, has_coverage] = coverages[numbers[has_coverage], here].T
        members = np.zeros((len(clusters), len(numbers) + 1))
        members[np.arange(len(clusters)), compact] = 1  # the last column collects the view itself
        pairs = self.pair_factor * (self.evidence[here] @ members[:, :-1])
        return ViewGains(numbers, score, coverage, score + self.config.gains.coverage * coverage + pairs)

    @property
    def pair_factor(self) -> float:
        """Gain per unit of epipolar evidence for a pair, in this number of views."""
        return self.config.gains.pair_factor(self.sweep.num_views)

    def together(self, clusters: Ints) -> NDArray[np.bool_]:
        """(D, D) whether two regions of different views are in one cluster."""
        views = self.sweep.view_index
        return (clusters[:, None] == clusters) & (views[:, None] != views)

    def _members_elsewhere(self, view: int, clusters: Ints) -> list[Ints]:
        """The members of clusters 0 .. K - 1 in other views."""
        elsewhere = np.where(self.sweep.view_index == view, -1, clusters)
        return members_of(elsewhere, int(clusters.max(initial=-1)) + 1)

    def _score_clusters(self, view: int, members: list[Ints]) -> Floats:
        """(N, C) float32: the scores of the view's regions in C clusters."""
        best = self._score_pixels(view, members)
        regions, pixels = self.sweep.bounds.regions(view), self.sweep.bounds.pixels(view)
        owner = self.sweep.pixel_region[pixels] - regions.start
        start = run_starts(owner)
        score = np.full((regions.stop - regions.start, len(members)), -self.config.costs.hidden, np.float32)
        if len(start):
            counts = np.diff(np.append(start, len(best)))[:, None].astype(np.float32)
            score[owner[start]] = np.add.reduceat(best, start, 0) / counts
        return score

    def _score_pixels(self, view: int, members: list[Ints]) -> Floats:
        """(P, C) float32: the scores of the view's pixels in C clusters without members in this view."""
        sweep, hidden, num_clusters = self.sweep, self.config.costs.hidden, len(members)
        pixels, hypotheses = sweep.bounds.pixels(view), sweep.bounds.hypotheses(view)
        best = np.full((pixels.stop - pixels.start, num_clusters), -hidden, np.float32)
        start = run_starts(sweep.pixel[hypotheses])
        if not len(start):
            return best
        score = sweep.hypotheses_of_regions(view).count(members)  # hypotheses vary fastest: the maximum runs over them
        labels = sweep.labels[hypotheses]
        is_empty = (labels == EMPTY).T
        num_inside = (labels >= EMPTY).sum(1, dtype=np.float32)
        shares = np.empty((len(is_empty) + 1, len(labels)), np.float32)  # of the views inside: each empty one, labelled
        np.divide(is_empty, num_inside, out=shares[:-1])
        shares[-1] = 1 - is_empty.sum(0) / num_inside
        costs = np.pad(self._empty_costs(members), ((0, 0), (0, 1)), constant_values=hidden)
        score *= np.float32(1 + hidden) / num_inside
        score -= costs @ shares
        pixel = sweep.pixel[hypotheses][start] - pixels.start
        best[pixel] = np.maximum(np.maximum.reduceat(score, start, 1), np.float32(-hidden)).T
        return best

    def _empty_costs(self, members: list[Ints]) -> Floats:
        """(C, V) float32: what a view without a region costs each cluster."""
        has_mask = np.zeros((len(members), self.sweep.num_views), bool)
        for number, regions in enumerate(members):
            has_mask[number, self.sweep.view_index[regions]] = True
        return np.where(has_mask, self.config.costs.missing, self.config.costs.absent).astype(np.float32)

    def _cover(self, clusters: Ints, asked: Ints) -> Floats:
        """(C, D) float32: the coverages of the C clusters in `asked`."""
        num_regions, num_views = len(clusters), self.sweep.num_views
        index_of = np.full(int(clusters.max(initial=-1)) + 1, -1)
        index_of[asked] = np.arange(len(asked))
        num_pixels = np.zeros((len(asked), num_views))
        covered = np.zeros((len(asked), num_regions))
        for block in self._hypothesis_gains(clusters, asked):
            hypothesis, view, share = block.best_elsewhere(self.sweep.view_index[block.region])
            cluster, label = index_of[clusters[block.region[hypothesis]]], block.labels[hypothesis, view]
            num_pixels += np.bincount(cluster * num_views + view, share, num_pixels.size).reshape(num_pixels.shape)
            hit = label >= 0
            covered += np.bincount(cluster[hit] * num_regions + label[hit], share[hit], covered.size).reshape(
                covered.shape
            )
        return (covered / np.maximum(num_pixels, 1e-9)[:, self.sweep.view_index]).astype(np.float32)

    def _score_own(self, clusters: Ints, asked: Ints) -> Floats:
        """(D,) score of each region in its own cluster, for those in the clusters `asked`."""
        sweep, hidden = self.sweep, self.config.costs.hidden
        best = np.full(len(sweep.pixel_region), -hidden)
        for block in self._hypothesis_gains(clusters, asked):
            score = block.gain.sum(1) / np.maximum(block.is_inside.sum(1), 1)
            best[block.pixel[block.start]] = np.maximum(np.maximum.reduceat(score, block.start), -hidden)
        counts = np.bincount(sweep.pixel_region, minlength=len(clusters))
        return np.bincount(sweep.pixel_region, best, len(clusters)) / np.maximum(counts, 1)

    def _hypothesis_gains(self, clusters: Ints, asked: Ints) -> Iterator[_HypothesisGains]:
        """What each view adds to the score of the regions of the clusters `asked` in their own cluster, hypothesis by
        hypothesis."""
        sweep, hidden = self.sweep, np.float32(self.config.costs.hidden)
        is_asked = np.zeros(int(clusters.max(initial=-1)) + 1, bool)
        is_asked[asked] = True
        hypotheses = np.flatnonzero(is_asked[clusters][sweep.pixel_region][sweep.pixel])
        cluster_of = np.append(clusters, [-1, -1]).astype(np.int32)  # the last two for EMPTY and OUTSIDE
        empty = self._empty_costs(members_of(clusters, len(is_asked)))
        for block in blocks_of_runs(run_starts(sweep.pixel[hypotheses]), len(hypotheses)):
            pixel, labels = sweep.pixel[hypotheses[block]], sweep.labels.take(hypotheses[block], 0)
            region = sweep.pixel_region[pixel]
            own = cluster_of[region]
            gain = np.where(cluster_of.take(labels) == own[:, None], np.float32(1), -hidden)
            np.copyto(gain, -empty[own], where=labels == EMPTY)
            is_inside = labels >= EMPTY
            np.copyto(gain, 0, where=~is_inside)
            yield _HypothesisGains(
                labels=labels, pixel=pixel, region=region, start=run_starts(pixel), gain=gain, is_inside=is_inside
            )


@dataclass(frozen=True, eq=False)
class _HypothesisGains:
    """R whole runs of hypotheses, with what each view adds to the score of the region in its own cluster.

    Attributes:
        labels: (R, V), the hypotheses.
        pixel: (R,) int64, the pixel of each.
        region: (R,) int64, the region of that.
        start: where the hypotheses of a pixel start.
        gain: (R, V) float32; the sum of the gains over the number of views that the point lies in is the score.
        is_inside: (R, V) bool, whether the point lies in that view.
    """

    labels: NDArray[np.integer]
    pixel: Ints
    region: Ints
    start: Ints
    gain: Floats
    is_inside: NDArray[np.bool_]

    def best_elsewhere(self, own_view: Ints) -> tuple[Ints, Ints, Floats]:
        """The best hypotheses of each pixel when one view does not count.

        Args:
            own_view: (R,) int64, the view of each hypothesis's pixel, for which there is no answer.

        Returns:
            Three arrays with one entry per best hypothesis: the hypothesis, the view left out, and the hypothesis's
            share of the pixel: hypotheses that tie within 1e-6 share it. A pixel whose best hypothesis scores below 0
            has none.
        """
        total, count = self.gain.sum(1), self.is_inside.sum(1, dtype=np.float32)
        score = total[:, None] - self.gain
        score /= np.maximum(count[:, None] - self.is_inside, np.float32(1))
        best = np.maximum.reduceat(score, self.start, 0)
        lengths = np.diff(np.append(self.start, len(score)))
        least = np.where(best >= 0, best - np.float32(1e-6), np.float32(np.inf))
        is_best = score >= np.repeat(least, lengths, 0)
        is_best[np.arange(len(score)), own_view] = False
        hypothesis, view = is_best.nonzero()
        run = np.repeat(np.arange(len(lengths)), lengths)[hypothesis]
        tie = run * score.shape[1] + view
        return hypothesis, view, 1 / np.bincount(tie)[tie]
