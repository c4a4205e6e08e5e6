"""Depth maps without a graphics card: OpenCV's semi-global matching on rectified pairs of neighbouring views.

It replaces the PatchMatch stereo that the paper ran (Sec. 4.2), and is weaker: it needs views at most `MAX_ANGLE_DEG`
apart. Its results always carry its name, "sgbm".
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from torch import Tensor

from mvseg.scene import Cameras, nearest_point

MAX_ANGLE_DEG = 25.0  # between the directions to two cameras; beyond it semi-global matching finds next to nothing
NUM_NEIGHBOURS = 2  # nearest views that every view is paired with
MAX_OBLIQUE = 0.7  # cosine of the angle between baseline and line of sight, above which a pair is not rectified
MAX_LEFT_RIGHT = 1.0  # pixels by which the disparities of the two sides may differ
MAX_DEPTH_ERROR = 0.01  # relative difference allowed between the depths of two views
BALL_MARGIN = 1.1


@dataclass(frozen=True, eq=False)
class Ball:
    """What the cameras look at: center (3,) float64 and radius, world frame and units."""

    center: Tensor
    radius: float


@dataclass(frozen=True, eq=False)
class RectifiedPair:
    """Views i and j on a common image plane, where a world point has the same row in both.

    Attributes:
        i, j: view indices; j is the view to the right.
        rect_from_px: (2, 3, 3) float64; the third coordinate of `rect_from_px @ (u, v, 1)` is the depth along the
            common axis at depth 1 of the view.
        size: width and height of the rectified images in pixels.
        focal_baseline: pixels times world units; depth is `focal_baseline` / full disparity.
        offset: full disparity minus that in the rectified images, where the centre of the ball has 0; pixels.
        search: smallest and largest disparity in the rectified images.
    """

    i: int
    j: int
    rect_from_px: Tensor
    size: tuple[int, int]
    focal_baseline: float
    offset: float
    search: tuple[int, int]


def seen_ball(cameras: Cameras) -> Ball:
    """The ball around the point nearest to all optical axes that fills the smaller side of the median image.

    Assumes that the cameras stand around one object, as in the paper; nothing else bounds the depths.
    """
    centers = cameras.centers
    center = nearest_point(centers, cameras.R[:, 2])
    slope = (cameras.sizes / 2 / cameras.K.diagonal(dim1=1, dim2=2)[:, :2]).amin(1)
    radius = (torch.linalg.vector_norm(centers - center, dim=1) * slope.atan().sin()).median()
    return Ball(center, BALL_MARGIN * float(radius))


def view_angles(cameras: Cameras, ball: Ball) -> Tensor:
    """(V, V) float64: degrees between the directions from the ball to the cameras; infinite on the diagonal."""
    directions = torch.nn.functional.normalize(cameras.centers - ball.center, dim=1)
    angles = torch.rad2deg((directions @ directions.T).clamp(-1, 1).acos())
    return angles.fill_diagonal_(torch.inf)


def neighbour_pairs(cameras: Cameras, ball: Ball) -> list[tuple[int, int]]:
    """Pairs i < j of views at most `MAX_ANGLE_DEG` apart, one of them among the nearest of the other."""
    angles, order = view_angles(cameras, ball).sort(dim=1, stable=True)
    pairs = set()
    for i in range(len(cameras)):
        for angle, j in list(zip(angles[i].tolist(), order[i].tolist(), strict=True))[:NUM_NEIGHBOURS]:
            if angle <= MAX_ANGLE_DEG:
                pairs.add((min(i, j), max(i, j)))
    return sorted(pairs)


def rectified_axes(cameras: Cameras, views: tuple[int, int]) -> Tensor | None:
    """(3, 3) float64 rect_from_world with +x along the baseline and +z close to both optical axes.

    None where the baseline is zero or points along the line of sight.
    """
    i, j = views
    baseline = cameras.centers[j] - cameras.centers[i]
    length = torch.linalg.vector_norm(baseline)
    sight = torch.nn.functional.normalize(cameras.R[[i, j], 2].sum(0), dim=0)
    if length == 0 or (baseline @ sight).abs() > MAX_OBLIQUE * length:
        return None
    x = baseline / length
    z = torch.nn.functional.normalize(sight - (sight @ x) * x, dim=0)
    return torch.stack((x, torch.linalg.cross(z, x), z))


def rectify(cameras: Cameras, ball: Ball, views: tuple[int, int]) -> RectifiedPair | None:
    """The rectified pair of two views; None where they have no `rectified_axes`, or the ball is behind them."""
    rect_from_world = rectified_axes(cameras, views)
    if rect_from_world is None:
        return None
    i, j = views
    focal = float(cameras.K[[i, j]].diagonal(dim1=1, dim2=2)[:, :2].mean())
    rect_from_px, corners = [], []
    for view in views:
        middle = rect_from_world @ (ball.center - cameras.centers[view])
        K = torch.diag(torch.tensor([focal, focal, 1.0]).to(middle))
        K[:2, 2] = -focal * middle[:2] / middle[2]  # moves the centre of the ball to (0, 0) in both images
        rect_from_px.append(K @ rect_from_world @ cameras.world_from_px[view])
        width, height = cameras.sizes[view].tolist()
        corner = torch.tensor([[u, v, 1.0] for u in (0, width) for v in (0, height)]).to(middle) @ rect_from_px[-1].T
        corners.append(corner[:, :2] / corner[:, 2:].clamp(min=1e-6))
    depth = float(middle[2])
    focal_baseline = focal * float(torch.linalg.vector_norm(cameras.centers[j] - cameras.centers[i]))
    if depth <= 0:
        return None
    near, far = max(depth - ball.radius, 0.2 * depth), depth + ball.radius
    least, most = (focal_baseline * (1 / end - 1 / depth) for end in (far, near))
    search = int(np.floor(least)), int(np.ceil(most))
    # Of very oblique views only the part around the ball is kept. SGBM leaves a margin as wide as its search blank.
    side = 2.0 * float(cameras.sizes[[i, j]].max())
    low = torch.cat(corners).amin(0).clamp(min=-side).floor()
    high = torch.cat(corners).amax(0).clamp(max=side).ceil()
    margin = torch.tensor([max(-search[0], search[1]) + 16.0, 0.0]).to(low)
    low, high = low - margin, high + margin
    shift = torch.eye(3).to(low)
    shift[:2, 2] = -low
    columns, rows = (high - low).long().tolist()
    return RectifiedPair(
        i=i,
        j=j,
        rect_from_px=shift @ torch.stack(rect_from_px),
        size=(columns, rows),
        focal_baseline=focal_baseline,
        offset=focal_baseline / depth,
        search=search,
    )


def pair_depths(pair: RectifiedPair, photos: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Depth maps (H, W) float32 of both views of a pair along their own +z, world units; NaN where the two sides
    disagree. `photos` holds those of all views, uint8 grey."""
    left, right = (
        warp(photos[view], H.numpy(), pair.size) for view, H in zip((pair.i, pair.j), pair.rect_from_px, strict=True)
    )
    forth = disparity(left, right, pair.search)
    # Mirrored, the right image is a left one, with the same range of disparities.
    back = disparity(right[:, ::-1], left[:, ::-1], pair.search)[:, ::-1]
    columns = np.arange(pair.size[0])
    depths = []
    for side, here, there, sign in ((0, forth, back, -1), (1, back, forth, 1)):
        partner = np.rint(columns + sign * np.nan_to_num(here)).astype(int).clip(0, pair.size[0] - 1)
        is_confirmed = np.abs(np.take_along_axis(there, partner, 1) - here) <= MAX_LEFT_RIGHT
        confirmed = np.where(is_confirmed, here, np.nan)
        depths.append(depth_in_view(pair, side, confirmed, shape=photos[(pair.i, pair.j)[side]].shape))
    return depths[0], depths[1]


def depth_in_view(pair: RectifiedPair, side: int, disparities: np.ndarray, *, shape: tuple[int, ...]) -> np.ndarray:
    """(H, W) float32 depth map of one side (0: i, 1: j) of a pair from its disparities on the common plane; NaN where
    there is none. `shape` is that of the photo."""
    v, u = np.indices(shape) + 0.5
    rect = np.stack((u, v, np.ones_like(u)), -1) @ pair.rect_from_px[side].numpy().T
    column, row = np.floor(rect[..., :2] / rect[..., 2:]).astype(int).transpose(2, 0, 1)
    is_inside = (column >= 0) & (column < pair.size[0]) & (row >= 0) & (row < pair.size[1])
    full = disparities[row.clip(0, pair.size[1] - 1), column.clip(0, pair.size[0] - 1)] + pair.offset
    depth = pair.focal_baseline / np.where(full > 0, full, np.nan) / rect[..., 2]
    return np.where(is_inside, depth, np.nan).astype(np.float32)


def warp(photo: np.ndarray, rect_from_px: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """The photo on the common plane; OpenCV counts from the centre of the first pixel."""
    half = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1]])
    return np.asarray(cv2.warpPerspective(photo, np.linalg.inv(half) @ rect_from_px @ half, size))


def disparity(left: np.ndarray, right: np.ndarray, search: tuple[int, int]) -> np.ndarray:
    """(H, W) float32 disparities of the left image, NaN where there is none."""
    block = 5
    matcher = cv2.StereoSGBM.create(
        minDisparity=search[0],
        numDisparities=16 * -(-(search[1] - search[0] + 1) // 16),
        blockSize=block,
        P1=8 * block**2,
        P2=32 * block**2,
        preFilterCap=31,
        uniquenessRatio=5,
        speckleWindowSize=50,
        speckleRange=2,
        mode=cv2.STEREO_SGBM_MODE_HH,
    )
    sixteenths = matcher.compute(np.ascontiguousarray(left), np.ascontiguousarray(right))
    return np.where(sixteenths >= 16 * search[0], sixteenths / 16, np.nan).astype(np.float32)


def sgbm_depths(photos: list[np.ndarray], cameras: Cameras) -> list[np.ndarray]:
    """V maps (H, W) float32 of photos (H, W) uint8 grey: depth along the view's +z in world units, 0 = unknown.

    The depth of a view is the median over its pairs; it is kept where the depth of another view agrees within 1 %. A
    view without a neighbour that is near enough is 0 everywhere.
    """
    cameras = cameras.to("cpu")
    ball = seen_ball(cameras)
    candidates: list[list[np.ndarray]] = [[] for _ in photos]
    neighbours: list[list[int]] = [[] for _ in photos]
    for i, j in neighbour_pairs(cameras, ball):
        pair = rectify(cameras, ball, (i, j))
        if pair is None:
            continue
        for view, other, depth in zip((i, j), (j, i), pair_depths(pair, photos), strict=True):
            candidates[view].append(depth)
            neighbours[view].append(other)
    empty = [np.full(photo.shape, np.nan, np.float32) for photo in photos]
    medians = [
        torch.from_numpy(np.stack(maps)).nanmedian(0).values.numpy() if maps else blank
        for maps, blank in zip(candidates, empty, strict=True)
    ]
    agreed = (consistent_depth(medians, cameras, view=view, others=others) for view, others in enumerate(neighbours))
    return [smooth(depth) for depth in agreed]


def consistent_depth(depths: list[np.ndarray], cameras: Cameras, *, view: int, others: list[int]) -> np.ndarray:
    """(H, W) float32: the depths of a view where that of one of `others` agrees, else 0; `depths` are NaN or > 0."""
    here = depths[view]
    v, u = np.nonzero(np.isfinite(here))
    rays = torch.from_numpy(np.stack((u + 0.5, v + 0.5, np.ones(len(u))), 1)) @ cameras.world_from_px[view].T
    pixels, expected = cameras[others].project(cameras.centers[view] + rays * torch.from_numpy(here[v, u])[:, None])
    agrees = np.zeros(len(u), bool)
    for other, xy, depth in zip(others, pixels.numpy(), expected.numpy(), strict=True):
        height, width = depths[other].shape
        is_inside = (depth > 0) & (xy >= 0).all(1) & (xy[:, 0] < width) & (xy[:, 1] < height)
        column, row = np.where(is_inside[:, None], xy, 0).astype(int).T
        agrees |= is_inside & (np.abs(depths[other][row, column] - depth) <= MAX_DEPTH_ERROR * depth)
    kept = np.zeros_like(here)
    kept[v[agrees], u[agrees]] = here[v[agrees], u[agrees]]
    return kept


def smooth(depth: np.ndarray) -> np.ndarray:
    """(H, W) float32 median of 5 x 5 pixels; pixels of unknown depth (0) stay unknown, isolated ones become so."""
    return np.where(depth > 0, cv2.medianBlur(depth, 5), 0)
