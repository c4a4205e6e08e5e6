"""The numbers of corrections: definitions, technical limits, and thresholds that only sort and propose.

`python -m benchmarks.corrections` measures what the page's questions and the user's own edits gain with them.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class EditNumbers:
    """Limits of a file of corrections, masks that an edit is about, and rough outlines."""

    most_bytes: int = 64 * 2**20  # limit: max. size of the file
    most_edits: int = 10_000  # limit: max. edits of a file, and photos that it names
    most_points: int = 10_000  # limit: max. points of an outline or a line, and places of a link of dates
    most_places: int = 100  # limit: max. places of a link: each is held against each other
    covered: float = 0.5  # definition: share of a mask above which an outline that covers it replaces it
    most_covered: int = 3  # chosen: masks that an outline replaces silently: two stems make three pieces
    as_near: float = 1.1  # chosen: max. distance of the outline of one surface that fits as well as two, in theirs
    segmented_px: int = 480  # limit: longer side of the part of a photo in which a rough outline is refined
    around: float = 0.35  # chosen: margin around the rough outline that is part of it, as a share of its size
    least_margin_px: float = 4.0  # chosen: the same in pixels of the photo, at least
    rounds: int = 5  # limit: rounds of GrabCut
    least_leaf: float = 0.05  # chosen: min. size of the leaf, as a share of the rough outline's pixels
    tolerance_px: float = 1.0  # chosen: max. distance of an outline from the edge that it follows


@dataclass(frozen=True)
class QuestionNumbers:
    """Questions to the user, also about leaf-coloured places without a mask. Doubts only sort questions."""

    least: float = 0.3  # chosen: doubt from which a question is asked
    most: int = 200  # limit: max. questions of a page: it asks a few itself, and the others where the user clicks
    digits: int = 6  # limit: decimals of the change by an answer; later ones make a tie
    as_good: float = 0.1  # chosen: match score below the best from which masks are as good; the largest is shown
    open: float = 0.5  # chosen: unhidden share of a surface that should have a mask; see `EVIDENCE.open_pixels`
    empty: float = 0.6  # chosen: share of that part outside of all masks from which the mask is missing
    similar: float = 0.4  # chosen: IoU of that part with another leaf's mask that may be the missing one
    least_chance: float = 0.1  # chosen: P from which a candidate that was not chosen is asked about
    least_halves: int = 3  # chosen: photos from which that is asked: one mask may as well touch another leaf
    most_places: int = 12  # limit: max. places that one question shows
    opening: int = 5  # chosen: min. width of a place, pixels of the picture: stems are thinner, and seams beside masks
    compact: float = 0.25  # chosen: min. square of its largest width, as a share of its area: stems have less
    beside: int = 3  # chosen: max. distance between a mask and what it leaves out of its leaf, in these pixels
    most_share: float = 0.2  # chosen: size of a place, relative to the photo; of larger ones the widest place
    widest: float = 1.5  # chosen: reach of that place from its middle, in radii of the largest circle in it


EDITS = EditNumbers()
QUESTIONS = QuestionNumbers()
