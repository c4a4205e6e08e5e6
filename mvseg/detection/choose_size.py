"""At which size the detector sees the leaves of a plant best: the views decide.

A detector knows leaves of some sizes in pixels. Which those are on a new plant, its scores do not tell; whether the
views agree does. E, the number of masks that are expected to be right (`Found.expected_right`), orders sizes as the
truth does (docs/notes/detector.md). Not in the paper.
"""

from __future__ import annotations

from collections.abc import Callable

from mvseg.detection.find_leaves import Found
from mvseg.detection.numbers import DETECTION


def choose_size(see: Callable[[int], Found], first: Found) -> Found:
    """Look again and again at a smaller size, as long as more masks are expected to be right.

    Args:
        see: finds leaves at a size: the longer side, pixels, that photos are scaled to.
        first: what was found at the usual size.

    Returns:
        What was found where most masks are expected to be right; of equals, at the larger size.
    """
    best, size = first, float(first.looks[0].longest)
    while (size := size * DETECTION.size_step) >= DETECTION.min_image_size:
        found = see(round(size))
        if found.expected_right <= best.expected_right:
            return best
        best = found
    return best
