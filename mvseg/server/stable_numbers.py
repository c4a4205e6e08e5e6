"""Numbers of leaves on a page, which stay while the user corrects them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection
from itertools import count


def give_numbers(votes: Counter[tuple[int, int]], leaves: set[int], given: Collection[int]) -> dict[int, int]:
    """Give each leaf the number that has most votes, {(leaf, number): votes}, and the others new ones, in their order:
    larger ones than all that were `given` before. So numbers may have gaps."""
    numbers: dict[int, int] = {}
    for leaf, number in sorted(votes, key=lambda pair: (-votes[pair], pair)):
        if leaf not in numbers and number not in numbers.values():
            numbers[leaf] = number
    new = count(max(given, default=0) + 1)
    return numbers | {leaf: next(new) for leaf in sorted(leaves - numbers.keys())}
