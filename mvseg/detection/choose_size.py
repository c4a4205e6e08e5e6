"""At which size the detector sees the leaves of a plant best: the views decide. Not in the paper.

A detector knows leaves of some sizes in pixels. Scores do not reveal which sizes work on a new plant; agreement between
views does. The agreed area (`rate_pass`) orders sizes nearly as the truth does (docs/notes/detector.md).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from mvseg.detection.find_leaves import PassResult
from mvseg.detection.numbers import DETECTION
from mvseg.verification.leaf_scores import order_ratings


def choose_size(see: Callable[[int], PassResult], first: PassResult) -> list[PassResult]:
    """Look again and again at a smaller size, as long as the agreed area grows; return one pass, or two, see
    `order_sizes`.

    Where the views do not clearly agree about the best leaves so far (`DETECTION.clear_agreement`), it takes more sizes
    without growth (`DETECTION.patience`): there, agreed areas of neighbouring sizes differ by chance.

    Args:
        see: finds leaves at a size: the longer side, pixels, that photos are scaled to.
        first: the pass at the usual size.
    """
    results, size, num_misses = [first], float(first.detected.longest), 0
    while (size := size * DETECTION.size_step) >= DETECTION.min_image_size:
        best = order_sizes(results)[0]
        results.append(see(round(size)))
        num_misses = 0 if order_sizes(results)[0] is results[-1] else num_misses + 1
        if num_misses > (0 if best.leaves.agreement >= DETECTION.clear_agreement else DETECTION.patience):
            break
    return order_sizes(results)


def choose_near(see: Callable[[int], PassResult], size: int, *, most: int) -> list[PassResult]:
    """Look once at a size, once at a larger and once at a smaller one: with weights that have learned at that size.
    `most`: the longer side of the photos, pixels. Returns as `choose_size`."""
    larger, smaller = min(round(size / DETECTION.size_step), most), round(size * DETECTION.size_step)
    sizes = [size, *(each for each in (larger, smaller) if each > size or DETECTION.min_image_size <= each < size)]
    return order_sizes([see(each) for each in sizes])


def order_sizes(results: Sequence[PassResult]) -> list[PassResult]:
    """The best pass, see `order_ratings`. Then the second best, if its agreed area is at least `DETECTION.as_good`
    times as large: the caller decides between the two by all views."""
    first, *others = [results[index] for index in order_ratings([each.rating for each in results])]
    least = DETECTION.as_good * first.rating.agreed_area
    return [first, *(each for each in others[:1] if first.rating.agreed_area >= each.rating.agreed_area >= least)]
