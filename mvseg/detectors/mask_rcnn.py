"""Mask R-CNN detectors by name: torchvision's builders and two small ones for laptops, with or without weights.

Normalisation never looks at the batch, because detectors are fine-tuned with two or four images at a time, on any
number of processes: a detector from nothing gets group normalisation in place of torchvision's batch normalisation; a
detector with weights keeps the statistics it was trained with, frozen. The epsilon of frozen statistics is folded into
`running_var` (so it is 0 in every detector built here), which makes a saved state dict complete by itself.

The parameter names are torchvision's: state dicts of its builders load here, and those saved here load there as far as
the norms agree. The small detectors have dilated mask heads, which a state dict does not tell: build them here.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
import torchvision
from safetensors import safe_open
from torch import Tensor, nn
from torchvision.models.detection import MaskRCNN
from torchvision.models.detection.anchor_utils import AnchorGenerator
from torchvision.models.detection.backbone_utils import BackboneWithFPN
from torchvision.models.detection.faster_rcnn import FastRCNNPredictor, TwoMLPHead
from torchvision.models.detection.mask_rcnn import MaskRCNNHeads, MaskRCNNPredictor
from torchvision.ops import FrozenBatchNorm2d, MultiScaleRoIAlign

from mvseg.errors import InputError

SMALL_CHANNELS = 96
SMALL_BOX_FEATURES = 512
SMALL_IMAGE_SIZE = 512
MASK_DILATIONS = (1, 2, 4, 1)
GROUP_CHANNELS = 16  # channels of one group: what Wu and He, "Group Normalization", table 3, found best


def list_architectures() -> tuple[str, ...]:
    """Names that `build_detector` takes: the small ones, then every Mask R-CNN builder of the installed torchvision."""
    builders = torchvision.models.list_models(module=torchvision.models.detection, include="maskrcnn_*")
    return (*SMALL_BACKBONES, *builders)


def build_detector(
    arch: str, num_classes: int, weights: str | None = None, *, image_size: int | None = None
) -> MaskRCNN:
    """A torchvision Mask R-CNN, in train mode, on the CPU.

    Args:
        arch: one of `list_architectures()`. "resnet18_fpn" (14.7 M parameters) and "mobilenet_v3_large_fpn" (6.6 M)
            have pyramids of 96 channels, anchors from 16 px on, and light heads.
        num_classes: classes with the background, >= 2. Where the weights were made for another number, the box and mask
            predictors are replaced by fresh ones and everything else is kept.
        weights: None: random, drawn from torch's global generator. A name that torchvision has for this builder
            ("COCO_V1", "DEFAULT"; for the small ones a name of their backbone's weights, "IMAGENET1K_V1"): downloaded
            into torch's cache, the only case that uses the network. Anything else: a file, either .safetensors or a
            checkpoint that `torch.load(weights_only=True)` reads (a state dict, or one under "ema" or "model").
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
    elif weights in list_weight_names(arch):
        model = build_downloaded(arch, weights)
    else:
        model, metadata = build_from_file(arch, Path(weights))
        image_size = image_size or (int(metadata["image_size"]) if "image_size" in metadata else None)
    if model.roi_heads.box_predictor.cls_score.out_features != num_classes:
        replace_predictors(model, num_classes)
    if image_size is not None:
        model.transform.min_size, model.transform.max_size = (image_size,), image_size
    return model


def list_weight_names(arch: str) -> tuple[str, ...]:
    """Names of torchvision's weights for an architecture (of its backbone, for the small ones)."""
    return tuple(torchvision.models.get_model_weights(SMALL_BACKBONES.get(arch, arch)).__members__)


def build_bare(arch: str, num_classes: int, backbone_weights: str | None = None) -> MaskRCNN:
    """The architecture with torchvision's own batch normalisation; nothing is downloaded unless a name is given."""
    if arch not in SMALL_BACKBONES:
        return torchvision.models.get_model(arch, weights=None, weights_backbone=None, num_classes=num_classes)
    backbone = torchvision.models.get_model(SMALL_BACKBONES[arch], weights=backbone_weights)
    if arch == "resnet18_fpn":
        levels, channels = {f"layer{k + 1}": str(k) for k in range(4)}, [64, 128, 256, 512]
    else:
        # the last block at each of the strides 4, 8, 16, 32
        backbone, levels, channels = backbone.features, {"3": "0", "6": "1", "12": "2", "16": "3"}, [24, 40, 112, 960]
    return build_small(BackboneWithFPN(backbone, levels, channels, SMALL_CHANNELS), num_classes)


def build_small(backbone: nn.Module, num_classes: int) -> MaskRCNN:
    """Mask R-CNN with light heads, the mask head dilated, on levels "0" to "3" and "pool" (strides 4 to 64)."""
    channels = backbone.out_channels
    assert isinstance(channels, int)
    names = ["0", "1", "2", "3"]
    box_pool = MultiScaleRoIAlign(names, output_size=7, sampling_ratio=2)
    return MaskRCNN(
        backbone,
        min_size=SMALL_IMAGE_SIZE,
        max_size=SMALL_IMAGE_SIZE,
        rpn_anchor_generator=AnchorGenerator(
            sizes=((16,), (32,), (64,), (128,), (256,)), aspect_ratios=((0.5, 1.0, 2.0),) * 5
        ),
        rpn_pre_nms_top_n_train=500,
        rpn_post_nms_top_n_train=300,
        rpn_pre_nms_top_n_test=500,
        rpn_post_nms_top_n_test=300,
        box_roi_pool=box_pool,
        box_head=TwoMLPHead(channels * 7 * 7, SMALL_BOX_FEATURES),
        box_predictor=FastRCNNPredictor(SMALL_BOX_FEATURES, num_classes),
        box_batch_size_per_image=96,  # a third of them learn masks, the slowest part to learn
        box_positive_fraction=1 / 3,
        mask_roi_pool=MultiScaleRoIAlign(names, output_size=14, sampling_ratio=2),
        mask_head=build_mask_head(channels),
        mask_predictor=MaskRCNNPredictor(channels, channels, num_classes),
    )


def build_mask_head(channels: int) -> MaskRCNNHeads:
    """torchvision's four convolutions, dilated: a pixel of the (D, channels, 14, 14) crops sees 17 x 17, not 9 x 9.

    A box around a thin slanted leaf holds more of other leaves than of its own; which leaf reaches all four of its
    sides can only be seen from afar.
    """
    head = MaskRCNNHeads(channels, (channels,) * len(MASK_DILATIONS), 1)
    for layer, dilation in zip(head, MASK_DILATIONS, strict=True):
        layer[0].dilation = layer[0].padding = (dilation, dilation)
    return head


def build_downloaded(arch: str, name: str) -> MaskRCNN:
    """The architecture with torchvision's weights of that name (first backbone layers frozen, as torchvision does)."""
    try:
        if arch in SMALL_BACKBONES:
            model = build_bare(arch, 2, backbone_weights=name)
        else:
            model = torchvision.models.get_model(arch, weights=name)
    except OSError as error:  # URLError included
        raise InputError(
            f"weights '{name}' of {arch} could not be downloaded ({error}); fetch the file elsewhere and give its path"
        ) from error
    return replace_batch_norm(model, frozen=True)


def build_from_file(arch: str, path: Path) -> tuple[MaskRCNN, Mapping[str, str]]:
    """The architecture with a file's weights, number of classes and kind of norm, and the file's metadata."""
    state, metadata = read_weights(path)
    if metadata.get("arch", arch) != arch:
        raise InputError(f"{path} holds a {metadata['arch']}, not the {arch} that was asked for")
    classes = state.get("roi_heads.box_predictor.cls_score.bias")
    if classes is None:
        raise InputError(f"{path} is not a Mask R-CNN: it has no roi_heads.box_predictor.cls_score.bias")
    model = build_bare(arch, len(classes))
    is_batch_norm = any(key.endswith("num_batches_tracked") for key in state)
    if not is_batch_norm:
        has_statistics = any(key.endswith("running_mean") for key in state)
        model = replace_batch_norm(model, frozen=has_statistics)
    load_weights(model, state, path, arch)
    return (replace_batch_norm(model, frozen=True) if is_batch_norm else model), metadata


def read_weights(path: Path) -> tuple[dict[str, Tensor], Mapping[str, str]]:
    """State dict and metadata of a weights file; nothing in the file is executed.

    Raises:
        InputError: no such file, or it is neither safetensors nor a checkpoint of tensors.
    """
    if not path.is_file():
        raise InputError(f"weights '{path}' are neither a file nor a name that torchvision has for this architecture")
    try:
        if path.suffix == ".safetensors":
            with safe_open(path, framework="pt") as file:
                return {key: file.get_tensor(key) for key in file.keys()}, file.metadata() or {}  # noqa: SIM118
        content = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # a damaged file may raise anything in torch.load
        raise InputError(f"{path} cannot be read as weights ({first_line(error)})") from error
    if isinstance(content, dict):
        content = content.get("ema") or content.get("model") or content
    if not isinstance(content, dict) or not all(isinstance(value, Tensor) for value in content.values()):
        raise InputError(f"{path} holds no state dict, expected one, or one under 'ema' or 'model'")
    return content, {}


def load_weights(model: nn.Module, state: Mapping[str, Tensor], path: Path, arch: str) -> None:
    """Load a state dict that must fit exactly.

    Raises:
        InputError: a missing, unknown or differently shaped parameter; the message names the first one.
    """
    try:
        keys = model.load_state_dict(dict(state), strict=False)
    except RuntimeError as error:
        detail = str(error).splitlines()[1].strip() if "\n" in str(error) else str(error)
        raise InputError(f"{path} does not fit {arch}: {detail}") from error
    for kind, names in (("lacks", keys.missing_keys), ("has the unknown", keys.unexpected_keys)):
        if names:
            raise InputError(f"{path} does not fit {arch}: it {kind} {names[0]} (and {len(names) - 1} more)")


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
    return nn.GroupNorm(num_channels // math.gcd(num_channels, GROUP_CHANNELS), num_channels)


def freeze_norm(norm: Any) -> nn.Module:
    fixed = FrozenBatchNorm2d(len(norm.weight), eps=0.0)
    state = norm.state_dict()
    fixed.load_state_dict({**state, "running_var": state["running_var"] + norm.eps})
    return fixed


def count_parameters(model: nn.Module) -> int:
    """Number of parameters, frozen ones included."""
    return sum(parameter.numel() for parameter in model.parameters())


def describe_detector(arch: str, categories: tuple[str, ...], image_size: int) -> dict[str, str]:
    """The metadata that `build_detector` and its users find in a .safetensors file; `categories` without background."""
    return {"arch": arch, "categories": json.dumps(categories), "image_size": str(image_size)}


def first_line(error: BaseException) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0]


# architecture -> torchvision's classifier that its pyramid stands on
SMALL_BACKBONES = {"resnet18_fpn": "resnet18", "mobilenet_v3_large_fpn": "mobilenet_v3_large"}
