"""Fine-tuning in memory: what changes, what stays, and what ignored pixels do not teach."""

from __future__ import annotations

import copy
from collections import OrderedDict
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor, nn
from torchvision.models.detection import MaskRCNN
from torchvision.ops import FrozenBatchNorm2d

from mvseg.crop import Crop
from mvseg.errors import InputError
from mvseg.masks import Masks
from mvseg.regions import stack_regions
from mvseg.training import fine_tune as module
from mvseg.training.fine_tune import SparedBoxes, fine_tune, gather_samples
from mvseg.training.view_labels import ViewLabels
from tiny_training import build_tiny

SIZE = 64
BOXES = torch.tensor([[0, 0, SIZE, SIZE]] * 2)


class BodiedBackbone(nn.Module):
    """A body whose first layers have a frozen norm, and a layer on top of it."""

    out_channels = 16

    def __init__(self) -> None:
        super().__init__()
        stem = nn.Sequential(nn.Conv2d(3, 16, 5, 4, 2), FrozenBatchNorm2d(16, eps=0.0), nn.ReLU())
        stage1 = nn.Conv2d(16, 16, 1)
        nn.init.dirac_(stage1.weight)
        self.body = nn.Sequential(OrderedDict(stem=stem, stage1=stage1))
        self.fpn = nn.Conv2d(16, 16, 3, 2, 1)

    def forward(self, photos: Tensor) -> Tensor:
        features: Tensor = self.fpn(self.body(photos))
        return features


@pytest.fixture
def detector() -> MaskRCNN:
    model = build_tiny()
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(1)
        model.backbone = BodiedBackbone()
    model.backbone.body.stem[1].bias += 0.1
    model.transform.min_size, model.transform.max_size = (SIZE,), SIZE
    return model.eval()


@pytest.fixture
def photos() -> list[np.ndarray]:
    """Two photos of two leaves each, on grey."""
    photos = [np.full((SIZE, SIZE, 3), 100, np.uint8) for _ in range(2)]
    for photo in photos:
        photo[10:30, 10:30] = photo[40:54, 36:60] = (30, 200, 40)
    return photos


def label(boxes: list[tuple[int, int, int, int]], views: list[int]) -> ViewLabels:
    """Each box is a label."""
    crops = [Crop((x1, y1, x2, y2), torch.ones(y2 - y1, x2 - x1, dtype=torch.bool)) for x1, y1, x2, y2 in boxes]
    masks = Masks.of(stack_regions([*zip(views, crops, views, strict=True)], 2))
    return ViewLabels(masks, masks.select(masks.view_index < 0), np.zeros((16,) * 3, bool))


LABELS = label([(10, 10, 30, 30), (36, 40, 60, 54)] * 2, [0, 0, 1, 1])


def test_weights_are_those_of_the_seed_and_the_first_layers_stay(detector: MaskRCNN, photos: list[np.ndarray]) -> None:
    before, random = copy.deepcopy(detector.state_dict()), torch.get_rng_state()
    learned, again, other = (
        fine_tune(detector, photos.__getitem__, LABELS, boxes=BOXES, num_steps=3, seed=seed).state_dict()
        for seed in (0, 0, 1)
    )
    assert torch.equal(torch.get_rng_state(), random)
    assert all(torch.equal(value, before[name]) for name, value in detector.state_dict().items())
    assert all(torch.equal(value, learned[name]) for name, value in again.items())
    is_same = {name for name, value in learned.items() if torch.equal(value, before[name])}
    assert is_same == {name for name in before if name.startswith("backbone.body.stem.")}
    assert not torch.equal(learned["backbone.fpn.weight"], other["backbone.fpn.weight"])


def test_leaves_are_learned_and_ignored_ones_are_no_background(
    detector: MaskRCNN, photos: list[np.ndarray], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The second leaf of each photo has no label: ignored in one case, background in the other."""
    monkeypatch.setattr(module, "RECIPE", replace(module.RECIPE, lr=0.05, batch_size=1, scale_range=(1.0, 1.0)))
    first = label([(10, 10, 30, 30)] * 2, [0, 1])
    ignoring = replace(first, doubtful=label([(34, 38, 62, 56)] * 2, [0, 1]).leaves)

    def objectness(model: MaskRCNN) -> tuple[float, float]:
        photo = torch.from_numpy(photos[0]).permute(2, 0, 1).float() / 255
        frame, _ = model.transform([photo])
        ((logits,), _) = model.rpn.head([model.backbone(frame.tensors)])
        return float(logits[0, :, 2, 2].mean()), float(logits[0, :, 5, 6].mean())  # at the leaves; the stride is 8

    with torch.no_grad():
        before = objectness(detector)
        ignored, background = (
            objectness(fine_tune(detector, photos.__getitem__, labels, boxes=BOXES, num_steps=16))
            for labels in (ignoring, first)
        )
    assert before[0] - before[1] < 0.01
    assert background[0] - background[1] > 0.2
    assert ignored[1] - background[1] > 0.2


def test_it_learns_the_parts_that_it_looks_at_at_their_size(detector: MaskRCNN, photos: list[np.ndarray]) -> None:
    boxes = torch.tensor([[8, 8, 40, 32], [0, 0, SIZE, SIZE]])
    labels = label([(10, 10, 30, 30)], [0])
    ((labelled, side),) = gather_samples(detector, photos.__getitem__, labels, boxes=boxes)
    assert side == SIZE  # the part, enlarged
    assert labelled.photo.shape == (3, 24, 32)
    assert labelled.layers[0, 3].nonzero()[:, 0].tolist() == list(range(2, 22))
    with pytest.raises(InputError, match="no photo has a label"):
        fine_tune(detector, photos.__getitem__, label([(50, 0, 60, 10)], [0]), boxes=boxes, num_steps=1)


def test_boxes_of_ignored_pixels_are_spared(detector: MaskRCNN) -> None:
    """Whatever the assignment says is background, and only that; the share of each box counted pixel by pixel."""
    ignored = torch.rand(40, 50, generator=torch.Generator().manual_seed(0)) < torch.linspace(0, 0.6, 50)
    corners = torch.randint(-10, 60, (200, 2, 2), generator=torch.Generator().manual_seed(1)).float()
    boxes = torch.cat((corners.amin(1), corners.amax(1) + 1), 1)
    truth = [{"boxes": torch.tensor([[5.0, 5.0, 25.0, 25.0]]), "labels": torch.tensor([1])}]
    plain, _ = detector.rpn.assign_targets_to_anchors([boxes], truth)
    spared = SparedBoxes(detector)
    spared.look_at(ignored)
    expected = plain[0].clone()
    for row, (x1, y1, x2, y2) in enumerate(boxes.clamp(min=0).long().tolist()):
        inside = ignored[y1:y2, x1:x2]
        if inside.numel() and plain[0][row] == 0 and float(inside.float().mean()) > 0.25:
            expected[row] = -1
    assert 20 < int((expected != plain[0]).sum()) < 180
    assert torch.equal(detector.rpn.assign_targets_to_anchors([boxes], truth)[0][0], expected)
    _, labels = detector.roi_heads.assign_targets_to_proposals([boxes], [truth[0]["boxes"]], [truth[0]["labels"]])
    assert (labels[0][(expected == -1) & (plain[0] == 0)] == -1).all()
