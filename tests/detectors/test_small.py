"""The small detectors: their size, what they train, what their mask heads see."""

from __future__ import annotations

import pytest
import torch
from torch import nn

from mvseg.detectors.mask_rcnn import build_detector, count_parameters
from mvseg.detectors.small import build_mask_head


@pytest.mark.parametrize(
    ("arch", "millions"),
    [("resnet18_fpn", 14.7), ("mobilenet_v3_large_fpn", 6.5), ("efficientnet_lite0", 6.4), ("efficientnet_lite2", 7.8)],
)
def test_small_detectors(arch: str, millions: float) -> None:
    torch.manual_seed(0)
    model = build_detector(arch, 3, image_size=64)
    assert count_parameters(model) / 1e6 == pytest.approx(millions, abs=0.1)
    assert (model.training, model.transform.min_size, model.transform.max_size) == (True, (64,), 64)
    box = torch.tensor([[10.0, 10.0, 40.0, 50.0]])
    target = {"boxes": box, "labels": torch.tensor([2]), "masks": torch.ones((1, 64, 64), dtype=torch.uint8)}
    empty = {"boxes": box[:0], "labels": torch.zeros(0, dtype=torch.int64), "masks": target["masks"][:0]}
    losses = model([torch.rand(3, 64, 64)] * 2, [target, empty])
    assert all(torch.isfinite(loss) for loss in losses.values())
    sum(losses.values()).backward()
    assert all(parameter.grad is not None for parameter in model.parameters())  # none unused: DDP would wait for it
    strides = [64 // level.shape[-1] for level in model.backbone(torch.rand(1, 3, 64, 64)).values()]
    assert strides == [4, 8, 16, 32, 64]


def test_the_middle_of_a_box_sees_all_of_it() -> None:
    head = build_mask_head(2)
    for parameter in head.parameters():
        nn.init.ones_(parameter)
    crop = torch.ones((1, 2, 14, 14), requires_grad=True)
    features = head(crop)
    assert features.shape == crop.shape
    features[0, 0, 7, 7].backward()
    assert crop.grad is not None
    assert bool((crop.grad > 0).all())
