"""A photo in memory with the instances that it shows: what detectors are trained on and judged by."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from mvseg.regions import IGNORE_LABEL


@dataclass(frozen=True, eq=False)
class LabelledPhoto:
    """A photo and its N instances.

    Attributes:
        photo: (3, H, W) uint8, RGB.
        layers: (L, H, W) int32, 0 for nothing, k for the k-th instance. Each instance lies whole in one layer; there
            are as many layers as overlaps need (one for a label map).
        classes: (N,) int64, class of instances 1..N.
        ignore: (H, W) bool, pixels that are neither learned from nor judged.
    """

    photo: Tensor
    layers: Tensor
    classes: Tensor
    ignore: Tensor


def label_photo(photo: np.ndarray, labels: np.ndarray) -> LabelledPhoto:
    """A photo (H, W, 3) uint8 RGB with the instances of a label map (H, W) uint16 (0 = nothing, 65535 = ignore), in the
    order of their numbers, all of class 1."""
    ignore = labels == IGNORE_LABEL
    values, indices = np.unique(np.where(ignore, 0, labels), return_inverse=True)
    layer = indices.reshape(labels.shape) + (values[0] != 0)  # a map without background starts at instance 1
    return LabelledPhoto(
        photo=_channels_first(photo),
        layers=torch.from_numpy(layer.astype(np.int32))[None],
        classes=torch.ones(int(layer.max()), dtype=torch.int64),
        ignore=torch.from_numpy(ignore),
    )


def mask_photo(
    photo: np.ndarray, masks: Sequence[np.ndarray], *, classes: Sequence[int], ignore: np.ndarray
) -> LabelledPhoto:
    """A photo (H, W, 3) uint8 RGB with the instances of N masks (H, W) bool, which may overlap, and their N classes. No
    pixel of theirs is ignored, whatever covers it."""
    for mask in masks:
        ignore = ignore & ~mask
    return LabelledPhoto(
        photo=_channels_first(photo),
        layers=stack_layers(masks, ignore.shape),
        classes=torch.tensor(classes, dtype=torch.int64),
        ignore=torch.from_numpy(ignore),
    )


def stack_layers(masks: Sequence[np.ndarray], size: tuple[int, ...]) -> Tensor:
    """The layers of bool masks of this size (H, W): each instance goes into the first layer that is free there."""
    layers = [np.zeros(size, np.int32)]
    for number, mask in enumerate(masks, start=1):
        free = [layer for layer in layers if not layer[mask].any()]
        if not free:
            layers += (free := [np.zeros(size, np.int32)])
        free[0][mask] = number
    return torch.from_numpy(np.stack(layers))


def _channels_first(photo: np.ndarray) -> Tensor:
    return torch.from_numpy(photo).permute(2, 0, 1).contiguous()
