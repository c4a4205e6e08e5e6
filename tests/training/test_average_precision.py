"""Average precision on cases with a known answer."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from mvseg.training.average_precision import (
    annotate_detections,
    annotate_truth,
    average_precision,
    detect,
    detect_and_label,
)
from mvseg.training.data import LabelledPhoto, list_samples
from tiny_training import build_tiny, write_photos


def square(x: int, y: int, size: int = 8) -> Tensor:
    mask = torch.zeros((40, 40), dtype=torch.bool)
    mask[y : y + size, x : x + size] = True
    return mask


def truth_of(masks: list[Tensor], image_id: int = 0, ignore: Tensor | None = None) -> list[dict[str, Any]]:
    layers = torch.zeros((1, 40, 40), dtype=torch.int32)
    for number, mask in enumerate(masks, start=1):
        layers[0][mask] = number
    nothing = torch.zeros((40, 40), dtype=torch.bool)
    classes = torch.ones(len(masks), dtype=torch.int64)
    labelled = LabelledPhoto(torch.zeros((3, 40, 40), dtype=torch.uint8), layers, classes, nothing)
    if ignore is not None:
        labelled.ignore.copy_(ignore)
    return annotate_truth(labelled, image_id, num_categories=1)


def found(masks: list[Tensor], scores: list[float], image_id: int = 0) -> list[dict[str, Any]]:
    corners = [mask.nonzero().flip(1) for mask in masks]
    boxes = [torch.cat((corner.amin(0), corner.amax(0) + 1)) for corner in corners]
    detections = {
        "boxes": torch.stack(boxes).float() if boxes else torch.zeros((0, 4)),
        "labels": torch.ones(len(masks), dtype=torch.int64),
        "scores": torch.tensor(scores),
    }
    return annotate_detections(detections, [mask.float() for mask in masks], image_id)


def test_perfect_detections() -> None:
    masks = [square(2, 2), square(20, 20)]
    scores = average_precision(truth_of(masks), found(masks, [0.9, 0.8]), 1)
    expected = {f"{kind}_{name}": 1.0 for kind in ("mask", "box") for name in ("AP", "AP50", "AP75", "AR")}
    assert scores == pytest.approx(expected)


def test_half_of_the_instances() -> None:
    scores = average_precision(truth_of([square(2, 2), square(20, 20)]), found([square(2, 2)], [0.9]), 1)
    assert scores["mask_AP50"] == pytest.approx(51 / 101)  # precision 1 up to recall 0.5, of 101 recall points
    assert scores["mask_AR"] == pytest.approx(0.5)


def test_a_shifted_mask_counts_up_to_its_overlap() -> None:
    scores = average_precision(truth_of([square(2, 2, 10)]), found([square(4, 2, 10)], [0.9]), 1)  # IoU 80 / 120
    assert (scores["mask_AP50"], scores["mask_AP75"]) == pytest.approx((1.0, 0.0))
    assert scores["mask_AP"] == pytest.approx(0.4)  # 0.50, 0.55, 0.60, 0.65 of ten thresholds


def test_false_detection_on_an_empty_photo_counts() -> None:
    truth, hit = truth_of([square(2, 2)]), found([square(2, 2)], [0.8])
    miss = found([square(20, 20)], [0.9], image_id=1)
    assert average_precision(truth, hit + miss, 2)["mask_AP50"] == pytest.approx(0.5)
    assert average_precision(truth, hit, 2)["mask_AP50"] == pytest.approx(1.0)


def test_detections_on_ignored_pixels_do_not_count() -> None:
    """Not on a photo with instances, nor on one without."""
    ignore = square(18, 18, 14)
    truth = truth_of([square(2, 2)], ignore=ignore) + truth_of([], image_id=1, ignore=ignore)
    wrong = [one for image_id in (0, 1) for one in found([square(20, 20)], [0.95], image_id)]
    assert average_precision(truth, found([square(2, 2)], [0.8]) + wrong, 2)["mask_AP50"] == pytest.approx(1.0)


def test_nothing_found_and_nothing_there() -> None:
    assert average_precision(truth_of([square(2, 2)]), [], 1)["mask_AP"] == 0.0
    assert average_precision([], found([square(2, 2)], [0.5]), 1)["mask_AP"] is None
    assert average_precision([], [], 1)["box_AR"] is None


def test_detect_is_the_models_own_forward_pass_with_decided_masks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("mvseg.training.average_precision.decide_masks", lambda found: found)
    model = build_tiny().eval()
    model.transform.min_size, model.transform.max_size = (64,), 64
    photo = torch.rand((3, 50, 90), generator=torch.Generator().manual_seed(1))
    with torch.no_grad():
        expected = model([photo])[0]
        ours, masks = detect(model, photo)
    assert len(expected["scores"]) > 3
    torch.testing.assert_close({**ours, "masks": torch.stack(list(masks))[:, None]}, expected)


def test_a_detector_that_finds_nothing() -> None:
    model = build_tiny().eval()
    model.roi_heads.score_thresh = 1.0
    with torch.no_grad():
        assert annotate_detections(*detect(model, torch.rand(3, 64, 64)), 0) == []


def test_detector_is_run_on_the_chosen_samples(tmp_path: Path) -> None:
    samples = list_samples(*write_photos(tmp_path, 4))
    truth, detections = detect_and_label(build_tiny().eval(), samples, [0, 2], torch.device("cpu"))
    assert [annotation["image_id"] for annotation in truth] == [2, 2]  # photo 0 is empty
    assert {annotation["image_id"] for annotation in detections} <= {0, 2}
    assert all(0 <= annotation["score"] <= 1 for annotation in detections)
