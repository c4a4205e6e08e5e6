"""How far the outlines of one leaf are from touching the same epipolar lines.

A half-plane through the centres of two cameras that touches a leaf touches its outline in both photos (the epipolar
tangency of outlines). So the masks of a leaf that two photos show whole begin and end at the same epipolar lines, and
where they do not, the poses are off by about as many pixels, or the masks are. See Cipolla and Giblin, Visual Motion of
Curves and Surfaces (2000), on frontier points.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mvseg.masks import Masks
from mvseg.matching.numbers import TANGENCY
from mvseg.matching.pencil import epipolar_pencils, is_coincident
from mvseg.regions import Regions
from mvseg.scene import Cameras


@dataclass(frozen=True, eq=False)
class Outlines:
    """The convex hulls of N matched masks: a mask begins and ends at corners of its hull. On the CPU.

    Attributes:
        corners: (N, P, 2) float64 pixels; the first one is repeated where there are fewer.
        middle: (N, 2) float64 pixels, inside.
        view: (N,) int64.
        instance: (N,) int64, id.
        weight: (N,) float64, match score.
    """

    corners: Tensor
    middle: Tensor
    view: Tensor
    instance: Tensor
    weight: Tensor

    def select(self, index: Tensor) -> Outlines:
        """The outlines at an int64 index or a bool mask."""
        return Outlines(
            corners=self.corners[index],
            middle=self.middle[index],
            view=self.view[index],
            instance=self.instance[index],
            weight=self.weight[index],
        )


@dataclass(frozen=True, eq=False)
class TangencyResiduals:
    """T pairs of points at which two outlines of an instance touch an epipolar line, and how far apart the lines are.

    Attributes:
        outlines: (T, 2) int64, indices of the outlines.
        px: (T,) float64, the distance with its sign, pixels of both photos together (Sampson's distance): 1 if one of
            the outlines is drawn 1 pixel off across the line, or each 0.7.
        by_pose: (T, 2, 6) float64, derivatives by the pose of either view, see `move_cameras`.
        by_growth: (T, 2) float64, derivatives by the pixels that either outline is drawn too tightly.
        weight: (T,) float64, of both outlines together.
    """

    outlines: Tensor
    px: Tensor
    by_pose: Tensor
    by_growth: Tensor
    weight: Tensor


def find_outlines(masks: Masks, cameras: Cameras) -> Outlines:
    """The outlines of the matched masks, without those that touch the border of the photo, and those of instances with
    several masks in the view: they end where the leaf does not. Neighbours hide parts of others; that is for a robust
    fit to find out."""
    regions = masks.regions
    ids, views = masks.instance_ids.cpu(), regions.view_index.cpu()
    regions, cameras = regions.to("cpu"), cameras.to("cpu")
    place = views * (masks.num_instances + 1) + ids.clamp(min=0)
    is_only = torch.bincount(place, minlength=1)[place] == 1
    chosen = ((ids > 0) & ~touches_border(regions, cameras) & is_only).nonzero()[:, 0]
    hulls = [_hull(regions, index) for index in chosen.tolist()]
    return Outlines(
        corners=_pad(hulls),
        middle=torch.stack([hull.mean(0) for hull in hulls]) if hulls else torch.zeros(0, 2).double(),
        view=views[chosen],
        instance=ids[chosen],
        weight=masks.match_scores.cpu()[chosen].double(),
    )


def touches_border(regions: Regions, cameras: Cameras) -> Tensor:
    """(D,) bool, whether a region reaches the border of its photo, where it may be cut."""
    return ((regions.boxes[:, :2] <= 0) | (regions.boxes[:, 2:] >= cameras.sizes[regions.view_index])).any(1)


def hull_corners(regions: Regions) -> Tensor:
    """(D, P, 2) float64, the corners of the regions' hulls, pixel centres; the first is repeated where there are
    fewer."""
    return _pad([_hull(regions, index) for index in range(len(regions))])


def _pad(hulls: list[Tensor]) -> Tensor:
    most = max((len(hull) for hull in hulls), default=1)
    padded = [torch.cat((hull, hull[:1].expand(most - len(hull), 2))) for hull in hulls]
    return torch.stack(padded) if hulls else torch.zeros(0, most, 2).double()


def _hull(regions: Regions, index: int) -> Tensor:
    """(P, 2) float64, the corners of a region's hull, pixel centres."""
    corners = cv2.convexHull(cv2.findNonZero(without_small_components(regions.crop(index).numpy())))[:, 0]
    return torch.from_numpy(corners + regions.boxes[index, :2].numpy() + 0.5)


def without_small_components(mask: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """A mask (H, W) without the components of less than 0.2 % of its pixels: they would be its ends."""
    _, pieces, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8))
    is_kept = stats[:, cv2.CC_STAT_AREA] >= TANGENCY.small_component * mask.sum()
    is_kept[0] = False
    return is_kept[pieces].astype(np.uint8) if is_kept.any() else mask.astype(np.uint8)


def pair_outlines(outlines: Outlines, cameras: Cameras) -> Tensor:
    """(Q, 2) int64, all pairs of outlines of one instance in two views that have a baseline."""
    is_same = outlines.instance[:, None] == outlines.instance
    has_baseline = ~is_coincident(cameras)[outlines.view[:, None], outlines.view]
    return (is_same & has_baseline).triu(1).nonzero()


def tangency_residuals(
    outlines: Outlines, pairs: Tensor, cameras: Cameras, *, world_per_px: Tensor
) -> TangencyResiduals:
    """The residuals at both ends of pairs of outlines; masks that hold the epipole have none.

    Args:
        outlines: N outlines.
        pairs: (Q, 2) int64, see `pair_outlines`.
        cameras: V cameras on the CPU.
        world_per_px: (V,) float64, see `move_cameras`.
    """
    frames, angles = _pencil_frames(cameras, outlines.view[pairs]), []
    for side in (0, 1):
        rows = frames[:, side]
        x, y = (outlines.corners[pairs[:, side]] @ rows[:, :, :2].mT + rows[:, None, :, 2]).unbind(2)
        angles.append(torch.atan2(y, x))
    is_narrow = torch.stack([angle.amax(1) - angle.amin(1) < TANGENCY.widest for angle in angles]).all(0)
    kept = pairs[is_narrow]
    ends = [torch.stack([pick(angle, 1)[is_narrow] for angle in angles], 1) for pick in (torch.argmin, torch.argmax)]
    at = torch.cat([outlines.corners[kept, corner] for corner in ends])
    return _linear_residuals(outlines, torch.cat((kept, kept)), at, cameras=cameras, world_per_px=world_per_px)


def _pencil_frames(cameras: Cameras, views: Tensor) -> Tensor:
    """(Q, 2, 2, 3) `Pencil.plane_from_px` for pairs of views (Q, 2)."""
    different, which = views.unique(dim=0, return_inverse=True)
    pencils = epipolar_pencils(cameras, [(i, j) for i, j in different.tolist()])
    frames = torch.stack([pencil.plane_from_px for pencil in pencils]) if pencils else torch.zeros(0, 2, 2, 3).double()
    return frames[which]


def _linear_residuals(
    outlines: Outlines, pairs: Tensor, at: Tensor, *, cameras: Cameras, world_per_px: Tensor
) -> TangencyResiduals:
    """The residuals between the points (T, 2, 2) at which pairs of outlines (T, 2) end.

    To first order, a residual stays when the outlines touch elsewhere: the derivatives are those of fixed points.
    """
    view = outlines.view[pairs]
    pixels = torch.cat((at, torch.ones_like(at[..., :1])), 2)
    in_camera = (torch.linalg.inv(cameras.K)[view] @ pixels[..., None])[..., 0]
    rays = (cameras.R.mT[view] @ in_camera[..., None])[..., 0]
    baseline = cameras.centers[view].diff(dim=1)[:, 0]
    # The volume that both rays and the baseline span is 0 where they meet, and linear in each of them.
    by_ray = torch.stack((torch.linalg.cross(rays[:, 1], baseline), torch.linalg.cross(baseline, rays[:, 0])), 1)
    volume = (rays[:, 0] * by_ray[:, 0]).sum(1)
    by_px = (cameras.world_from_px.mT[view] @ by_ray[..., None])[..., :2, 0]
    slope = by_px.square().sum((1, 2)).sqrt().clamp(min=torch.finfo(torch.float64).tiny)
    by_turn = torch.linalg.cross((cameras.R[view] @ by_ray[..., None])[..., 0], in_camera)
    by_turn = by_turn / cameras.K[:, 0, 0][view][..., None]
    normal = torch.linalg.cross(rays[:, 0], rays[:, 1])[:, None] * torch.tensor([1.0, -1.0]).double()[:, None]
    by_shift = (cameras.R[view] @ normal[..., None])[..., 0] * world_per_px[view][..., None]
    outwards = (by_px * (at - outlines.middle[pairs])).sum(2).sign()
    return TangencyResiduals(
        outlines=pairs,
        px=volume / slope,
        by_pose=torch.cat((by_turn, by_shift), 2) / slope[:, None, None],
        by_growth=outwards * by_px.norm(dim=2) / slope[:, None],
        weight=outlines.weight[pairs].prod(1).sqrt(),
    )


def move_cameras(cameras: Cameras, steps: Tensor, world_per_px: Tensor) -> Cameras:
    """Cameras that are turned about their centres and then shifted.

    Args:
        cameras: V cameras.
        steps: (V, 6) float64: turns about the camera's x, y and z by so many pixels at one focal length, and changes of
            t by so many `world_per_px`.
        world_per_px: (V,) float64, by how many world units a camera moves to move what it looks at by a pixel.
    """
    x, y, z = (steps[:, :3] / cameras.K[:, 0, 0, None]).T
    zero = torch.zeros_like(x)
    turn = torch.linalg.matrix_exp(torch.stack((zero, -z, y, z, zero, -x, -y, x, zero), 1).reshape(-1, 3, 3))
    t = (turn @ cameras.t[:, :, None])[:, :, 0] + steps[:, 3:] * world_per_px[:, None]
    return Cameras(K=cameras.K, R=turn @ cameras.R, t=t, sizes=cameras.sizes)
