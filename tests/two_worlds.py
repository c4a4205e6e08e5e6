"""Cameras with faults that no single view shows."""

from __future__ import annotations

from dataclasses import replace

import torch

from mvseg.scene import Cameras


def every_second_farther(cameras: Cameras, factor: float) -> Cameras:
    """Every second t is `factor` times as long, as with another unit."""
    t = cameras.t.clone()
    t[::2] *= factor
    return replace(cameras, t=t)


def half_turned(cameras: Cameras, degrees: float) -> Cameras:
    """The first half of the cameras, turned round the world's z axis."""
    angle = torch.deg2rad(torch.tensor(degrees).double())
    turn = torch.eye(3).double()
    turn[0, 0] = turn[1, 1] = angle.cos()
    turn[1, 0], turn[0, 1] = angle.sin(), -angle.sin()
    R = cameras.R.clone()
    R[: len(R) // 2] = R[: len(R) // 2] @ turn
    return replace(cameras, R=R)
