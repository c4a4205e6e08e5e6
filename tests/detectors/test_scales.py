"""Several scales of one photo: what agrees, by laws and against pasted masks."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor
from torchvision.models.detection.roi_heads import paste_masks_in_image

from mvseg.detectors.run import run_heads
from mvseg.detectors.scales import agree, mask_iou, run_scales
from tiny_training import build_tiny


@pytest.fixture
def photo() -> Tensor:
    return torch.rand((3, 50, 90), generator=torch.Generator().manual_seed(1))


@pytest.fixture
def model() -> torch.nn.Module:
    model = build_tiny().eval()
    model.transform.min_size, model.transform.max_size = (64,), 64
    return model


def smooth_masks(count: int, seed: int = 0) -> tuple[Tensor, Tensor]:
    """Boxes in a frame of 100 x 80 and masks without small parts."""
    generator = torch.Generator().manual_seed(seed)
    start = torch.rand((count, 2), generator=generator) * 30
    boxes = torch.cat((start, start + 20 + torch.rand((count, 2), generator=generator) * 25), 1)
    rough = torch.rand((count, 1, 3, 3), generator=generator)
    return boxes, torch.nn.functional.interpolate(rough, (28, 28), mode="bilinear")


@torch.no_grad()
def test_the_one_scale_of_the_model_is_the_model(model: torch.nn.Module, photo: Tensor) -> None:
    expected = run_heads(model, photo, nms_thresh=0.7)
    for key, value in run_scales(model, photo, (1.0,), nms_thresh=0.7).items():
        assert torch.equal(value, expected[key])


@torch.no_grad()
def test_boxes_of_all_scales_come_in_one_frame(model: torch.nn.Module, photo: Tensor) -> None:
    seen: list[tuple[int, int]] = []
    model.backbone.register_forward_hook(lambda module, inputs, output: seen.append(tuple(inputs[0].shape[-2:])))
    found = run_scales(model, photo, (0.5, 1.0, 2.0))
    assert seen == [(32, 32), (64, 64), (96, 128)]  # padded to multiples of 32
    assert found["frame"].tolist() == run_heads(model, photo)["frame"].tolist() == [64, 35]
    assert found["boxes"][:, 2].max() <= 64
    assert found["boxes"][:, 3].max() <= 35
    assert list(found) == ["boxes", "labels", "scores", "masks", "frame"]
    assert bool((found["scores"].diff() <= 1e-5).all())


@torch.no_grad()
def test_the_order_of_the_scales_means_nothing(model: torch.nn.Module, photo: Tensor) -> None:
    found, turned = (run_scales(model, photo, scales) for scales in ((0.7, 1.0, 1.4), (1.4, 0.7, 1.0)))
    for key, value in found.items():
        torch.testing.assert_close(turned[key], value)


@torch.no_grad()
def test_limits_hold_for_all_scales_together(model: torch.nn.Module, photo: Tensor) -> None:
    assert len(run_scales(model, photo, (1.0, 1.4), detections_per_img=2)["scores"]) == 2
    few, many = (len(run_scales(model, photo, (1.0, 1.4), nms_thresh=iou)["scores"]) for iou in (0.1, 0.9))
    assert few < many
    model.rpn.score_thresh = 1.0
    assert len(run_scales(model, photo, (1.0, 1.4))["scores"]) == 0


def test_masks_are_surer_where_scales_agree() -> None:
    box, other = [10.0, 10.0, 30.0, 40.0], [11.0, 10.0, 31.0, 41.0]
    far, upper = [60.0, 10.0, 80.0, 40.0], torch.zeros(1, 28, 28)
    upper[:, :10] = 1
    whole = torch.ones(1, 28, 28)
    detections = {
        "boxes": torch.tensor([box, other, box, far, other, other]),
        "labels": torch.tensor([1, 1, 1, 1, 2, 1]),
        "scores": torch.tensor([0.9, 0.6, 0.3, 0.8, 0.5, 0.2]),
        "masks": torch.stack([whole, whole, whole, whole, whole, upper]),
        "scale": torch.tensor([0, 1, 2, 1, 1, 2]),
        "is_plain": torch.ones(6, dtype=torch.bool),
    }
    expected = torch.tensor([0.9 + 0.6 + 0.3, 0.9 + 0.6 + 0.3, 0.9 + 0.6 + 0.3, 0.8, 0.5, 0.2]).double()
    for num_scales in (3, 4):
        torch.testing.assert_close(agree(detections, num_scales=num_scales), expected / num_scales)
    detections["is_plain"][0] = False
    without = torch.tensor([0.9 + 0.6 + 0.3, 0.6 + 0.3, 0.6 + 0.3, 0.8, 0.5, 0.2]).double()
    torch.testing.assert_close(agree(detections, num_scales=3), without / 3)


def test_of_two_masks_of_one_scale_the_better_one_counts() -> None:
    detections = {
        "boxes": torch.tensor([[10.0, 10.0, 30.0, 40.0]] * 3),
        "labels": torch.ones(3, dtype=torch.int64),
        "scores": torch.tensor([0.4, 0.9, 0.7]),
        "masks": torch.ones(3, 1, 28, 28),
        "scale": torch.tensor([0, 1, 1]),
        "is_plain": torch.ones(3, dtype=torch.bool),
    }
    torch.testing.assert_close(agree(detections, num_scales=2), torch.tensor([0.65, 0.65, 0.55]).double())


def test_iou_is_that_of_pasted_masks() -> None:
    boxes, masks = smooth_masks(14)
    pairs = torch.combinations(torch.arange(14))
    pasted = paste_masks_in_image(masks, boxes * 4, (320, 400))[:, 0] > 0.5
    first, second = pasted[pairs[:, 0]], pasted[pairs[:, 1]]
    expected = (first & second).sum((1, 2)) / (first | second).sum((1, 2)).clamp(min=1)
    assert expected.max() > 0.4
    torch.testing.assert_close(mask_iou(boxes, masks, pairs), expected, atol=0.05, rtol=0)
    assert mask_iou(boxes, masks, pairs[:0]).shape == (0,)
