"""Whatever device a detector is on: the same detections there as on the CPU, with the same types."""

from __future__ import annotations

import copy
from typing import Any

import pytest
import torch
from torch import Tensor
from torchvision.models.detection import MaskRCNN

from mvseg import MultiViewMaskRCNN
from mvseg.detectors.mask_cut import decide_masks
from mvseg.detectors.mask_rcnn import build_detector
from mvseg.detectors.run import detect, leave_autocast, run_heads
from mvseg.detectors.small import SMALL_ARCHITECTURES
from mvseg.masks import Masks
from mvseg.verification.choose import Judges, Leaves
from other_device import other_device
from synthetic import arc_positions, cameras_at
from tiny_training import build_tiny

# what an untrained detector finds in noise does not agree across views
pytestmark = pytest.mark.filterwarnings("ignore::mvseg.errors.InputWarning")

WIDTH, HEIGHT = 80, 60
CAMERAS = cameras_at(arc_positions(2), focal=100.0, width=WIDTH, height=HEIGHT)
FLOATS, WHOLE = ("boxes", "scores", "masks", "match_scores"), ("labels", "instance_ids", "frame", "scale")


@pytest.fixture
def model() -> MaskRCNN:
    model = build_tiny(3).eval()
    model.transform.min_size, model.transform.max_size = (64,), 64
    return model


@pytest.fixture
def photos() -> list[Tensor]:
    return list(torch.rand((2, 3, HEIGHT, WIDTH), generator=torch.Generator().manual_seed(1)))


def there(module: Any, device: torch.device) -> Any:
    """A copy of a module, moved."""
    return copy.deepcopy(module).to(device)


def check(answer: dict[str, Tensor], expected: dict[str, Tensor], device: torch.device) -> None:
    """The same there as here, but for the size of the frame, which is never on a device."""
    assert answer.keys() == expected.keys()
    assert len(expected["scores"]) > 2
    for key, value in answer.items():
        assert value.device == (torch.device("cpu") if key == "frame" else device), key
        assert value.dtype == torch.float32 if key in FLOATS else torch.int64 if key in WHOLE else torch.bool, key
        torch.testing.assert_close(value.cpu(), expected[key])


@torch.no_grad()
@pytest.mark.parametrize("arch", SMALL_ARCHITECTURES)
def test_each_small_detector(arch: str) -> None:
    torch.manual_seed(0)
    model = build_detector(arch, 2, image_size=64).eval()
    photo = torch.rand((3, 48, 64), generator=torch.Generator().manual_seed(1))
    model.roi_heads.score_thresh, model.roi_heads.detections_per_img = 0.0, 5
    expected = run_heads(model, photo)
    with other_device() as device:
        check(run_heads(there(model, device), photo.to(device)), expected, device)


@torch.no_grad()
def test_nothing_found(model: MaskRCNN, photos: list[Tensor]) -> None:
    model.roi_heads.score_thresh = 1.0
    with other_device() as device:
        found, masks = detect(there(model, device), photos[0].to(device))
        assert {key: (value.device, value.dtype, tuple(value.shape)) for key, value in found.items()} == {
            "boxes": (device, torch.float32, (0, 4)),
            "labels": (device, torch.int64, (0,)),
            "scores": (device, torch.float32, (0,)),
        }
        assert list(masks) == []
        results = MultiViewMaskRCNN(there(model, device))([each.to(device) for each in photos], cameras=CAMERAS)
        assert [result["instance_ids"].device for result in results] == [device] * 2
        assert {len(value) for result in results for value in result.values()} == {0}


@torch.no_grad()
def test_double_detectors_answer_in_single(model: MaskRCNN, photos: list[Tensor]) -> None:
    single = run_heads(model, photos[0])
    with other_device() as device:
        check(run_heads(there(model.double(), device), photos[0].to(device).double()), single, device)
        for dtype in (torch.float16, torch.float32, torch.float64):
            raw = {"masks": single["masks"].to(dtype), "scores": single["scores"].to(dtype)}
            answer = decide_masks({key: value.to(device) for key, value in raw.items()})
            for key, expected in decide_masks(raw).items():
                assert (answer[key].device, answer[key].dtype) == (device, dtype)
                torch.testing.assert_close(answer[key].cpu(), expected)


def test_all_views_with_cameras_and_without(model: MaskRCNN, photos: list[Tensor]) -> None:
    wrapped = MultiViewMaskRCNN(model, proposals_per_view=5)
    with other_device() as device:
        moved, images = there(wrapped, device), [photo.to(device) for photo in photos]
        expected = wrapped(photos, cameras=CAMERAS)  # by the same operations: ids in noise turn on the last bit
        assert max(int(result["instance_ids"].max()) for result in expected) >= 1
        for answer, result in zip(moved(images, cameras=CAMERAS.to(device)), expected, strict=True):
            check(answer, result, device)
        with torch.no_grad():
            for answer, result in zip(moved(images), wrapped(photos), strict=True):
                check(answer, result, device)


def test_regions_come_back_to_the_cpu(model: MaskRCNN, photos: list[Tensor]) -> None:
    wrapped = MultiViewMaskRCNN(model, proposals_per_view=5)
    with other_device() as device:
        images = (photo.to(device) for photo in photos)
        found = there(wrapped, device).find_regions(images, CAMERAS.to(device)).masks
        expected = wrapped.find_regions(photos, CAMERAS).masks  # by the same operations
    assert (found.detection_scores.dtype, found.classes.dtype) == (torch.float32, torch.int64)
    for name in ("detection_scores", "classes", "match_scores"):
        torch.testing.assert_close(getattr(found, name), getattr(expected, name))
    assert torch.equal(found.regions.crops, expected.regions.crops)
    assert torch.equal(found.instance_ids, expected.instance_ids)


def test_leaves_are_chosen_on_the_cpu(model: MaskRCNN, photos: list[Tensor], monkeypatch: pytest.MonkeyPatch) -> None:
    wrapped = MultiViewMaskRCNN(model, proposals_per_view=5, verify=True)

    def choose(proposals: Masks, matched: dict[str, Masks], judges: Judges, **_: object) -> Leaves:
        tables = [proposals, *matched.values()]
        assert {each.device.type for each in (judges.cameras.K, *(table.view_index for table in tables))} == {"cpu"}
        return Leaves(proposals, surfaces={}, probabilities={}, rejected=(), keys={})

    monkeypatch.setattr("mvseg.pipeline.plant.choose_leaves", choose)
    monkeypatch.setattr("mvseg.pipeline.find_in_photos.choose_size", lambda _, first: [first])
    results = wrapped(photos, cameras=CAMERAS)
    with other_device() as device:
        answers = there(wrapped, device)([photo.to(device) for photo in photos], cameras=CAMERAS.to(device))
        for answer, expected in zip(answers, results, strict=True):
            check(answer, expected, device)


def test_autocast_there_reaches_the_backbone_and_no_boxes(model: MaskRCNN, photos: list[Tensor]) -> None:
    """The cameras may have stayed on the CPU."""
    with other_device() as device:
        wrapped, seen = there(MultiViewMaskRCNN(model, proposals_per_view=5), device), []
        wrapped.backbone.register_forward_hook(lambda module, inputs, output: seen.append(output.dtype))
        wrapped.rpn.head.register_forward_hook(lambda module, inputs, output: seen.append(output[0][0].dtype))
        with torch.autocast(device.type, torch.bfloat16):
            results = wrapped([photo.to(device) for photo in photos], cameras=CAMERAS)
        assert seen == [torch.bfloat16, torch.float32] * 2
        for result in results:
            check(result, {key: value.cpu() for key, value in result.items()}, device)
            assert not torch.equal(result["boxes"], result["boxes"].bfloat16().float())


@pytest.mark.parametrize("lower", [False, True])
def test_losses_and_gradients(lower: bool, model: MaskRCNN, photos: list[Tensor]) -> None:
    """In half precision they are nearly the same, with the hook that training sets."""
    wrapped = MultiViewMaskRCNN(model.train())
    target = {
        "boxes": torch.tensor([[10.0, 10, 45, 40], [50, 5, 53, 40]]),
        "labels": torch.tensor([1, 2]),
        "masks": torch.ones(2, HEIGHT, WIDTH, dtype=torch.uint8),
    }
    torch.manual_seed(5)
    expected = wrapped(photos[:1], [target])
    torch.manual_seed(5)
    with other_device() as device:
        moved = there(wrapped, device)
        moved.rpn.head.register_forward_hook(leave_autocast)
        with torch.autocast(device.type, torch.bfloat16, enabled=lower):
            losses = moved([photos[0].to(device)], [{key: value.to(device) for key, value in target.items()}])
        assert losses.keys() == expected.keys()
        for key, loss in losses.items():
            assert loss.device == device
            assert loss.isfinite()
            torch.testing.assert_close(loss.float().cpu(), expected[key], rtol=0.2 if lower else 1e-5, atol=1e-5)
        sum(losses.values()).backward()
        gradient = moved.backbone[0].weight.grad
        assert (gradient.device, gradient.dtype) == (device, torch.float32)
        assert gradient.abs().sum() > 0
