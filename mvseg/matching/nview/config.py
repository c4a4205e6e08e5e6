"""Parameters of the N-view matcher: costs of a hypothesis, gains of a region, thresholds of the search.

They were chosen on simulated development plants, with true and degraded masks (`benchmarks/matching.py --split dev`); a
search for better ones only gained on the plants that it saw (docs/notes/matching.md). A third more or less of any
changes no id of degraded masks of 8 leaves in 10 and 20 views and of 16 in 3 (`benchmarks/thirds.py`). Of 32 leaves in
5 views, it changes the pair F1 by -0.05 (hidden), -0.02 (coverage), -0.01 (weight), and 0.01 at most (all others).
"""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass(frozen=True)
class HypothesisCosts:
    """What a view that does not show the cluster costs in a hypothesis, where one that shows it scores 1.

    Attributes:
        missing: cost of no region there, although the cluster has one in this view.
        absent: cost of no region there when the cluster has none in this view (its mask may be missed).
        hidden: cost of a region of another cluster there, no more than the others; also the most that a pixel can cost.
    """

    missing: float = 0.7
    absent: float = 0.3
    hidden: float = 0.15


@dataclass(frozen=True)
class Gains:
    """What a region gains from a cluster in addition to its score there; one that stays alone gains nothing.

    Attributes:
        coverage: gain of a region that all best hypotheses of the cluster show.
        weight: gain per unit of epipolar evidence for a pair of regions (`ClusterScores.evidence`), over V - 1, and
            1 / (V - 1) more than that: with few views there is little other evidence.
    """

    coverage: float = 0.5
    weight: float = 1 / 3

    def pair_factor(self, num_views: int) -> float:
        """Gain per unit of epipolar evidence for a pair."""
        others = max(num_views - 1, 1)
        return self.weight * (1 + 1 / others) / others


@dataclass(frozen=True)
class Thresholds:
    """When a mask shows a part of an instance, or two of them: segmenters split leaves, and merge them.

    Attributes:
        covered: a cluster may have a second region in a view if it covers at least this share of it.
        as_good: a cluster explains a region or pixel if that scores at least this share of what its own regions do.
        few: a cluster is doubted if at most this share of the views show it.
        few_covered: another one takes a region over from a doubted one if it covers at least this share of it.
        merged_coverage: a cluster may share the region of another one if it covers at least this share of it.
        merged_share: a mask shows two instances if each explains at least this share of its pixels: a definition.
    """

    covered: float = 0.05
    as_good: float = 0.5
    few: float = 0.25
    few_covered: float = 0.02
    merged_coverage: float = 0.25
    merged_share: float = 0.2


@dataclass(frozen=True)
class NViewConfig:
    """All parameters of the N-view matcher."""

    costs: HypothesisCosts = field(default_factory=HypothesisCosts)
    gains: Gains = field(default_factory=Gains)
    thresholds: Thresholds = field(default_factory=Thresholds)
