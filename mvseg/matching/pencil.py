"""The half-planes through the baseline of two cameras (Eq. 1); what they are good for is in `epipolar.py`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from mvseg.errors import InputError
from mvseg.matching.numbers import EPIPOLAR
from mvseg.scene import Cameras


@dataclass(frozen=True, eq=False)
class Pencil:
    """The half-planes through the baseline of cameras i and j.

    `plane_from_px` (2, 2, 3) float64 on the CPU, for camera i and camera j: (u, v, 1) -> (x, y), the viewing ray of the
    pixel projected along the baseline. The angle of (x, y) is that of the half-plane, equal in both images.
    """

    plane_from_px: Tensor

    def angles(self, side: int, xy: Tensor) -> Tensor:
        """Half-plane of each pixel (P, 2) of camera i (`side` 0) or j (1). By Eq. 1, pixels of i and j with equal angle
        lie on each other's epipolar lines.

        Returns:
            (P,) float32 in [-2, 2], a monotone stand-in for atan2 that needs one division (the 1-norm angle y / (|x| +
            |y|), continued over the left half-plane). 0 at an epipole, where no half-plane is defined.
        """
        u, v = xy.unbind(1)
        # plain numbers: a product of (P, 2) with (2, 2) is ten times slower
        planes = self.plane_from_px[side].tolist()
        x, y = (torch.mul(u, of_u).add_(v, alpha=of_v).add_(constant) for of_u, of_v, constant in planes)
        angle = y / x.abs().add_(y.abs()).clamp_(min=torch.finfo(x.dtype).tiny)
        if not len(x) or float(x.min()) >= 0:  # as in most pairs: the pencil faces where both cameras look
            return angle
        return torch.where(x < 0, torch.where(y < 0, -2 - angle, 2 - angle), angle)

    def pitch(self, side: int, xy: Tensor) -> float:
        """Mean change of the angle when a pixel moves by one pixel across its epipolar line.

        It is the mean of |x grad y - y grad x| / (|x| + |y|)^2 over pixels `xy` (P, 2) of camera i (`side` 0) or j (1);
        pixels within a pixel of the epipole, where it diverges, count as one pixel away.
        """
        plane = self.plane_from_px[side].to(xy)
        x, y = (plane[row, 0] * xy[:, 0] + plane[row, 1] * xy[:, 1] + plane[row, 2] for row in (0, 1))
        across = torch.hypot(x * plane[1, 0] - y * plane[0, 0], x * plane[1, 1] - y * plane[0, 1])
        one_pixel = plane[:, :2].abs().sum()
        return float((across / torch.maximum(x.abs() + y.abs(), one_pixel) ** 2).mean())


def is_coincident(cameras: Cameras) -> Tensor:
    """(V, V) bool: the pair has no baseline (shorter than 1e-6 of the scene's longest), so no epipolar geometry."""
    centers = cameras.centers
    # Differences, not torch.cdist: that one cancels for many cameras far from the world's origin.
    distance = torch.linalg.vector_norm(centers[:, None] - centers, dim=2)
    return distance <= EPIPOLAR.coincident * distance.max()


def epipolar_pencil(cameras: Cameras, i: int, j: int) -> Pencil:
    """The pencil of two cameras; see `epipolar_pencils`."""
    return epipolar_pencils(cameras, [(i, j)])[0]


def epipolar_pencils(cameras: Cameras, pairs: Sequence[tuple[int, int]]) -> list[Pencil]:
    """The pencils of pairs of cameras, with any baseline: an epipole inside an image or at infinity, or cameras that
    face each other, need no special treatment. Raises InputError: the cameras of a pair share a centre."""
    if not len(pairs):
        return []
    index = torch.tensor(pairs, device=cameras.device)
    baseline = cameras.centers[index].diff(dim=1)[:, 0]
    length = torch.linalg.vector_norm(baseline, dim=1, keepdim=True)
    if (length == 0).any():
        i, j = pairs[int(length[:, 0].argmin())]
        raise InputError(f"views {i} and {j} share a camera centre, expected a baseline between them")
    axis = baseline / length
    # Angle 0 points where both cameras look, so that the jump at +-2 is as far from the regions as possible.
    forward = cameras.R[index, 2].sum(1)
    forward = forward - (forward * axis).sum(1, keepdim=True) * axis
    # When both look along the baseline, any direction across it will do.
    across = torch.linalg.cross(axis, torch.eye(3).to(axis)[axis.abs().argmin(1)])
    forward = torch.where(torch.linalg.vector_norm(forward, dim=1, keepdim=True) < 1e-9, across, forward)
    e1 = forward / torch.linalg.vector_norm(forward, dim=1, keepdim=True)
    e2 = torch.linalg.cross(axis, e1)
    plane_from_px = torch.stack((e1, e2), 1)[:, None] @ cameras.world_from_px[index]
    return [Pencil(planes) for planes in plane_from_px.cpu()]
