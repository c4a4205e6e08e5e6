from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from blade_scene import SIZE, ring_cameras
from known_leaves import turn_about
from mvseg.errors import InputError
from mvseg.formats import markers
from mvseg.formats.image_file import write_png
from mvseg.scene import Cameras, Scene, View
from mvseg.traits.up import find_up, up_of_board

SCALE = 4  # of the small photos of the ring
BOARD_PX = 400


def large_ring() -> Cameras:
    cameras = ring_cameras(5)
    K = cameras.K.clone()
    K[:, :2] *= SCALE
    return replace(cameras, K=K, sizes=cameras.sizes * SCALE)


def photograph(folder: Path, cameras: Cameras, board: np.ndarray) -> Scene:
    """A board of 2 x 2 world units on the plane z = 0 about the origin, x to the right and y up on it."""
    views = []
    board_from_px = np.array([[2 / BOARD_PX, 0, -1], [0, -2 / BOARD_PX, 1], [0, 0, 1]])
    half = np.array([[1, 0, -0.5], [0, 1, -0.5], [0, 0, 1]])
    for view in range(len(cameras)):
        plane = np.column_stack([cameras.R[view].numpy()[:, :2], cameras.t[view].numpy()])
        warp = half @ cameras.K[view].numpy() @ plane @ board_from_px @ np.linalg.inv(half)
        photo = cv2.warpPerspective(board, warp, (SIZE * SCALE,) * 2, flags=cv2.INTER_AREA, borderValue=255)
        views.append(View(f"{view:03d}", folder / f"{view:03d}.png"))
        write_png(views[-1].path, np.repeat(np.asarray(photo, np.uint8)[..., None], 3, axis=2))
    return Scene("board", tuple(views), cameras)


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Scene]:
    board = np.full((BOARD_PX, BOARD_PX), 255, np.uint8)
    family = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_1000)
    for number, (row, column) in enumerate(((30, 30), (30, 230), (230, 130))):
        board[row : row + 140, column : column + 140] = cv2.aruco.generateImageMarker(family, 7 + number, 140)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(markers, "FAMILIES", ("5X5_1000",))  # to look for all of them takes seconds
        yield photograph(tmp_path_factory.mktemp("board"), large_ring(), board)


@pytest.fixture(scope="module")
def up(scene: Scene) -> np.ndarray:
    return np.asarray(find_up(scene, "board").up)


def test_markers_that_lie_flat_show_which_way_is_up(up: np.ndarray) -> None:
    assert np.degrees(np.arccos(up[2])) < 0.3


def test_up_turns_with_the_world(scene: Scene, up: np.ndarray) -> None:
    turn = turn_about(np.array([1.0, 2.0, 0.5]), 100)
    turned = replace(scene, cameras=replace(scene.cameras, R=scene.cameras.R @ torch.from_numpy(turn).T))
    assert up_of_board(turned) == pytest.approx(turn @ up, abs=1e-6)


def test_without_markers_there_is_a_sentence(tmp_path: Path) -> None:
    empty = photograph(tmp_path, large_ring(), np.full((BOARD_PX, BOARD_PX), 128, np.uint8))
    with pytest.raises(InputError, match="no ArUco marker is seen in two photos"):
        up_of_board(empty)


def test_cameras_that_do_not_fit_the_photos_find_no_marker(scene: Scene) -> None:
    shifted = replace(scene, cameras=scene.cameras[[1, 2, 3, 4, 0]])
    with pytest.raises(InputError, match=r"no ArUco marker|no one plane"):
        up_of_board(shifted)
