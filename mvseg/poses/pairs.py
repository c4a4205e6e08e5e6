"""Which photos are compared with each other."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from itertools import combinations
from typing import Literal

Pairs = Literal["exhaustive", "sequential"]
FEW = 40  # photos up to which all pairs are compared: 780 pairs, a minute or two on two cores
OVERLAP = 10  # neighbours on either side in a sequence
FAR = 2  # neighbours further away are 2 x OVERLAP, 4 x OVERLAP, ... steps off


def choose_pairs(names: Sequence[str], pairs: Pairs | None = None) -> list[tuple[int, int]]:
    """Pairs of photos to compare, as indices i < j, each once, in order.

    "exhaustive" are all pairs. "sequential" is for walks round a plant and turntables: each photo with its OVERLAP
    next neighbours on either side and with some further away, the last photos being neighbours of the first. Photos of
    different folders (one per camera) are neighbours if their places in their sequences are.

    Args:
        names: paths of the photos, "/" between folders, in the order in which they were taken.
        pairs: None: exhaustive for FEW photos, sequential for more.
    """
    if pairs == "exhaustive" or (pairs is None and len(names) <= FEW):
        return list(combinations(range(len(names)), 2))
    sequences: dict[str, list[int]] = defaultdict(list)
    for index, name in enumerate(names):
        sequences[name.rpartition("/")[0]].append(index)
    found: set[tuple[int, int]] = set()
    for one in sequences.values():
        for other in sequences.values():
            for place, index in enumerate(one):
                same = round(place * len(other) / len(one))  # the place of this photo in the other sequence
                near = {other[(same + step) % len(other)] for step in _steps(len(other))}
                found |= {(min(index, each), max(index, each)) for each in near if each != index}
    return sorted(found)


def _steps(num_photos: int) -> list[int]:
    steps = list(range(OVERLAP + 1))
    while steps[-1] * FAR <= num_photos // 2:
        steps.append(steps[-1] * FAR)
    return [sign * step for step in steps for sign in (1, -1)]
