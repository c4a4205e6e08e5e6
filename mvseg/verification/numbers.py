"""The numbers of verification: definitions, technical limits, and what was fitted to development plants.

`python -m benchmarks.thirds --cache DIR --room verification` prints what a third less or more of each changes; the
table is in docs/notes/detector.md. Weights of regressions stand beside the features that they weigh (`leaf_scores.py`).
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class EvidenceNumbers:
    """Evidence of surfaces, also of rough ones, for masks."""

    most_px: int = 800  # limit: max. longer side of the photos on which masks are compared
    fits: float = 0.5  # definition: a mask shows a leaf if its IoU with the visible part of the leaf is larger
    open_pixels: int = 100  # chosen: min. unhidden pixels of a surface that a view sees openly
    shared: float = 0.5  # definition: fraction of the smaller of two masks that is in both, where they show one leaf
    rough_views: int = 12  # limit: views of an instance that a rough surface is fitted to, before ids are final
    least_parallax: float = 30.0  # chosen: min. degrees between the directions that most instances are seen from
    least_views: int = 5  # chosen: of fewer, surfaces fit wrong masks as well: two always agree


@dataclass(frozen=True)
class ChoiceNumbers:
    """The choice of leaves and masks among proposals, and among given masks."""

    rounds: int = 2  # limit: in the first nothing hides anything, in the second the leaves of the first do
    same: float = 0.8  # chosen: Jaccard index of the masks of two candidates, by area, above which they are one
    clear: float = 0.6  # chosen: shown share of its expected area from which a candidate is a clear leaf
    # Of 43 scenes, 0.99 changes the ids of three real plants, each by less than 0.016 of ARI, 0.9 those of none.
    given: float = 0.95  # chosen: score of a given mask, as if a detector had found it
    some: float = 0.1  # definition: number of masks that is added before the logarithm, a feature of P
    least_distance: float = 0.01  # limit: distance of shares and scores from 0 and 1, where log odds are infinite
    least_q: float = 0.2  # chosen: q from which a mask may show a leaf
    least_views: int = 2  # definition: min. views in which a leaf has masks; one view alone is no agreement
    least_leaves: int = 3  # chosen: fewer say too little of a plant, to choose a size by or to learn from
    least_expected: float = 0.33  # chosen: min. expected correct masks of a pass, relative to the pass with most
    growth: float = 1.03  # chosen: a smaller size, or taught weights, are better if the agreed area grows by it
    digits: int = 9  # limit: decimals of q and P; what differs less is a tie, on every processor


@dataclass(frozen=True)
class DrawnNumbers:
    """Search for leaves that the user drew, in other views."""

    least_visible: float = 0.3  # chosen: unhidden fraction of a surface that a view sees openly; see `open_pixels`
    least_colored: float = 0.8  # chosen: min. fraction of the unhidden part that has the colour of leaves
    half: float = 0.5  # definition: a mask, or a place without one, that covers less may be half a leaf


@dataclass(frozen=True)
class ColorNumbers:
    """The colour of leaves."""

    bins: int = 16  # limit: bins of each channel in which colours are counted
    blur: float = 1.0  # chosen: standard deviation of the Gaussian that smooths the counts, in bins
    hues: int = 32  # limit: bins of each of two colour channels (a and b of CIELAB) in which candidates are compared
    least_alike: float = 1e-3  # limit: Bhattacharyya's coefficient from which on colours differ entirely
    most_px: int = 600  # limit: max. longer side of the pictures in which places without a mask are looked for
    # On plants that were found whole, 0.15 to 0.39 (stems, soil and pots), where a quarter was found, 0.48 to 0.84.
    unexplained: float = 0.5  # chosen: fraction of leaf-coloured pixels in no mask above which leaves were missed


@dataclass(frozen=True)
class SnapNumbers:
    """Edges of masks that move to where colours change."""

    band: float = 0.05  # chosen: way that an edge may move, in roots of its mask's area
    around: int = 3  # chosen: bands around a mask in which the photo tells what the background looks like
    most_px: int = 100  # limit: root of the area of a mask, larger ones are scaled; with all pixels it is as good
    lacks: float = 0.05  # chosen: fraction of a leaf that its masks lack in most views, from which they are completed
    least_pixels: int = 10  # limit: sure pixels of leaf, or background, at a moved edge; GrabCut needs five


@dataclass(frozen=True)
class HalvesNumbers:
    """Two leaves that are halves of one (docs/notes/detector.md)."""

    overlap: float = 0.08  # chosen: min. share of the smaller mask that both masks show, on average
    touches: float = 0.02  # chosen: max. distance of the two surfaces, in lengths of the first
    fits: float = 0.95  # chosen: min. IoU of one surface for both, relative to that of the worse half
    edge: float = 1.3  # chosen: max. change of colours between the two, relative to that within them


EVIDENCE = EvidenceNumbers()
CHOICE = ChoiceNumbers()
DRAWN = DrawnNumbers()
HALVES = HalvesNumbers()
COLORS = ColorNumbers()
SNAP = SnapNumbers()
