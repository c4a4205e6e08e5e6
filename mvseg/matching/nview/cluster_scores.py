"""How well clusters of regions explain what all views show.

A cluster explains a pixel of a region when some point of the pixel's ray shows members of the cluster in the other
views (hypotheses of `plane_sweep.py`): neither a volume nor a surface is needed. A region's own view never counts.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from functools import cached_property
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from mvseg.arrays import Ints, Reals
from mvseg.matching.numbers import COSTS, GAINS, SEARCH
from mvseg.matching.nview.plane_sweep import EMPTY, OUTSIDE, PlaneSweep, blocks_of_runs, pack_views, run_starts
from mvseg.matching.partition import Clusters, members_of
from mvseg.matching.view_graph import ViewGraph

# fitted: python -m benchmarks.pair_odds --cache DIR: log odds that two regions show one instance, by epipolar weight.
# What it counts today is within 0.5 of these.
WEIGHTS = (0.0, 0.01, 0.05, 0.1, 0.25, 0.45, 0.65, 0.75, 0.85, 0.95, 1.0)
# fitted: the same
LOG_ODDS = (-9.0, -7.0, -6.0, -5.5, -4.2, -3.3, -2.6, -2.1, -1.0, 0.5, 1.2)

Key = TypeVar("Key")


@dataclass(frozen=True, eq=False)
class ViewGains:
    """Gains of the N regions of one view from joining the K clusters that the other views form.

    Attributes:
        clusters: (K,) int64, their numbers.
        score: (N, K), S(n, c): see `ClusterScores.scores`.
        coverage: (N, K), share of the best hypotheses of c that show n.
        total: (N, K), the gain: score, weighted coverage and epipolar evidence.
    """

    clusters: Ints
    score: Reals
    coverage: Reals
    total: Reals


@dataclass(frozen=True, eq=False)
class ClusterScores:
    """Scores of any clusters of the D regions of one sweep, which are ordered by view.

    Results depend only on the members of a cluster and are cached by members: while the search moves some regions,
    unchanged clusters cost nothing. `replace` with a graph of other links keeps what is cached.
    """

    sweep: PlaneSweep
    graph: ViewGraph
    _scores: dict[tuple[int, bytes], Reals] = field(default_factory=dict, repr=False)
    _coverages: dict[bytes, Reals] = field(default_factory=dict, repr=False)
    _own: dict[bytes, Reals] = field(default_factory=dict, repr=False)

    @cached_property
    def evidence(self) -> Reals:
        """(D, D) float32 epipolar evidence for (> 0) or against (< 0) a pair of regions being one instance."""
        return (np.interp(self.graph.weights, WEIGHTS, LOG_ODDS) + GAINS.prior).astype(np.float32)

    def scores(self, view: int, numbers: Ints) -> Reals:
        """Leave-one-out scores of the regions of one view in clusters, S(n, c).

        A hypothesis scores (views that show c - hidden * views that show others - missing or absent * views that show
        nothing) / (views that the point lies in); a pixel takes the score of its best hypothesis, but at least -hidden;
        a region takes the mean of its pixels, or -hidden without pixels.

        `numbers` (D,) are clusters in [0, K), -1 for regions to leave out; regions of the view itself do not count.
        Returns (N, K) float32 in [-hidden, 1].
        """
        return self._region_scores(view, self._members_elsewhere(view, numbers))

    def coverages(self, clusters: Clusters) -> Reals:
        """(K, D) float32: share of the pixels of cluster c in other views than n's whose best hypothesis shows n.

        The best hypothesis is chosen without n's view; pixels whose best hypothesis scores below 0 do not count, and
        hypotheses that tie share the pixel.
        """
        keys = [members.tobytes() for members in clusters.members]
        found = _look_up(self._coverages, keys, lambda new: self._cover(clusters, np.array(new)))
        return np.stack(found) if found else np.zeros((0, len(clusters.ids)), np.float32)

    def own(self, clusters: Clusters) -> Reals:
        """(D,) score of each region in its own cluster, its own view left out."""
        members = clusters.members

        def score(new: list[int]) -> list[Reals]:
            fresh = self._score_own(clusters, np.array(new))
            return [fresh[members[k]] for k in new]

        own, found = np.zeros(len(clusters.ids)), _look_up(self._own, [each.tobytes() for each in members], score)
        for cluster, of_cluster in zip(members, found, strict=True):
            own[cluster] = of_cluster
        return own

    def value(self, clusters: Clusters) -> float:
        """Value of a partition: the scores of all regions that are not alone, and the epipolar evidence for all
        pairs in one cluster."""
        pairs = float(self.graph.sum_partners(self.evidence, clusters).sum()) / 2
        factor = GAINS.pair_factor(self.sweep.num_views)
        return float(self.own(clusters)[~clusters.is_alone].sum()) + factor * pairs

    def explained(self, clusters: Clusters) -> float:
        """Mean score of the regions that are not alone in their cluster; 0 without any."""
        is_together = ~clusters.is_alone
        return float(self.own(clusters)[is_together].mean()) if is_together.any() else 0.0

    def explained_per_view(self, clusters: Clusters) -> Reals:
        """(V,) float64: `explained` of the regions of each view; NaN without any."""
        is_together = ~clusters.is_alone
        views, scores = self.sweep.view_index[is_together], self.own(clusters)[is_together]
        counts, total = (np.bincount(views, weights, self.sweep.num_views) for weights in (None, scores))
        return np.where(counts > 0, total / np.maximum(counts, 1), np.nan)

    def gains(self, view: int, numbers: Ints, coverages: Reals) -> ViewGains:
        """Gains of the regions of one view from joining the clusters of the other views. `numbers` (D,) are clusters in
        [0, K), -1 for regions to leave out; `coverages` may be older: newer clusters cover nothing."""
        here, members = self.sweep.regions_of[view], self._members_elsewhere(view, numbers)
        sizes = np.array([len(each) for each in members], np.int64)
        clusters = np.flatnonzero(sizes)
        score = self._region_scores(view, [members[number] for number in clusters])
        coverage = np.zeros_like(score)
        has_coverage = clusters < len(coverages)
        coverage[:, has_coverage] = coverages[clusters[has_coverage], here].T
        evidence = self.evidence[here].take(np.concatenate([*members, clusters[:0]]), 1)
        pairs = np.add.reduceat(evidence, (sizes.cumsum() - sizes)[clusters], 1)
        total = score + GAINS.coverage * coverage + GAINS.pair_factor(self.sweep.num_views) * pairs
        return ViewGains(clusters, score, coverage, total)

    def _members_elsewhere(self, view: int, numbers: Ints) -> list[Ints]:
        elsewhere = np.where(self.sweep.view_index == view, -1, numbers)
        return members_of(elsewhere, int(numbers.max(initial=-1)) + 1)

    def _region_scores(self, view: int, members: list[Ints]) -> Reals:
        keys, here = [(view, each.tobytes()) for each in members], self.sweep.regions_of[view]
        found = _look_up(self._scores, keys, lambda new: self._score_clusters(view, [members[k] for k in new]))
        return np.stack(found, 1) if found else np.zeros((here.stop - here.start, 0), np.float32)

    def _score_clusters(self, view: int, members: list[Ints]) -> Reals:
        regions, pixels = self.sweep.regions_of[view], self.sweep.pixels_of[view]
        owner = self.sweep.pixel_region[pixels] - regions.start
        start = run_starts(owner)
        score = np.full((len(members), regions.stop - regions.start), -COSTS.hidden, np.float32)
        if len(start):
            counts = np.diff(start, append=len(owner)).astype(np.float32)
            score[:, owner[start]] = np.add.reduceat(self._score_pixels(view, members), start, 1) / counts
        return score

    def _score_pixels(self, view: int, members: list[Ints]) -> Reals:
        """(C, P) float32: the scores of the view's pixels in C clusters without members in this view."""
        pixels, here = self.sweep.pixels_of[view], self.sweep.hypotheses_of[view]
        least = np.float32(-COSTS.hidden)
        best = np.full((len(members), pixels.stop - pixels.start), least)
        cluster, hypothesis, count = self.sweep.hypotheses_of_regions[view].count(members)
        hypothesis += here.start
        score = self._score_hypotheses(hypothesis, count, views=pack_views(self._has_region(members)).take(cluster, 1))
        place = cluster * best.shape[1] + (self.sweep.pixel.take(hypothesis) - pixels.start)
        start = run_starts(place)
        best.ravel()[place[start]] = np.maximum(np.maximum.reduceat(score, start), least)
        return best

    def _score_hypotheses(self, hypotheses: Ints, count: Ints, *, views: NDArray[np.uint64]) -> Reals:
        """(R,) float32, from `count` (R,) views with members; `views` (W, R): bits of the cluster's views."""
        empty_views = self.sweep.empty_views
        missing = np.zeros(len(hypotheses), np.float32)
        for empty, shown in zip(empty_views, views, strict=True):
            missing += np.bitwise_count(empty.take(hypotheses) & shown)
        score = np.float32(1 + COSTS.hidden) * count.astype(np.float32)
        score -= np.float32(COSTS.missing - COSTS.absent) * missing
        score /= self.sweep.num_inside.take(hypotheses)
        score -= self._costs_without_members.take(hypotheses)
        return score

    @cached_property
    def _costs_without_members(self) -> Reals:
        """(I,) float32: what each hypothesis costs a cluster that none of its views shows."""
        share = np.bitwise_count(self.sweep.empty_views).sum(0, dtype=np.float32) / self.sweep.num_inside
        return np.float32(COSTS.hidden) + np.float32(COSTS.absent - COSTS.hidden) * share

    def _has_region(self, members: list[Ints]) -> NDArray[np.bool_]:
        has_region = np.zeros((len(members), self.sweep.num_views), bool)
        for number, regions in enumerate(members):
            has_region[number, self.sweep.view_index[regions]] = True
        return has_region

    def _cover(self, clusters: Clusters, asked: Ints) -> Reals:
        sweep, num_regions, num_views = self.sweep, len(clusters.ids), self.sweep.num_views
        index_of = np.full(len(clusters), -1)
        index_of[asked] = np.arange(len(asked))
        has_region = self._has_region(clusters.members)
        empty = np.where(has_region, np.float32(-COSTS.missing), np.float32(-COSTS.absent))
        num_pixels, covered = np.zeros((len(asked), num_views)), np.zeros((len(asked), num_regions))
        for hypotheses, score, is_own in self._own_hypotheses(clusters, asked):
            keep = self._may_be_best(hypotheses, score)
            pixel, labels = sweep.pixel[hypotheses[keep]], sweep.labels[hypotheses[keep]]
            region = sweep.pixel_region[pixel]
            gain = np.where(is_own[keep], np.float32(1), np.float32(-COSTS.hidden))
            np.copyto(gain, empty[clusters.ids[region]], where=labels == EMPTY)
            np.copyto(gain, 0, where=labels == OUTSIDE)
            hypothesis, view, share = best_elsewhere(gain, labels != OUTSIDE, pixel, own_view=sweep.view_index[region])
            cluster, label = index_of[clusters.ids[region[hypothesis]]], labels[hypothesis, view]
            num_pixels += np.bincount(cluster * num_views + view, share, num_pixels.size).reshape(num_pixels.shape)
            hit = label >= 0
            first, last = cluster.min(initial=0), cluster.max(initial=0) + 1  # of few clusters at a time
            place = (cluster[hit] - first) * num_regions + label[hit]
            part = covered[first:last]
            part += np.bincount(place, share[hit], part.size).reshape(part.shape)
        return (covered / np.maximum(num_pixels, 1e-9)[:, sweep.view_index]).astype(np.float32)

    def _may_be_best(self, hypotheses: Ints, score: Reals) -> NDArray[np.bool_]:
        """(R,) may it be its pixel's best without one view, which gives 1 or costs `missing` or `absent` at most?"""
        num_inside, pixel = self.sweep.num_inside[hypotheses], self.sweep.pixel[hypotheses]
        total, others = score * num_inside, np.maximum(num_inside - 1, 1)
        most = np.maximum(score, (total + max(COSTS.missing, COSTS.absent)) / others)
        least, start = np.minimum(score, (total - 1) / others), run_starts(pixel)
        best = np.maximum(np.maximum.reduceat(least, start), 0)
        return most + SEARCH.slack >= np.repeat(best, np.diff(start, append=len(pixel)))

    def _score_own(self, clusters: Clusters, asked: Ints) -> Reals:
        sweep, hidden = self.sweep, COSTS.hidden
        best = np.full(len(sweep.pixel_region), -hidden)
        for hypotheses, score, _ in self._own_hypotheses(clusters, asked):
            pixel = sweep.pixel[hypotheses]
            start = run_starts(pixel)
            best[pixel[start]] = np.maximum(np.maximum.reduceat(score, start), -hidden)
        counts = np.bincount(sweep.pixel_region, minlength=len(clusters.ids))
        return np.bincount(sweep.pixel_region, best, len(clusters.ids)) / np.maximum(counts, 1)

    def _own_hypotheses(self, clusters: Clusters, asked: Ints) -> Iterator[tuple[Ints, Reals, NDArray[np.bool_]]]:
        """Blocks of hypotheses (R,) on rays of clusters `asked`, scores in their own cluster, and views (R, V)."""
        sweep = self.sweep
        is_asked = np.zeros(len(clusters), bool)
        is_asked[asked] = True
        every = np.flatnonzero(is_asked[clusters.ids][sweep.pixel_region][sweep.pixel])
        kind = np.int16 if len(is_asked) < 2**15 else np.int32
        cluster_of: Ints = np.append(clusters.ids, [-1, -1]).astype(kind)  # the last two for EMPTY and OUTSIDE
        views = pack_views(self._has_region(clusters.members))
        for block in blocks_of_runs(run_starts(sweep.pixel[every]), len(every)):
            hypotheses = every[block]
            own = cluster_of[sweep.pixel_region[sweep.pixel[hypotheses]]]
            is_own = cluster_of.take(sweep.labels.take(hypotheses, 0)) == own[:, None]
            yield hypotheses, self._score_hypotheses(hypotheses, is_own.sum(1), views=views.take(own, 1)), is_own


def best_elsewhere(
    gain: Reals, is_inside: NDArray[np.bool_], pixel: Ints, *, own_view: Ints
) -> tuple[Ints, Ints, Reals]:
    """The best hypotheses of each pixel when one view does not count.

    Args:
        gain: (R, V) float32, what each view adds to the score of whole runs of hypotheses; their sum over the number of
            views that the point lies in is the score.
        is_inside: (R, V) whether the point lies in that view.
        pixel: (R,) int64, ascending.
        own_view: (R,) int64, the view of the pixel, for which there is no answer.

    Returns:
        Per best hypothesis: the hypothesis, the view left out, and its share of the pixel: hypotheses that tie within
        1e-6 share it. A pixel whose best hypothesis scores below 0 has none.
    """
    start = run_starts(pixel)
    lengths = np.diff(start, append=len(pixel))
    score = gain.sum(1)[:, None] - gain
    score /= np.maximum(is_inside.sum(1, dtype=np.float32)[:, None] - is_inside, np.float32(1))
    best = np.maximum.reduceat(score, start, 0)
    least = np.where(best >= 0, best - np.float32(1e-6), np.float32(np.inf))
    is_best = score >= np.repeat(least, lengths, 0)
    is_best[np.arange(len(score)), own_view] = False
    hypothesis, view = is_best.nonzero()
    tie = np.repeat(np.arange(len(lengths)), lengths)[hypothesis] * score.shape[1] + view
    return hypothesis, view, 1 / np.bincount(tie)[tie]


def _look_up(cache: dict[Key, Reals], keys: list[Key], compute: Callable[[list[int]], Iterable[Reals]]) -> list[Reals]:
    if new := [place for place, key in enumerate(keys) if key not in cache]:
        cache.update(zip((keys[place] for place in new), compute(new), strict=True))
    return [cache[key] for key in keys]
