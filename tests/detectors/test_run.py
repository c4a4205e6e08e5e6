"""The unrolled forward pass against torchvision's own."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor
from torchvision.models.detection.roi_heads import maskrcnn_inference
from torchvision.models.detection.transform import GeneralizedRCNNTransform

from mvseg.detectors.mask_cut import decide_masks
from mvseg.detectors.run import GROWTH, detect, grow_boxes, normalize, run_heads
from mvseg.evaluation.average_precision import annotate_detections
from tiny_training import build_tiny

WIDTH, HEIGHT = 90, 50


@pytest.fixture
def photo() -> Tensor:
    return torch.rand((3, HEIGHT, WIDTH), generator=torch.Generator().manual_seed(1))


@pytest.fixture
def model() -> torch.nn.Module:
    model = build_tiny().eval()
    model.transform.min_size, model.transform.max_size = (64,), 64
    return model


@torch.no_grad()
def test_detect_is_the_models_own_forward_pass_with_decided_masks(
    model: torch.nn.Module, photo: Tensor, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("mvseg.detectors.run.decide_masks", lambda found: found)
    (expected,) = model([photo])
    ours, masks = detect(model, photo)
    assert len(expected["scores"]) > 3
    torch.testing.assert_close({**ours, "masks": torch.stack(list(masks))[:, None]}, expected)


@torch.no_grad()
def test_masks_are_decided_and_boxes_stay_in_the_frame_of_the_transform(model: torch.nn.Module, photo: Tensor) -> None:
    found = run_heads(model, photo)
    assert found["frame"].tolist() == [64, 35]
    assert found["boxes"][:, 2].max() <= 64
    assert found["boxes"][:, 3].max() <= 35
    resized, _ = model.transform([photo])
    features = {"0": model.backbone(resized.tensors)}
    proposals, _ = model.rpn(resized, features)
    expected = decide_masks(model.roi_heads(features, proposals, resized.image_sizes)[0][0])
    for key, value in expected.items():
        assert torch.equal(found[key], value)


@torch.no_grad()
def test_other_thresholds_for_one_call_only(model: torch.nn.Module, photo: Tensor) -> None:
    heads = model.roi_heads
    heads.nms_thresh = 0.2
    before = len(run_heads(model, photo)["scores"])
    assert len(run_heads(model, photo, nms_thresh=0.9)["scores"]) > before
    assert len(run_heads(model, photo, detections_per_img=2)["scores"]) == 2 < before
    assert (heads.nms_thresh, heads.detections_per_img) == (0.2, 100)
    assert len(run_heads(model, photo)["scores"]) == before


def test_a_box_grows_where_its_mask_touches_it() -> None:
    """And only there, within the frame: a mask in the middle, one at the left side, one at the bottom of the frame."""
    masks = torch.full((3, 1, 8, 8), 0.01)
    masks[0, 0, 2:6, 2:6] = masks[1, 0, 2:6, :6] = masks[2, 0, 2:, 2:6] = 0.99
    boxes = torch.tensor([[20.0, 20.0, 40.0, 30.0]] * 2 + [[20.0, 20.0, 40.0, 49.0]])
    grown = grow_boxes(boxes, masks, (90, 50))
    boxes[1, 0], boxes[2, 3] = 20 - GROWTH * 20, 50
    torch.testing.assert_close(grown, boxes)


@torch.no_grad()
def test_the_mask_head_looks_again_in_boxes_that_grow(model: torch.nn.Module, photo: Tensor) -> None:
    model.roi_heads.nms_thresh = 1.0
    plain, found = (run_heads(model, photo, num_growths=number) for number in (0, 1))
    width, height = plain["frame"].tolist()
    grown = grow_boxes(plain["boxes"], plain["masks"], (width, height))
    assert (grown != plain["boxes"]).any()
    assert torch.equal(found["boxes"], grown)
    resized, _ = model.transform([photo])
    features, heads = {"0": model.backbone(resized.tensors)}, model.roi_heads
    pooled = heads.mask_roi_pool(features, [grown], resized.image_sizes)
    masks = maskrcnn_inference(heads.mask_predictor(heads.mask_head(pooled)), [plain["labels"]])[0]
    torch.testing.assert_close(found["masks"], decide_masks({"masks": masks, "scores": plain["scores"]})["masks"])


@torch.no_grad()
def test_a_detector_that_finds_nothing(model: torch.nn.Module, photo: Tensor) -> None:
    model.roi_heads.score_thresh = 1.0
    found, masks = detect(model, photo)
    assert found["boxes"].shape == (0, 4)
    assert annotate_detections(found, masks, 0) == []


def test_photos_are_normalized_as_torchvision_does(model: torch.nn.Module, photo: Tensor) -> None:
    before = photo.clone()
    assert torch.equal(normalize(model.transform, photo), model.transform.normalize(photo))
    run_heads(model, photo)
    assert torch.equal(photo, before)
    assert model.transform.normalize.__func__ is GeneralizedRCNNTransform.normalize
