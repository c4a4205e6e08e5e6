from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

from mvseg.errors import InputError
from mvseg.formats.board import BoardConfig, marker_dictionary
from mvseg.formats.markers import find_board, find_markers
from room_scene import BOARD, BOARD_AT, as_coded, draw_room, room_cameras


def grey_room(view: int) -> tuple[np.ndarray, object]:
    cameras = room_cameras(width=720, height=540, focal=760)[[view]]
    return cv2.cvtColor(draw_room(cameras)[0], cv2.COLOR_RGB2GRAY), cameras


@pytest.mark.parametrize("view", [0, 3])
def test_corners_of_a_board_lie_where_the_camera_sees_them(view: int) -> None:
    photo, cameras = grey_room(view)
    numbers, px = find_board(photo, BOARD)
    assert len(numbers) == 12
    true, _ = cameras.project(torch.from_numpy(BOARD.corners()[numbers] + BOARD_AT))
    assert np.abs(px - true[0].numpy()).max() < 0.3
    assert abs(np.mean(px - true[0].numpy())) < 0.05  # no half pixel


def as_phone(light: np.ndarray) -> np.ndarray:
    """Values of a phone with a contrasty curve and sharpening."""
    coded = light ** (1 / 2.2)
    curved = coded**2 * (3 - 2 * coded)
    sharp = curved + 0.5 * (curved - cv2.GaussianBlur(curved, (0, 0), 1.2))
    return np.clip(np.round(255 * sharp), 0, 255).astype(np.uint8)


def as_linear(light: np.ndarray) -> np.ndarray:
    return np.round(255 * light).astype(np.uint8)


@pytest.mark.parametrize(("side", "blur_px"), [(40, 0.5), (40, 0.8), (80, 1.2)])
@pytest.mark.parametrize(
    ("brightest", "develop"), [(1.0, as_coded), (0.1, as_coded), (1.0, as_phone), (1.0, as_linear)]
)
def test_neither_blur_nor_a_tone_curve_changes_the_size_of_a_marker(
    side: int, blur_px: float, brightest: float, develop: Callable[[np.ndarray], np.ndarray]
) -> None:
    """A lens blurs light, not the values of a photo; a camera bends it; the edge is where neither moves it."""
    fine = 8
    size = 2 * side * fine
    page = np.full((size, size), 0.85)
    tag = cv2.aruco.generateImageMarker(marker_dictionary("APRILTAG_36H11"), 7, side * fine) / 255
    turned = cv2.getRotationMatrix2D((side * fine / 2, side * fine / 2), 25, 1)
    turned[:, 2] += side * fine / 2
    page = cv2.warpAffine(0.04 + 0.81 * tag, turned, (size, size), page, flags=cv2.INTER_LINEAR,
                          borderMode=cv2.BORDER_TRANSPARENT)  # fmt: skip
    page = cv2.GaussianBlur(page, (0, 0), blur_px * fine)
    light = page.reshape(2 * side, fine, 2 * side, fine).mean((1, 3))
    quad = find_markers(develop(brightest * light), "APRILTAG_36H11")[7]
    assert np.linalg.norm(quad - np.roll(quad, 1, 0), axis=1) == pytest.approx(side, rel=0.004)


def test_a_marker_that_is_there_twice_and_no_marker_say_nothing() -> None:
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_1000)
    photo = np.full((120, 300), 255, np.uint8)
    for number, left in ((3, 20), (3, 110), (5, 200)):
        photo[20:100, left : left + 80] = cv2.aruco.generateImageMarker(dictionary, number, 80)
    found = find_markers(photo, "4X4_1000")
    assert list(found) == [5]
    np.testing.assert_allclose(found[5], [[200, 20], [280, 20], [280, 100], [200, 100]], atol=0.3)  # edges of pixels
    numbers, px = find_board(np.full((80, 80), 128, np.uint8), BOARD)
    assert (numbers.shape, px.shape) == ((0,), (0, 2))
    assert find_markers(np.full((80, 80), 128, np.uint8), "5X5_1000") == {}


@pytest.mark.parametrize(
    ("changes", "message"),
    [({"columns": 1}, "1 x 4 squares"), ({"marker": 40.0}, "markers have 40, the squares 40"), ({"square": 0}, "0")],
)
def test_boards_that_cannot_be(changes, message: str) -> None:
    with pytest.raises(InputError, match=message):
        replace(BOARD, **changes)
    assert BoardConfig(columns=5, rows=4, square=40.0, marker=30.0) == BOARD
