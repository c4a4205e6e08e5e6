"""Pairs of photos to compare: neighbours in the order in which they were taken, a few further away, and those alike."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Sequence
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from mvseg.poses.config import Pairs
from mvseg.poses.numbers import STRUCTURE

Pair = tuple[int, int]


def choose_pairs(
    names: Sequence[str], pairs: Pairs | None = None, *, alike: NDArray[np.int64] | None = None
) -> list[Pair]:
    """Pairs of photos to compare, as indices i < j, each once, in order; every photo is in one of them.

    "exhaustive" are all pairs. "sequential" is for walks round a plant and turntables: each photo with its next
    neighbours on either side and with some further away, the last photos being neighbours of the first. Photos of
    different folders (one per camera) are neighbours if their places in their sequences are. By default each photo is
    also compared with the others that look most like it, wherever they are in the order: a walk that comes back to
    where it was closes, and photos in no order find each other.

    Args:
        names: paths of the photos, "/" between folders, in the order in which they were taken.
        pairs: None: exhaustive for `STRUCTURE.few` photos; sequential and alike for more.
        alike: (V, V) how alike the photos are, see `count_alike`; without it the order alone counts.
    """
    if pairs == "exhaustive" or (pairs is None and len(names) <= STRUCTURE.few):
        return list(combinations(range(len(names)), 2))
    sequences: dict[str, list[int]] = defaultdict(list)
    for index, name in enumerate(names):
        sequences[name.rpartition("/")[0]].append(index)
    chosen_pairs: set[Pair] = set()
    for one in sequences.values():
        for other in sequences.values():
            for place, index in enumerate(one):
                same = round(place * len(other) / len(one))  # the place of this photo in the other sequence
                near = {other[(same + step) % len(other)] for step in _steps(len(other))}
                chosen_pairs |= {(min(index, each), max(index, each)) for each in near if each != index}
    if pairs is None and alike is not None:
        chosen_pairs |= _most_alike(alike, chosen_pairs)
    return sorted(chosen_pairs)


def pairs_with(some: Iterable[int], num_photos: int) -> list[Pair]:
    """All pairs of these photos with any other, as indices i < j, each once, in order."""
    return sorted({(min(i, j), max(i, j)) for i in some for j in range(num_photos) if i != j})


def _steps(num_photos: int) -> list[int]:
    steps = list(range(STRUCTURE.overlap + 1))
    while steps[-1] * STRUCTURE.far <= num_photos // 2:
        steps.append(steps[-1] * STRUCTURE.far)
    return [sign * step for step in steps for sign in (1, -1)]


def _most_alike(alike: NDArray[np.int64], chosen: set[Pair]) -> set[Pair]:
    rest = alike.copy()
    for i, j in chosen:
        rest[i, j] = rest[j, i] = 0
    most = np.argsort(-rest, axis=1, kind="stable")[:, : STRUCTURE.most_alike].tolist()
    likely = [(i, j) for i, row in enumerate(most) for j in row if rest[i, j] >= STRUCTURE.least_alike and i != j]
    return {(min(pair), max(pair)) for pair in likely}
