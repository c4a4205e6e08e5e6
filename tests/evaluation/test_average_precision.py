"""Average precision on cases with a known answer."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor

from mvseg.evaluation.average_precision import annotate_detections, annotate_truth, average_precision, describe_mask
from mvseg.evaluation.labelled_photo import LabelledPhoto


def square(x: int, y: int, size: int = 8) -> Tensor:
    mask = torch.zeros((40, 40), dtype=torch.bool)
    mask[y : y + size, x : x + size] = True
    return mask


def truth_of(masks: list[Tensor], image_id: int = 0, ignore: Tensor | None = None) -> list[dict[str, Any]]:
    layers = torch.zeros((1, 40, 40), dtype=torch.int32)
    for number, mask in enumerate(masks, start=1):
        layers[0][mask] = number
    labelled = LabelledPhoto(
        photo=torch.zeros((3, 40, 40), dtype=torch.uint8),
        layers=layers,
        classes=torch.ones(len(masks), dtype=torch.int64),
        ignore=torch.zeros((40, 40), dtype=torch.bool) if ignore is None else ignore,
    )
    return annotate_truth(labelled, image_id, num_categories=1)


def detected(masks: list[Tensor], scores: list[float], image_id: int = 0) -> list[dict[str, Any]]:
    corners = [mask.nonzero().flip(1) for mask in masks]
    boxes = [torch.cat((corner.amin(0), corner.amax(0) + 1)) for corner in corners]
    detections = {
        "boxes": torch.stack(boxes).float() if boxes else torch.zeros((0, 4)),
        "labels": torch.ones(len(masks), dtype=torch.int64),
        "scores": torch.tensor(scores),
    }
    return annotate_detections(detections, [mask.float() for mask in masks], image_id)


def test_perfect_false_ignored_and_no_detections() -> None:
    masks = [square(2, 2), square(20, 20)]
    scores = average_precision(truth_of(masks), detected(masks, [0.9, 0.8]), 1)
    expected = {f"{kind}_{name}": 1.0 for kind in ("mask", "box") for name in ("AP", "AP50", "AP75", "AR")}
    assert scores == pytest.approx(expected)
    truth, hit = truth_of([square(2, 2)]), detected([square(2, 2)], [0.8])
    miss = detected([square(20, 20)], [0.9], image_id=1)
    assert average_precision(truth, hit + miss, 2)["mask_AP50"] == pytest.approx(0.5)
    assert average_precision(truth, hit, 2)["mask_AP50"] == pytest.approx(1.0)
    # Not on a photo with instances, nor on one without.
    ignore = square(18, 18, 14)
    truth = truth_of([square(2, 2)], ignore=ignore) + truth_of([], image_id=1, ignore=ignore)
    wrong = [*detected([square(20, 20)], [0.95], 0), *detected([square(20, 20)], [0.95], 1)]
    assert average_precision(truth, detected([square(2, 2)], [0.8]) + wrong, 2)["mask_AP50"] == pytest.approx(1.0)
    assert average_precision(truth_of([square(2, 2)]), [], 1)["mask_AP"] == 0.0
    assert average_precision([], detected([square(2, 2)], [0.5]), 1)["mask_AP"] is None
    assert average_precision([], [], 1)["box_AR"] is None


def test_ignored_pixels_are_a_crowd_of_every_category_and_masks_have_areas_and_boxes() -> None:
    labelled = LabelledPhoto(
        photo=torch.zeros((3, 40, 40), dtype=torch.uint8),
        layers=square(2, 2)[None].int(),
        classes=torch.tensor([2]),
        ignore=square(20, 20),
    )
    leaf, *crowds = annotate_truth(labelled, 5, num_categories=2)
    assert (leaf["category_id"], leaf["iscrowd"], leaf["image_id"]) == (2, 0, 5)
    assert [(crowd["category_id"], crowd["iscrowd"], crowd["area"]) for crowd in crowds] == [(1, 1, 64), (2, 1, 64)]
    described = describe_mask(square(20, 10, 5), 3)
    assert (described["image_id"], described["area"], described["bbox"]) == (3, 25, [20, 10, 5, 5])
