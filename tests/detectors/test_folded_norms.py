"""A detector whose norms are folded into its convolutions finds what it found, in fewer steps."""

from __future__ import annotations

import copy

import pytest
import torch
from torch import nn
from torchvision.ops import FrozenBatchNorm2d

from mvseg.detectors.folded_norms import fold_norms
from mvseg.detectors.mask_rcnn import build_bare, replace_batch_norm


def count_norms(model: nn.Module) -> int:
    return sum(isinstance(module, FrozenBatchNorm2d) for module in model.modules())


@pytest.mark.parametrize("arch", ["efficientnet_lite0", "mobilenet_v3_large_fpn", "resnet18_fpn"])
def test_features_stay(arch: str) -> None:
    torch.manual_seed(0)
    model = build_bare(arch, 2)
    for name, value in model.state_dict().items():
        if name.endswith("running_mean"):
            value.normal_(0, 0.1)
        elif name.endswith("running_var"):
            value.uniform_(0.5, 1.5)
    model = replace_batch_norm(model, frozen=True).eval()
    folded = fold_norms(copy.deepcopy(model))
    for size in ((64, 96), (97, 51)):
        photos = torch.rand(1, 3, *size)
        with torch.no_grad():
            expected, found = model.backbone(photos), folded.backbone(photos)
        for level, features in expected.items():
            torch.testing.assert_close(found[level], features, rtol=1e-3, atol=1e-3 * float(features.abs().max()))
    assert count_norms(folded) < count_norms(model)
    assert count_norms(folded) == 0 or arch == "resnet18_fpn"  # whose blocks are no sequences


def test_only_a_norm_right_after_its_convolution_is_folded() -> None:
    norm = FrozenBatchNorm2d(4)
    norm.bias.fill_(1.0)
    chain = nn.Sequential(nn.Conv2d(3, 4, 1), nn.ReLU(), norm, nn.Conv2d(4, 4, 1)).eval()
    folded, photo = fold_norms(copy.deepcopy(chain)), torch.randn(1, 3, 5, 5)
    assert isinstance(folded[2], FrozenBatchNorm2d)
    torch.testing.assert_close(folded(photo), chain(photo))
