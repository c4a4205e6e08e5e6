"""At which size the detector sees the leaves of a plant best: the views decide.

A detector knows leaves of some sizes in pixels. Which those are on a new plant, its scores do not tell; whether the
views agree does. The agreed area (`rate_pass`) orders sizes nearly as the truth does (docs/notes/detector.md). Not in
the paper.
"""

from __future__ import annotations

from collections.abc import Callable

from mvseg.detection.find_leaves import Found
from mvseg.detection.numbers import DETECTION


def choose_size(see: Callable[[int], Found], first: Found) -> Found:
    """Look again and again at a smaller size, as long as the agreed area grows.

    Where the views do not clearly agree about the best leaves so far (`DETECTION.clear_agreement`), one size without
    growth ends nothing yet: there, agreed areas of neighbouring sizes differ by chance.

    Args:
        see: finds leaves at a size: the longer side, pixels, that photos are scaled to.
        first: what was found at the usual size.

    Returns:
        What was found where the agreed area is largest; of equals, at the larger size.
    """
    looked, size, num_misses = [first], float(first.looks[0].longest), 0
    while (size := size * DETECTION.size_step) >= DETECTION.min_image_size:
        found, best = see(round(size)), max(looked, key=lambda each: each.agreed_area)
        num_misses = 0 if found.agreed_area > best.agreed_area else num_misses + 1
        looked.append(found)
        if num_misses > (best.leaves.agreement < DETECTION.clear_agreement):
            break
    return max(looked, key=lambda each: each.agreed_area)


def choose_near(see: Callable[[int], Found], size: int, *, most: int) -> Found:
    """Look once at a size, once at a larger and once at a smaller one: with weights that have learned at that size.

    Args:
        see: finds leaves at a size, see `choose_size`.
        size: pixels.
        most: pixels, the longer side of the photos: no size is larger.

    Returns:
        What was found where the agreed area is largest; of equals, at the given size.
    """
    larger, smaller = min(round(size / DETECTION.size_step), most), round(size * DETECTION.size_step)
    sizes = [size, *(each for each in (larger, smaller) if each > size or DETECTION.min_image_size <= each < size)]
    return max(map(see, sizes), key=lambda found: found.agreed_area)
