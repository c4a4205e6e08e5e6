"""The cameras from above: where they stand, which way they look, and the point that they look at."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from mvseg.checks.cameras import Coverage
from mvseg.scene import Scene

SIDE, MARGIN = 900, 90  # limit: pixels of the picture
ARROW = 0.12  # limit: length of an arrow, of the picture's side
PAPER, INK, FAULT, POINT = (255, 255, 255), (60, 60, 60), (215, 48, 39), (26, 152, 80)  # limit: RGB


def draw_cameras(scene: Scene, coverage: Coverage, off: tuple[int, ...] = ()) -> NDArray[np.uint8]:
    """(900, 900, 3) uint8 RGB: a plan of the cameras. It shows the plane across `scene.up`, or the plane in which the
    cameras spread most. Cameras are arrows with their numbers; red ones look past the point (a green dot) or are in
    `off`, the views whose poses are wrong."""
    cameras = scene.cameras
    # axes (2, 3): the directions of the world that the picture shows as right and up
    away = cameras.centers.numpy() - cameras.centers.mean(0).numpy()
    axes = np.linalg.svd(away)[2][:2] if scene.up is None else np.linalg.svd(np.array([scene.up]))[2][1:]
    centers, gaze = cameras.centers.numpy() @ axes.T, cameras.R[:, 2].numpy() @ axes.T
    shown = np.vstack([centers, coverage.point @ axes.T])
    low, high = shown.min(0), shown.max(0)
    scale = (SIDE - 2 * MARGIN) / max(float((high - low).max()), 1e-12)
    middle = (low + high) / 2

    def pixel(at: NDArray[np.float64]) -> tuple[int, int]:
        x, y = SIDE / 2 + (at - middle) * scale * np.array([1, -1])
        return round(float(x)), round(float(y))

    picture = np.full((SIDE, SIDE, 3), PAPER, np.uint8)
    cv2.circle(picture, pixel(coverage.point @ axes.T), 8, POINT, -1, cv2.LINE_AA)
    for view in range(len(cameras)):
        color = FAULT if view in off or not coverage.sees[view] else INK
        start = pixel(centers[view])
        end = pixel(centers[view] + gaze[view] * ARROW * SIDE / scale)
        cv2.arrowedLine(picture, start, end, color, 2, cv2.LINE_AA, tipLength=0.25)
        cv2.circle(picture, start, 5, color, -1, cv2.LINE_AA)
        at = (start[0] + 9, start[1] - 9)
        cv2.putText(picture, str(view), at, cv2.FONT_HERSHEY_SIMPLEX, 0.55, color, 1, cv2.LINE_AA)
    return picture
