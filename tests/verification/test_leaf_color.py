"""Colours of leaves: laws of the counting, and photos whose answer is known."""

from __future__ import annotations

import numpy as np

from mvseg.verification.leaf_color import count_colors, has_leaf_color, leaf_colors
from mvseg.verification.numbers import COLORS

GREEN, DARK_GREEN, BROWN, WHITE = (60, 160, 40), (60, 150, 45), (120, 80, 40), (240, 240, 240)


def paint(*colors: tuple[int, int, int], height: int = 4) -> np.ndarray:
    """(height, n, 3) uint8: a column of each colour."""
    return np.tile(np.array(colors, np.uint8)[None], (height, 1, 1))


def test_a_missed_leaf_has_the_colour_of_the_others() -> None:
    photo = paint(GREEN, GREEN, *[BROWN] * 8, *[WHITE] * 8, DARK_GREEN)
    is_inside = np.zeros(photo.shape[:2], bool)
    is_inside[:, :2] = True
    colors = leaf_colors(count_colors(photo, is_inside))
    assert has_leaf_color(photo, colors)[0].tolist() == [True] * 2 + [False] * 16 + [True]


def test_counts_and_colours_are_those_of_pixels_one_by_one() -> None:
    """Slow twin, on photos with each value of a channel."""
    rng = np.random.default_rng(2)
    photo = np.stack([rng.permutation(256) for _ in range(3)], -1).astype(np.uint8).reshape(16, 16, 3)
    is_inside = rng.random((16, 16)) < 0.4
    counts, colors = count_colors(photo, is_inside), rng.random((COLORS.bins,) * 3) < 0.3
    expected = np.zeros_like(counts)
    for row, column in np.ndindex(16, 16):
        place = tuple(photo[row, column] // (256 // COLORS.bins))
        expected[(int(not is_inside[row, column]), *place)] += 1
        assert has_leaf_color(photo, colors)[row, column] == colors[place]
    np.testing.assert_array_equal(counts, expected)


def test_nothing_inside_has_no_colour() -> None:
    photo = paint(GREEN, WHITE)
    assert not leaf_colors(count_colors(photo, np.zeros(photo.shape[:2], bool))).any()
