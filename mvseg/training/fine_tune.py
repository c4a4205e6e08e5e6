"""A detector learns the plant at hand: some steps on labels in memory, no files, no validation.

It sees the photos as it will look at them: the same parts, at the same size. Samples are not padded, and the first
layers stay as they are, so that a step costs half of one of `train`.
"""

from __future__ import annotations

import copy
import itertools
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional
from torchvision.models.detection.generalized_rcnn import GeneralizedRCNN

from mvseg.detectors.efficientnet_lite import FROZEN
from mvseg.detectors.folded_norms import fold_norms
from mvseg.errors import InputError
from mvseg.evaluation.labelled_photo import LabelledPhoto
from mvseg.formats.photos import ReadPhoto
from mvseg.system.running import progress_bar
from mvseg.training.augmentation import Target, augment, mix_seed, order_epoch
from mvseg.training.config import TrainConfig
from mvseg.training.state import TrainingState, apply_gradients, build_optimizer, learning_rate
from mvseg.training.view_labels import ViewLabels

STEPS = 40  # chosen: steps of a round, of two samples each
RECIPE = TrainConfig(
    output=Path(),  # no path is used
    from_results=Path(),
    orientation="upright",
    scale_range=(0.5, 1.3),
    batch_size=2,
    images_per_forward=1,
    lr=2e-4,
    warmup_steps=10,
)
# Edges and colours, which all photos have. With the whole backbone as it is, most of the gain is lost: mask AP of a
# close-up of another species, after 40 steps, 0.479 -> 0.481, and 0.568 with these layers alone (lobed-187 of
# `benchmarks/unruly_plants.py`, single photos at 384 px).
FIRST_LAYERS = tuple(f"body.{name}" for name in FROZEN)
IGNORED = 0  # definition: class of the ignored pixels, which pass the augmentation as if they were an instance
SPARED = 0.25  # chosen: a box with a larger share of ignored pixels is no example of background


def fine_tune(
    detector: GeneralizedRCNN,
    photos: ReadPhoto,
    labels: ViewLabels,
    *,
    boxes: Tensor,
    num_steps: int = STEPS,
    seed: int = 0,
) -> GeneralizedRCNN:
    """The detector after it has learned the leaves of some photos, in eval mode, on the same device.

    Ignored pixels teach nothing: an anchor or a proposal that shows many of them (`SPARED`) is no example of
    background. The mask head learns from labels alone. Deterministic for a seed, on one processor with as many threads.
    torch's global generators are left as they were.

    Args:
        detector: any torchvision Mask R-CNN whose norms do not look at the batch, as `load_detector` gives it (norms
            not folded); it stays as it is.
        labels: of these views; views without a label teach nothing.
        boxes: (V, 4) int64 xyxy, the parts of the photos that the detector will look at. It learns at the size that its
            transform gives them.
        seed: of the order of the samples, their augmentation, and the samplers of the losses.

    Raises:
        InputError: no labels; a gradient that is not finite.
    """
    samples = gather_samples(detector, photos, labels, boxes=boxes)
    if not samples:
        raise InputError("no photo has a label, expected some to learn from")
    learner = prepare(detector)
    spared, device = SparedBoxes(learner), next(learner.parameters()).device
    state, keys = TrainingState(learner, build_optimizer(RECIPE, learner), None), _order(len(samples), seed)
    with torch.enable_grad(), torch.random.fork_rng(devices=[device] if device.type == "cuda" else []):
        for step in progress_bar(range(num_steps), name="learning", unit="step"):
            state.optimizer.zero_grad()
            for key in itertools.islice(keys, RECIPE.batch_size):
                photo, target, ignored = draw_sample(*samples[key[1]], seed=mix_seed(seed, *key))
                spared.look_at(ignored.to(device))
                torch.manual_seed(mix_seed(seed, *key, step))  # torchvision samples anchors and RoIs at random
                losses = learner([photo.to(device)], [{name: each.to(device) for name, each in target.items()}])
                (torch.stack([*losses.values()]).sum() / RECIPE.batch_size).backward()
            if not apply_gradients(RECIPE, state, learning_rate(RECIPE, step, num_steps)):
                raise InputError(f"learning from the views: the gradient of step {step + 1} is not finite")
    learned = copy.deepcopy(detector)
    trained = {name: each for name, each in learner.named_parameters() if each.requires_grad}
    learned.load_state_dict(trained, strict=False)
    return learned.eval()


def prepare(detector: GeneralizedRCNN) -> GeneralizedRCNN:
    """A copy, in train mode, that takes samples at the size that they have, and whose first layers stay."""
    learner = copy.deepcopy(detector).eval()
    for name, layers in learner.backbone.named_modules():
        if name in FIRST_LAYERS:
            fold_norms(layers.requires_grad_(False))
    learner.transform.resize = lambda photo, target: (photo, target)
    return learner.to(memory_format=torch.channels_last).train()


def gather_samples(
    detector: GeneralizedRCNN, photos: ReadPhoto, labels: ViewLabels, *, boxes: Tensor
) -> list[tuple[LabelledPhoto, int]]:
    """The parts of the photos that have a label, at the largest size that they are learned at, and the longer side,
    pixels, at which the detector sees each."""
    samples = []
    for view in labels.leaves.view_index.unique().tolist():
        x1, y1, x2, y2 = boxes[view].tolist()
        side = max(detector.transform.resize(torch.zeros(1, y2 - y1, x2 - x1))[0].shape)
        scale = min(1.0, RECIPE.scale_range[1] * side / max(x2 - x1, y2 - y1))
        size = (max(1, round(scale * (y2 - y1))), max(1, round(scale * (x2 - x1))))
        labelled = labels.in_photo(view, photos(view), (x1, y1, x2, y2), size=size)
        if len(labelled.classes):
            samples.append((labelled, side))
    return samples


def _order(num_samples: int, seed: int) -> Iterator[tuple[int, int]]:
    for epoch in itertools.count():
        for batch in order_epoch(num_samples, num_samples, seed=seed, epoch=epoch):
            yield from ((epoch, index) for index in batch)


def draw_sample(labelled: LabelledPhoto, side: int, *, seed: int) -> tuple[Tensor, Target, Tensor]:
    """A sample, augmented: (3, h, w) float32 photo in [0, 1], its target, and the ignored pixels (h, w) bool."""
    ignore, number = labelled.ignore, len(labelled.classes) + 1
    with_ignored = replace(
        labelled,
        layers=torch.cat((labelled.layers, number * ignore[None].to(labelled.layers.dtype))),
        classes=torch.cat((labelled.classes, torch.tensor([IGNORED]))),
        ignore=torch.zeros_like(ignore),  # these would be painted over
    )
    photo, target = augment(with_ignored, replace(RECIPE, image_size=side), seed, is_padded=False)
    is_leaf = target["labels"] != IGNORED
    ignored = target["masks"][~is_leaf].any(0)
    return photo, {name: each[is_leaf] for name, each in target.items()}, ignored


class SparedBoxes:
    """Makes boxes that show ignored pixels count neither as leaves nor as background, in torchvision's losses."""

    def __init__(self, learner: GeneralizedRCNN) -> None:
        self._sums = torch.zeros(1, 1)
        _wrap(learner.rpn, "assign_targets_to_anchors", partial(self._spare, 0))
        _wrap(learner.roi_heads, "assign_targets_to_proposals", partial(self._spare, 1))

    def look_at(self, ignored: Tensor) -> None:
        """The next forward pass is about a photo with these ignored pixels (h, w) bool."""
        self._sums = functional.pad(ignored.float().cumsum(0).cumsum(1), (1, 0, 1, 0))

    def _spare(self, place: int, assign: Callable[..., tuple[Any, Any]], boxes: list[Tensor], *truth: Any) -> Any:
        answer = assign(boxes, *truth)
        for own, boxes_of_photo in zip(answer[place], boxes, strict=True):
            own[(own == 0) & (self.shares(boxes_of_photo) > SPARED)] = -1  # what the samplers of the losses leave out
        return answer

    def shares(self, boxes: Tensor) -> Tensor:
        """(R,) the share of ignored pixels in boxes (R, 4) xyxy, within the photo."""
        height, width = self._sums.shape
        limit = torch.tensor([width - 1, height - 1] * 2, device=boxes.device)
        x1, y1, x2, y2 = torch.minimum(boxes.round().long().clamp(min=0), limit).T
        inside = self._sums[y2, x2] - self._sums[y1, x2] - self._sums[y2, x1] + self._sums[y1, x1]
        return inside / ((x2 - x1) * (y2 - y1)).clamp(min=1)


def _wrap(part: nn.Module, name: str, around: Callable[..., Any]) -> None:
    setattr(part, name, partial(around, getattr(part, name)))
