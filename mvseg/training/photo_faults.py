"""Faults that real photos have and rendered ones lack: uneven light, camera faults, clutter, and leaves that are not
green; drawn from torch's global generator."""

from __future__ import annotations

import colorsys
import math

import cv2
import numpy as np
import torch
from torch import Tensor

SKIN = (225.0, 175.0, 145.0)  # chosen: RGB
LUMINANCE = torch.tensor([0.299, 0.587, 0.114])


def light_unevenly(photo: Tensor) -> Tensor:
    """Put patches of shadow, or of glare up to overexposure, on a photo (3, H, W) uint8; their edges are sharp or soft.
    Detectors trained without it split leaves at the edge of a shadow."""
    cells, sharpness = int(torch.randint(2, 9, ())), 2 ** (6 * draw(0, 1))
    rough = torch.randn(1, 1, cells, cells)
    field = torch.nn.functional.interpolate(rough, photo.shape[1:], mode="bicubic", align_corners=True)[0]
    amount = torch.sigmoid(sharpness * (field - 0.5 * torch.randn(())))
    gain = math.exp(draw(-1.3, 0.9))  # 0.27 to 2.5
    return (photo.float() * (1 + (gain - 1) * amount)).clamp(0, 255).to(photo.dtype)


def spoil(photo: Tensor) -> Tensor:
    """One of five faults of a camera, for a photo (3, H, W) uint8: motion blur, JPEG of quality 10 to 60, sensor noise,
    overexposure, or an image without colour, as infrared cameras take at night."""
    fault = int(torch.randint(5, ()))
    if fault == 0:
        return blur_motion(photo, length=draw(3, 11), angle=draw(0, math.pi))
    if fault == 1:
        return compress(photo, quality=int(torch.randint(10, 61, ())))
    if fault == 2:
        return (photo.float() + draw(5, 25) * torch.randn(photo.shape)).clamp(0, 255).to(photo.dtype)
    if fault == 3:
        return (photo.float() * draw(1.3, 2.5)).clamp(0, 255).to(photo.dtype)
    bright = photo.float().amax(0, keepdim=True)  # leaves are bright in the near infrared
    return (255 * (bright / 255) ** draw(0.6, 1.6)).to(photo.dtype).expand(3, -1, -1).clone()


def compress(photo: Tensor, *, quality: int) -> Tensor:
    """Compress a photo (3, H, W) uint8, RGB, as JPEG of a quality from 1 to 100, and decode it."""
    _, coded = cv2.imencode(".jpg", photo.permute(1, 2, 0).numpy()[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, quality])
    decoded = np.asarray(cv2.imdecode(coded, cv2.IMREAD_COLOR))
    return torch.from_numpy(decoded[..., ::-1].copy()).permute(2, 0, 1)


def blur_motion(photo: Tensor, *, length: float, angle: float) -> Tensor:
    """Blur of a camera that moved along a line: length in pixels, direction in radians."""
    radius = math.ceil(length / 2)
    offsets = torch.arange(-radius, radius + 1, dtype=torch.float32)
    y, x = torch.meshgrid(offsets, offsets, indexing="ij")
    along, across = math.cos(angle) * x + math.sin(angle) * y, math.cos(angle) * y - math.sin(angle) * x
    kernel = (1 - across.abs()).clamp(min=0) * (along.abs() <= length / 2)
    kernel = (kernel / kernel.sum()).expand(3, 1, -1, -1)
    padded = torch.nn.functional.pad(photo.float()[None], [radius] * 4, mode="replicate")
    return torch.nn.functional.conv2d(padded, kernel, groups=3)[0].round().clamp(0, 255).to(photo.dtype)


def add_clutter(photo: Tensor, layers: Tensor) -> tuple[Tensor, Tensor]:
    """Put one to three objects in front that are not leaves: tapes, labels, sticks, discs and hands. All but hands take
    a colour of the photo itself in half of the cases, so that green alone does not make a leaf.

    Returns new tensors: photo (3, H, W) uint8 and layers (L, H, W) int, which are 0 where a thing hides an instance.
    """
    height, width = photo.shape[1:]
    rows, columns = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    photo, layers = photo.clone(), layers.clone()
    for _ in range(int(torch.randint(1, 4, ()))):
        half_length = max(height, width) * draw(0.02, 0.35)
        half_width = min(half_length, max(height, width) * draw(0.01, 0.08))
        row, column, angle = draw(0, height), draw(0, width), draw(0, math.pi)
        along = (math.cos(angle) * (columns - column) + math.sin(angle) * (rows - row)) / half_length
        across = (math.cos(angle) * (rows - row) - math.sin(angle) * (columns - column)) / half_width
        kind = draw(0, 1)
        of_photo = photo[:, int(torch.randint(height, ())), int(torch.randint(width, ()))].float()
        color = of_photo if draw(0, 1) < 0.5 else 255 * torch.rand(3)
        if kind < 0.1:
            shape, color = hand_shape(along, across * half_width / half_length), draw(0.3, 1.1) * torch.tensor(SKIN)
        elif kind < 0.35:
            shape = along.square() + across.square() < 1
        else:
            shape = torch.maximum(along.abs(), across.abs()) < 1
        shading = 1 + draw(-0.3, 0.3) * along + draw(-0.3, 0.3) * across
        grain = 1 + draw(0, 0.1) * torch.randn(height, width)
        thing = (color[:, None, None] * shading * grain).clamp(0, 255).to(photo.dtype)
        photo = torch.where(shape, thing, photo)
        layers = layers.masked_fill(shape, 0)
    return photo, layers


def tint_leaves(photo: Tensor, layers: Tensor) -> Tensor:
    """Give the leaves another colour, as those of coleus, beet, red lettuce or a silvery sage have; stems keep theirs.

    All leaves of a photo (3, H, W) uint8, given as layers (L, H, W), get the same hue, at different strengths;
    brightness is kept, up to one factor. A detector that has seen green leaves only takes a red plant's stems for its
    leaves.
    """
    color = torch.tensor(colorsys.hsv_to_rgb(draw(0, 1), draw(0, 0.8), 1.0))
    color = draw(0.6, 1.3) * color / float((LUMINANCE * color).sum())
    labels = layers.amax(0).long()
    amount = draw(0.5, 1) * (1 - draw(0, 0.5) * torch.rand(int(labels.max()) + 1))
    amount[0] = 0
    grey = (LUMINANCE[:, None, None] * photo.float()).sum(0)
    tinted = photo.float() + amount[labels] * (grey * color[:, None, None] - photo.float())
    return tinted.round().clamp(0, 255).to(photo.dtype)


def hand_shape(along: Tensor, across: Tensor) -> Tensor:
    """(H, W) bool, where a palm with an arm behind and four fingers ahead is; coordinates in units of half a hand."""
    shape = (along / 0.42).square() + (across / 0.4).square() < 1
    shape |= (along < 0) & (across.abs() < 0.25)
    for finger in range(4):
        bend = across - 0.24 * (finger - 1.5) * (1 + along)
        shape |= ((along - 0.5) / draw(0.3, 0.5)).square() + (bend / 0.13).square() < 1
    return shape


def draw(low: float, high: float) -> float:
    """A uniformly distributed random number."""
    return low + (high - low) * float(torch.rand(()))
