"""The page of `mvseg target`, photographed by simulation: it lies on a wooden table, light falls off to one side, and
there are lens distortion, blur, noise and JPEG.
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import torch
from scipy.spatial.transform import Rotation
from skimage.draw import polygon2mask

from mvseg.formats.board import marker_dictionary
from mvseg.formats.lens import distort, opencv_lens
from mvseg.formats.rig import write_rig
from mvseg.formats.target import FAMILY, list_shapes, tag_corners
from mvseg.scene import Cameras, Scene, View
from mvseg.simulation.scene_writer import write_jpeg

TABLE = np.array([500, 600])  # mm; the page lies in its middle
WIDTH, HEIGHT = 210.0, 297.0  # of an A4 page, mm
MIDDLE = np.array([WIDTH / 2, HEIGHT / 2])
LARGER = 2  # photos are drawn so many times larger, and shrunk
GAMMA = 2.2
INK = (213, 0, 120)  # sRGB
BLACK = 0.04  # light that black toner reflects, of that of white paper
LINEAR = (BLACK + (1 - BLACK) * (np.arange(256) / 255) ** GAMMA).astype(np.float32)


def draw_page(px_per_mm: int) -> np.ndarray:
    """(H, W, 3) float32 in [0, 1], RGB, linear: the light that the page reflects. Modules of tags are whole pixels
    where `px_per_mm` is a multiple of 4."""
    page = np.full((round(HEIGHT * px_per_mm), round(WIDTH * px_per_mm), 3), 255, np.uint8)
    for shape in list_shapes():
        low, high = (np.round(each * px_per_mm).astype(int) for each in (shape.cell[0], shape.cell[2]))
        corners = (shape.outline * px_per_mm - low)[:, ::-1] - 0.5  # rows first, from the centre of the first pixel
        page[low[1] : high[1], low[0] : high[0]][polygon2mask(tuple((high - low)[::-1]), corners)] = INK
    tags = marker_dictionary(FAMILY)
    for number, corners in tag_corners().items():
        (x1, y1), (x2, y2) = (np.round(corners[each] * px_per_mm).astype(int) for each in (0, 2))
        page[y1:y2, x1:x2] = tags.generateImageMarker(number, x2 - x1, borderBits=1)[..., None]
    return np.asarray(LINEAR[page])


def draw_table(px_per_mm: int, *, seed: int) -> np.ndarray:
    """(H, W, 3) float32 in [0, 1], RGB, linear: light that the page and the wood around it reflect."""
    rng = np.random.default_rng(seed)
    width, height = (TABLE * px_per_mm).tolist()
    grain = np.zeros((height, width), np.float32)
    for length, across in ((90, 6), (25, 2), (4, 1.5)):  # mm
        noise = rng.normal(size=(round(TABLE[1] / length) + 2, round(TABLE[0] / across) + 2)).astype(np.float32)
        grain += cv2.resize(noise, (width, height), interpolation=cv2.INTER_CUBIC)
    wood = np.array([150, 105, 65]) * (1 + 0.12 * grain[..., None])
    table = LINEAR[np.clip(wood, 0, 255).astype(np.uint8)]
    page = draw_page(px_per_mm)
    left, top = np.round((TABLE / 2 - MIDDLE) * px_per_mm).astype(int)
    table[top : top + len(page), left : left + page.shape[1]] = page
    return table


def aim_cameras(num_views: int, *, size: tuple[int, int], focal: float, seed: int) -> Cameras:
    """Hand-held cameras round the page; the world is the table's plane, mm, with z down."""
    rng, R, t = np.random.default_rng(seed), [], []
    for view in range(num_views):
        azimuth = 2 * np.pi * view / num_views + rng.normal(scale=0.1)
        elevation = np.radians((48, 68)[view % 2] + rng.normal(scale=3))
        away = np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), -np.sin(elevation)])
        right = np.cross(-away, [0.0, 0, -1])
        right /= np.linalg.norm(right)
        turned = Rotation.from_euler("z", rng.normal(scale=4), degrees=True).as_matrix()
        rotation = turned @ np.stack([right, np.cross(-away, right), -away])
        target = np.append(MIDDLE + rng.normal(scale=6, size=2), 0)
        R.append(rotation)
        t.append(-rotation @ (target + rng.uniform(430, 500) * away))
    K = np.array([[focal, 0, size[0] / 2 + 3], [0, focal, size[1] / 2 - 5], [0, 0, 1]])
    return Cameras(
        K=torch.from_numpy(np.repeat(K[None], num_views, 0)),
        R=torch.from_numpy(np.stack(R)),
        t=torch.from_numpy(np.stack(t)),
        sizes=torch.tensor([size] * num_views),
    )


def photograph(table: np.ndarray, cameras: Cameras, view: int, *, seed: int, printed: float = 1.0) -> np.ndarray:
    """(H, W, 3) uint8 RGB, without lens distortion: the table under a lamp; lengths of it times `printed`."""
    width, height = cameras.sizes[view].tolist()
    px_per_mm = table.shape[1] / TABLE[0]
    # OpenCV's centre of the first pixel is (0, 0)
    half = np.array([[1, 0, -0.5], [0, 1, -0.5], [0, 0, 1]])
    world_from_table = np.diag([printed / px_per_mm, printed / px_per_mm, 1.0])
    world_from_table[:2, 2] = MIDDLE - printed * TABLE / 2
    pose = cameras.px_from_world[view].numpy()
    warp = half @ np.diag([LARGER, LARGER, 1.0]) @ pose[:, [0, 1, 3]] @ world_from_table @ np.linalg.inv(half)
    large = cv2.warpPerspective(table, warp, (LARGER * width, LARGER * height), borderValue=(0.1, 0.1, 0.1))
    photo = cv2.GaussianBlur(cv2.resize(large, (width, height), interpolation=cv2.INTER_AREA), (0, 0), 0.7)
    rows, columns = np.mgrid[:height, :width].astype(np.float32)
    light = 0.8 - 0.3 * (columns / width) - 0.1 * (rows / height)
    lit = 255 * (photo * light[..., None] * np.array([1.0, 0.93, 0.75], np.float32)) ** (1 / GAMMA)  # a warm lamp
    noise = np.random.default_rng([seed, view]).normal(scale=3, size=photo.shape)
    return np.clip(np.round(lit + noise), 0, 255).astype(np.uint8)


def write_photos(
    folder: Path, cameras: Cameras, *, px_per_mm: int, seed: int, printed: float = 1.0, lens: tuple[float, ...] = ()
) -> Scene:
    """Photos of the page with its true cameras, as a scene folder; JPEG."""
    table, views = draw_table(px_per_mm, seed=seed), []
    (folder / "images").mkdir(parents=True)
    for view in range(len(cameras)):
        (width, height), K = cameras.sizes[view].tolist(), cameras.K[view].numpy()
        of_lens = opencv_lens(K, lens + (0.0, 0.0) if lens else (), width=width, height=height)
        path = folder / "images" / f"{view:02d}.jpg"
        write_jpeg(path, distort(photograph(table, cameras, view, seed=seed, printed=printed), of_lens, K))
        views.append(View(path.stem, path, of_lens))
    scene = Scene(name=folder.name, views=tuple(views), cameras=cameras, unit="mm", up=(0.0, 0.0, -1.0))
    write_rig(folder / "cameras.json", scene, [f"images/{view.path.name}" for view in views])
    return scene
