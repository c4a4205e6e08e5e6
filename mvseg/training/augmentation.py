"""Training data of a detector from samples: augmentation, targets, and the order of an epoch.

Everything random here is a pure function of (seed, epoch, index): a training run sees the same photos whatever its
number of workers or processes, and however often it is interrupted.
"""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional
from torch.utils.data import Dataset
from torchvision import tv_tensors
from torchvision.ops import masks_to_boxes
from torchvision.transforms import v2

from mvseg.evaluation.labelled_photo import LabelledPhoto
from mvseg.training.config import Orientation, TrainConfig
from mvseg.training.data import SampleList, read_sample
from mvseg.training.new_plants import draw_background, list_backgrounds, recolor, render_new_plant
from mvseg.training.photo_faults import add_clutter, light_unevenly, spoil, tint_leaves

MEAN_COLOR = (124, 116, 104)  # definition: RGB; what the detectors' normalisation maps to zero
MIN_INSTANCE_PX = 16  # chosen: smaller remains of an instance at the edge of a crop are noise

Target = dict[str, Tensor]


class AugmentedSamples(Dataset[tuple[Tensor, Target, int]]):
    """Samples by (epoch, index), augmented: (3, S, S) float32 photo in [0, 1], target as `make_target`, index.

    The same key gives the same bits in every process. Indices from len(samples) on are new plants, other ones in every
    epoch. Raises InputError on access, when a sample broke since it was checked; see `read_sample`.
    """

    def __init__(self, samples: SampleList, config: TrainConfig) -> None:
        self.samples = samples
        self.config = config
        self.backgrounds = list_backgrounds(config.backgrounds)

    def __len__(self) -> int:
        return len(self.samples) + self.config.new_plants

    def __getitem__(self, key: tuple[int, int]) -> tuple[Tensor, Target, int]:
        epoch, index = key
        seed, config = mix_seed(self.config.seed, epoch, index), self.config
        if index < len(self.samples):
            labelled = read_sample(self.samples.samples[index])
        else:
            labelled = render_new_plant(seed, config.image_size, self.backgrounds)
            config = replace(config, orientation="fixed", scale_range=(1.0, 1.0), recolor=False)
        return *augment(labelled, config, seed, backgrounds=self.backgrounds), index


def augment(
    labelled: LabelledPhoto,
    config: TrainConfig,
    seed: int,
    *,
    backgrounds: tuple[Path, ...] = (),
    is_padded: bool = True,
) -> tuple[Tensor, Target]:
    """Augment one sample as the config says; torch's global generator is left as it was.

    Ignored pixels are painted over with the mean colour first: the network can then learn neither a leaf nor background
    from them. Returns a (3, S, S) float32 photo in [0, 1] and its target, see `make_target`; not `is_padded`: S x S or
    less, no more than the scaled photo.
    """
    photo = labelled.photo.clone()
    photo[:, labelled.ignore] = torch.tensor(MEAN_COLOR, dtype=photo.dtype)[:, None]
    with torch.random.fork_rng(devices=[]):
        torch.default_generator.manual_seed(seed)
        if config.recolor:
            photo = recolor(photo, labelled.layers, draw_background(backgrounds, photo))
        photo, layers = orient(photo, labelled.layers, config.orientation)
        photo, layers = rescale(photo, layers, config, is_padded=is_padded)
        if happens(config.tint_probability):
            photo = tint_leaves(photo, layers)
        if happens(config.clutter_probability):
            photo, layers = add_clutter(photo, layers)
        if happens(config.light_probability):
            photo = light_unevenly(photo)
        photo = distort_color(config)(tv_tensors.Image(photo)).as_subclass(Tensor)
        if happens(config.fault_probability):
            photo = spoil(photo)
    return photo.float() / 255, make_target(layers, labelled.classes)


def happens(probability: float) -> bool:
    """Draw whether an event happens; probability 0 draws no number, so that old recipes stay reproducible."""
    return bool(probability) and float(torch.rand(())) < probability


def orient(photo: Tensor, layers: Tensor, orientation: Orientation) -> tuple[Tensor, Tensor]:
    """Mirror and rotate a photo and its layers together."""
    if orientation == "fixed":
        return photo, layers
    both = v2.RandomHorizontalFlip()(tv_tensors.Image(photo), tv_tensors.Mask(layers))
    turns = int(torch.randint(4, ())) if orientation == "any" else 0
    photo, layers = (torch.rot90(plain.as_subclass(Tensor), turns, (-2, -1)) for plain in both)
    return photo, layers


def rescale(photo: Tensor, layers: Tensor, config: TrainConfig, *, is_padded: bool = True) -> tuple[Tensor, Tensor]:
    """Scale by a random factor and take an S x S window at a random place; fill it, or take less, where the photo is
    smaller. Layers are resized with nearest-exact: plain nearest, which torchvision's transforms use, shifts a mask
    against its photo by up to half a pixel."""
    side = config.image_size
    low, high = (math.log(factor) for factor in config.scale_range)
    factor = math.exp(low + (high - low) * float(torch.rand(()))) * side / max(photo.shape[1:])
    size = [max(1, round(factor * length)) for length in photo.shape[1:]]
    photo = v2.functional.resize(photo, size, antialias=True)
    layers = functional.interpolate(layers[None].float(), size, mode="nearest-exact")[0].to(layers.dtype)
    free = [(side if is_padded else min(side, length)) - length for length in size]
    top, left = (int(torch.randint(min(0, length), max(0, length) + 1, ())) for length in free)
    around = [left, free[1] - left, top, free[0] - top]  # negative where the photo is cropped
    mean = torch.tensor(MEAN_COLOR, dtype=torch.int16)[:, None, None]
    photo = (functional.pad(photo.to(torch.int16) - mean, around) + mean).to(photo.dtype)
    return photo, functional.pad(layers, around)


def distort_color(config: TrainConfig) -> v2.Transform:
    """Colour jitter and blur, for uint8 photos."""
    strength = config.color_jitter
    jitter = v2.ColorJitter(strength, strength, strength, strength / 10)
    blur = v2.GaussianBlur(kernel_size=7, sigma=(0.1, 2.0))
    return v2.Compose([jitter, v2.RandomApply([blur], p=config.blur_probability)])


def make_target(layers: Tensor, classes: Tensor, min_pixels: int = MIN_INSTANCE_PX) -> Target:
    """The target of torchvision's detectors from layers (L, H, W) int, see `LabelledPhoto`, and classes (N,) int64.

    Returns "masks" (M, H, W) uint8, "labels" (M,) int64, "boxes" (M, 4) float32 xyxy, half-open, recomputed from the
    masks. M may be 0: instances of fewer than `min_pixels` are discarded.
    """
    areas = torch.bincount(layers.flatten(), minlength=len(classes) + 1)[1:]
    rows = (areas >= min_pixels).nonzero()[:, 0]
    masks = torch.zeros((len(rows), *layers.shape[1:]), dtype=torch.bool)
    for layer in layers:
        masks |= layer == rows[:, None, None] + 1
    boxes = masks_to_boxes(masks) + torch.tensor([0.0, 0, 1, 1])  # torchvision's end on the last pixel
    return {"boxes": boxes, "labels": classes[rows], "masks": masks.to(torch.uint8)}


# --- the order of an epoch


def order_epoch(num_samples: int, batch_size: int, *, seed: int, epoch: int) -> list[list[int]]:
    """The batches of an epoch, ceil(num_samples / batch_size) lists of batch_size sample indices: every sample once, in
    random order; the last batch is filled up from a second shuffle.

    (Dropping an incomplete batch would lose up to batch_size - 1 of a user's few photos; a smaller batch would not fit
    the learning rate.)
    """
    generator = torch.Generator().manual_seed(mix_seed(seed, epoch))
    num_batches = math.ceil(num_samples / batch_size)
    order: list[int] = []
    while len(order) < num_batches * batch_size:
        order += torch.randperm(num_samples, generator=generator).tolist()
    return [order[step * batch_size : (step + 1) * batch_size] for step in range(num_batches)]


def mix_seed(*values: int) -> int:
    """A seed below 2^63 that depends on all the values (>= 0) and their order, well mixed."""
    return int(np.random.SeedSequence(values).generate_state(1, np.uint64)[0]) & (2**63 - 1)
