"""Tiny scene folders for the tests of files and of the command line: three balls seen by cameras on an arc."""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np

WIDTH, HEIGHT, FOCAL = 128, 96, 150.0
BALLS = np.array([[-9.0, -3.0, 2.0], [8.0, -6.0, -3.0], [1.0, 8.0, 5.0]])  # mm
RADIUS = 4.0
COLORS = ((250, 60, 60), (60, 250, 60), (60, 60, 250))  # RGB
K = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]])


def arc_pose(view: int, num_views: int) -> tuple[np.ndarray, np.ndarray]:
    """R, t of a camera 60 mm from the origin that looks at it; +y of the world is down."""
    angle, lift = np.radians(-50 + 100 * view / (num_views - 1)), np.radians(12 + 9 * (view % 3))
    center = 60 * np.array([np.sin(angle) * np.cos(lift), -np.sin(lift), -np.cos(angle) * np.cos(lift)])
    forward = -center / np.linalg.norm(center)
    right = np.cross([0, 1.0, 0], forward)
    right /= np.linalg.norm(right)
    R = np.stack((right, np.cross(forward, right), forward))
    return R, -R @ center


def draw_labels(R: np.ndarray, t: np.ndarray) -> np.ndarray:
    """(H, W) uint16, ball b painted as b + 1, the nearest on top: pixels whose ray meets the ball."""
    rows, columns = np.indices((HEIGHT, WIDTH)) + 0.5
    rays = np.stack(((columns - WIDTH / 2) / FOCAL, (rows - HEIGHT / 2) / FOCAL, np.ones_like(rows)), -1)
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    labels = np.zeros((HEIGHT, WIDTH), np.uint16)
    centers = BALLS @ R.T + t
    for ball in np.argsort(-centers[:, 2]):
        off = np.linalg.norm(centers[ball] - rays * (rays @ centers[ball])[..., None], axis=-1)
        labels[off < RADIUS] = ball + 1
    return labels


def rig_content(num_views: int = 4) -> dict[str, Any]:
    """A sound rig file; tests break it."""
    views = []
    for view in range(num_views):
        R, t = arc_pose(view, num_views)
        entry = {"file": f"images/{view:03d}.png", "width": WIDTH, "height": HEIGHT}
        views.append(entry | {"K": K.tolist(), "R": R.tolist(), "t": t.tolist()})
    return {"format": "mvseg-rig/1", "unit": "mm", "views": views}


@cache
def drawn_labels(view: int, num_views: int) -> np.ndarray:
    return draw_labels(*arc_pose(view, num_views))


def write_scene(folder: Path, num_views: int = 4, *, images: bool = True) -> Path:
    """A whole scene: cameras.json, images/, masks/ (numbers mean nothing across views) and truth/."""
    folder.mkdir(parents=True)
    (folder / "cameras.json").write_text(json.dumps(rig_content(num_views)))
    for view in range(num_views):
        truth = drawn_labels(view, num_views)
        numbers = np.array([0, *(np.roll((1, 2, 3), view) + 10 * view)], np.uint16)
        write_image(folder / "masks" / f"{view:03d}.png", numbers[truth])
        write_image(folder / "truth" / f"{view:03d}.png", truth)
        if images:
            palette = np.array([(20, 20, 20), *COLORS], np.uint8)
            write_image(folder / "images" / f"{view:03d}.png", palette[truth])
    return folder


def write_image(path: Path, image: np.ndarray) -> None:
    """(H, W) or (H, W, 3) RGB, in the format that the suffix says."""
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), image if image.ndim == 2 else image[..., ::-1])


def edit_rig(folder: Path, view: int | None = None, **changes: Any) -> None:
    """Change keys of the rig file, or of one of its views."""
    path = folder / "cameras.json"
    rig = json.loads(path.read_text())
    (rig if view is None else rig["views"][view]).update(changes)
    path.write_text(json.dumps(rig))


def cut_file(path: Path, share: float) -> None:
    """Keep the first part of a file."""
    data = path.read_bytes()
    path.write_bytes(data[: int(share * len(data))])
