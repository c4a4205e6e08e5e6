"""Mask R-CNNs for laptops: pyramids of 96 channels, anchors from 16 px on, light heads, a dilated mask head.

The parameter names are torchvision's. That the mask head is dilated cannot be seen in a state dict: build them here.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import torchvision
from torch import nn
from torchvision.models.detection import MaskRCNN
from torchvision.models.detection.anchor_utils import AnchorGenerator
from torchvision.models.detection.backbone_utils import BackboneWithFPN
from torchvision.models.detection.faster_rcnn import FastRCNNPredictor, TwoMLPHead
from torchvision.models.detection.mask_rcnn import MaskRCNNHeads, MaskRCNNPredictor
from torchvision.ops import MultiScaleRoIAlign

from mvseg.detectors.efficientnet_lite import LEVELS, LITE_SCALES, PIXEL_MEAN, PIXEL_STD, build_lite

CHANNELS = 96  # chosen: of the feature pyramid
BOX_FEATURES = 512  # chosen: of the box head
IMAGE_SIZE = 512  # chosen: longer side of a photo, pixels
MASK_DILATIONS = (1, 2, 4, 1)  # chosen: of the convolutions of the mask head
# architecture -> torchvision's classifier that its pyramid stands on
SMALL_BACKBONES = {"resnet18_fpn": "resnet18", "mobilenet_v3_large_fpn": "mobilenet_v3_large"}
SMALL_ARCHITECTURES = (*SMALL_BACKBONES, *LITE_SCALES)


def build_small(arch: str, num_classes: int, backbone_weights: str | None = None) -> MaskRCNN:
    """Build one of `SMALL_ARCHITECTURES` with batch norms, as torchvision's classifiers have them; levels "0" to "3"
    and "pool" (strides 4 to 64). `num_classes` counts the background; `backbone_weights` is a name of weights of
    torchvision's classifier, to be downloaded; None: random."""
    if arch in LITE_SCALES:
        # group norm: the published weights give features with a standard deviation of 3 to 8, too large for the heads
        norm = partial(nn.GroupNorm, CHANNELS // 16)
        lite, channels = build_lite(arch)
        pyramid = BackboneWithFPN(lite, LEVELS, channels, CHANNELS, norm_layer=norm)
        return add_light_heads(pyramid, num_classes, image_mean=PIXEL_MEAN, image_std=PIXEL_STD)
    classifier = torchvision.models.get_model(SMALL_BACKBONES[arch], weights=backbone_weights)
    if arch == "resnet18_fpn":
        body, levels, channels = classifier, {f"layer{k + 1}": str(k) for k in range(4)}, [64, 128, 256, 512]
    else:
        # the last block at each of the strides 4, 8, 16, 32
        body, levels, channels = classifier.features, {"3": "0", "6": "1", "12": "2", "16": "3"}, [24, 40, 112, 960]
    return add_light_heads(BackboneWithFPN(body, levels, channels, CHANNELS), num_classes)


def add_light_heads(backbone: nn.Module, num_classes: int, **options: Any) -> MaskRCNN:
    """Mask R-CNN with light heads on a pyramid of 96 channels; `options` go to torchvision's `MaskRCNN`."""
    names = ["0", "1", "2", "3"]
    return MaskRCNN(
        backbone,
        min_size=IMAGE_SIZE,
        max_size=IMAGE_SIZE,
        rpn_anchor_generator=AnchorGenerator(((16,), (32,), (64,), (128,), (256,)), ((0.5, 1.0, 2.0),) * 5),
        rpn_pre_nms_top_n_train=500,
        rpn_post_nms_top_n_train=300,
        rpn_pre_nms_top_n_test=500,
        rpn_post_nms_top_n_test=300,
        box_roi_pool=MultiScaleRoIAlign(names, output_size=7, sampling_ratio=2),
        box_head=TwoMLPHead(CHANNELS * 7 * 7, BOX_FEATURES),
        box_predictor=FastRCNNPredictor(BOX_FEATURES, num_classes),
        box_batch_size_per_image=96,  # a third of them learn masks, the slowest part to learn
        box_positive_fraction=1 / 3,
        mask_roi_pool=MultiScaleRoIAlign(names, output_size=14, sampling_ratio=2),
        mask_head=build_mask_head(CHANNELS),
        mask_predictor=MaskRCNNPredictor(CHANNELS, CHANNELS, num_classes),
        **options,
    )


def build_mask_head(channels: int) -> MaskRCNNHeads:
    """torchvision's four convolutions, dilated: a pixel of the (D, channels, 14, 14) crops sees 17 x 17, not 9 x 9. A
    box around a thin slanted leaf holds more of other leaves than of its own; which leaf reaches all four of its sides
    can only be seen from afar."""
    head = MaskRCNNHeads(channels, (channels,) * len(MASK_DILATIONS), 1)
    for layer, dilation in zip(head, MASK_DILATIONS, strict=True):
        layer[0].dilation = layer[0].padding = (dilation, dilation)
    return head
