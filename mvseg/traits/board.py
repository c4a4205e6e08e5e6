"""Which way is up, from ArUco or ChArUco markers that lie flat under or beside the plant."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from mvseg.errors import InputError
from mvseg.formats.photos import read_photo
from mvseg.scene import Scene

Floats = NDArray[np.float64]

# The families of markers that are tried; the one with the most corners in space counts.
FAMILIES = (cv2.aruco.DICT_4X4_1000, cv2.aruco.DICT_5X5_1000, cv2.aruco.DICT_6X6_1000, cv2.aruco.DICT_7X7_1000,
            cv2.aruco.DICT_ARUCO_ORIGINAL, cv2.aruco.DICT_APRILTAG_36H11)  # fmt: skip
MOST_ERROR = 0.003  # reprojection error of a corner in widths of the photo; more is no marker, or one that moved
MOST_BEND = 0.1  # smallest spread of the corners over their middle one: they lie in one plane


def up_of_board(scene: Scene) -> Floats:
    """(3,) unit vector up: the normal of the plane of all markers, on the side of the cameras.

    Raises:
        InputError: a photo is missing or broken; no marker is seen in two photos, or the markers lie in no one plane.
    """
    photos = [
        np.asarray(cv2.cvtColor(read_photo(scene, view), cv2.COLOR_RGB2GRAY), np.uint8)
        for view in range(len(scene.views))
    ]
    corners = max((_corners(scene, photos, family) for family in FAMILIES), key=len)
    if not len(corners):
        raise InputError("up is 'board', but no ArUco marker is seen in two photos, expected one that lies flat")
    away = corners - corners.mean(0)
    _, spreads, axes = np.linalg.svd(away, full_matrices=False)
    if spreads[2] > MOST_BEND * spreads[1]:
        raise InputError(f"up is 'board', but the {len(corners)} corners of its markers lie in no one plane")
    towards = scene.cameras.centers.mean(0).cpu().numpy() - corners.mean(0)
    return axes[2] if axes[2] @ towards >= 0 else -axes[2]


def _corners(scene: Scene, photos: list[NDArray[np.uint8]], family: int) -> Floats:
    """(P, 3) corners of the markers of one family that two photos or more agree on, world frame."""
    detector = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(family))
    seen: dict[tuple[int, int], list[tuple[int, Floats]]] = {}
    for view, photo in enumerate(photos):
        found, ids, _ = detector.detectMarkers(photo)
        for marker, quad in zip([] if ids is None else [int(number) for number in ids.ravel()], found, strict=True):
            for corner, px in enumerate(np.asarray(quad, dtype=float).reshape(4, 2)):
                # OpenCV has the centre of the top-left pixel at (0, 0).
                seen.setdefault((marker, corner), []).append((view, px + 0.5))
    K, R, t = (getattr(scene.cameras, name).cpu().numpy().astype(float) for name in ("K", "R", "t"))
    px_from_world = K @ np.concatenate([R, t[:, :, None]], 2)
    points = []
    for places in seen.values():
        views = [view for view, _ in places]
        if len(set(views)) < 2 or len(set(views)) < len(views):  # a marker that is there twice says nothing
            continue
        px = np.stack([place for _, place in places])
        point = _triangulate(px_from_world[views], px)
        image = px_from_world[views] @ np.append(point, 1.0)
        error = np.linalg.norm(image[:, :2] / image[:, 2:] - px, axis=1)
        widths = np.array([photos[view].shape[1] for view in views])
        if (error < MOST_ERROR * widths).all():
            points.append(point)
    return np.array(points).reshape(-1, 3)


def _triangulate(px_from_world: Floats, px: Floats) -> Floats:
    """(3,) point of S views with matrices (S, 3, 4) and pixels (S, 2): linear least squares."""
    rows = px[:, :, None] * px_from_world[:, 2:] - px_from_world[:, :2]
    rows = (rows / np.linalg.norm(rows[..., :3], axis=-1, keepdims=True)).reshape(-1, 4)
    return np.asarray(np.linalg.lstsq(rows[:, :3], -rows[:, 3], rcond=None)[0], dtype=float)
