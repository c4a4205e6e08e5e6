"""Photos of the corner of a room, whose floor and walls are textured: exact, by warping three planes.

The floor is z = 0, the walls are x = 0 and y = 0, each 400 mm long; the cameras look into the corner. On the floor lies
a ChArUco board of 5 x 4 squares of 40 mm with its lower left corner at (100, 100).
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import torch

from mvseg.formats.board import BoardConfig
from mvseg.formats.image_file import write_png
from mvseg.scene import Cameras

SIDE, PX_PER_MM = 400.0, 2
BOARD = BoardConfig(columns=5, rows=4, square=40.0, marker=30.0, family="5X5_1000")
BOARD_AT = np.array([100.0, 100.0, 0.0])
WIDTH, HEIGHT, FOCAL = 480, 360, 507.0


def room_cameras(num_views: int = 7, *, width: int = WIDTH, height: int = HEIGHT, focal: float = FOCAL) -> Cameras:
    """Cameras on an arc, at changing heights, about 650 mm away, with z up."""
    R, t = [], []
    for view in range(num_views):
        azimuth = np.radians(25 + 40 * view / (num_views - 1))
        elevation = np.radians((30, 40, 35)[view % 3])
        away = np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
        target = np.array([150.0, 150.0, 60.0])
        right = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
        rotation = np.stack([right, np.cross(-away, right), -away])
        R.append(rotation)
        t.append(-rotation @ (target + (600 + 25 * (view % 4)) * away))
    K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    return Cameras(
        K=torch.from_numpy(np.repeat(K[None], num_views, 0)),
        R=torch.from_numpy(np.stack(R)),
        t=torch.from_numpy(np.stack(t)),
        sizes=torch.tensor([[width, height]] * num_views),
    )


def texture(seed: int, grains: tuple[int, ...] = (20, 40, 100)) -> np.ndarray:
    """(H, W, 3) uint8: noise of several grain sizes, pixels."""
    rng, size = np.random.default_rng(seed), round(SIDE * PX_PER_MM)
    total = np.zeros((size, size, 3))
    for grain in grains:
        noise = rng.normal(size=(size // grain + 1, size // grain + 1, 3))
        total += cv2.resize(noise, (size, size), interpolation=cv2.INTER_CUBIC)
    return np.clip(128 + 40 * total, 0, 255).astype(np.uint8)


def board_picture(board: BoardConfig, px_per_mm: int = PX_PER_MM) -> np.ndarray:
    """(H, W) uint8, without a margin."""
    size = (round(board.columns * board.square * px_per_mm), round(board.rows * board.square * px_per_mm))
    return board.opencv().generateImage(size, marginSize=0, borderBits=1)


def floor_picture(*, with_board: bool = True) -> np.ndarray:
    picture = texture(0)
    if with_board:
        board = board_picture(BOARD)
        x, y = (round(each * PX_PER_MM) for each in BOARD_AT[:2])
        top = len(picture) - y - board.shape[0]
        picture[top - 16 : top + board.shape[0] + 16, x - 16 : x + board.shape[1] + 16] = 255
        picture[top : top + board.shape[0], x : x + board.shape[1]] = board[..., None]
    return picture


def plane_points(axes: tuple[int, int]) -> np.ndarray:
    """(3, 3): world point = matrix @ (column, row, 1) of a picture whose rows run down the second axis."""
    matrix = np.zeros((3, 3))
    matrix[axes[0], 0] = 1 / PX_PER_MM
    matrix[axes[1], 1], matrix[axes[1], 2] = -1 / PX_PER_MM, SIDE
    return matrix


def warp_plane(
    photo: np.ndarray, picture: np.ndarray, px_from_world: np.ndarray, world_from_picture: np.ndarray
) -> None:
    """Draw a plane into a photo. Positions count from the corner of the top-left pixel."""
    homography = px_from_world[:, :3] @ world_from_picture
    homography[:, 2] += px_from_world[:, 3]
    half = np.array([[1, 0, -0.5], [0, 1, -0.5], [0, 0, 1]])  # OpenCV's pixel centres are whole numbers
    warp = half @ homography @ np.linalg.inv(half)
    size = (3 * photo.shape[1], 3 * photo.shape[0])  # drawn larger and shrunk: without steps at edges
    larger = half @ np.diag([3.0, 3.0, 1.0]) @ np.linalg.inv(half) @ warp
    drawn = cv2.warpPerspective(picture, larger, size, flags=cv2.INTER_LINEAR)
    shown = cv2.warpPerspective(np.full(picture.shape[:2], 255, np.uint8), larger, size)
    drawn, shown = (cv2.resize(each, photo.shape[1::-1], interpolation=cv2.INTER_AREA) for each in (drawn, shown))
    photo[shown > 127] = drawn[shown > 127]


def as_coded(light: np.ndarray) -> np.ndarray:
    """The values of a photo that took this light in [0, 1] (sRGB)."""
    coded = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    return np.asarray(np.rint(255 * coded), np.uint8)


def draw_room(cameras: Cameras, *, with_board: bool = True) -> list[np.ndarray]:
    """V photos (H, W, 3) uint8."""
    pictures = [(texture(1), (0, 2)), (texture(2), (1, 2)), (floor_picture(with_board=with_board), (0, 1))]
    photos = []
    for view in range(len(cameras)):
        width, height = cameras.sizes[view].tolist()
        photo = np.full((height, width, 3), 30, np.uint8)
        pose = torch.cat([cameras.R[view], cameras.t[view][:, None]], 1)
        for picture, axes in pictures:
            warp_plane(photo, picture, (cameras.K[view] @ pose).numpy(), plane_points(axes))
        photos.append(as_coded(photo / 255))
    return photos


def write_room(folder: Path, cameras: Cameras | None = None, *, with_board: bool = True) -> Path:
    """A folder of photos 0.png, 1.png, ..."""
    folder.mkdir(parents=True, exist_ok=True)
    for view, photo in enumerate(draw_room(cameras or room_cameras(), with_board=with_board)):
        write_png(folder / f"{view}.png", photo)
    return folder
