"""Detectors by name: sizes, norms that ignore the batch, and weights from every source."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any
from urllib.error import URLError

import pytest
import torch
import torchvision
from safetensors.torch import save_file
from torch import Tensor, nn
from torchvision.models.detection import MaskRCNN
from torchvision.ops import FrozenBatchNorm2d

from mvseg.detectors.mask_rcnn import build_bare, build_detector
from mvseg.detectors.weights_file import Description, encode_weights
from mvseg.errors import InputError

SMALL = ["resnet18_fpn", "mobilenet_v3_large_fpn", "efficientnet_lite0"]
Download = Callable[..., dict[str, Tensor]]


def detect(model: MaskRCNN, seed: int = 0) -> dict[str, Tensor]:
    generator = torch.Generator().manual_seed(seed)
    model.rpn._post_nms_top_n["testing"], model.roi_heads.detections_per_img = 50, 5  # for time
    with torch.no_grad():
        return model.eval()([torch.rand(3, 64, 64, generator=generator)])[0]


def assert_same(ours: dict[str, Tensor], theirs: dict[str, Tensor]) -> None:
    for key, value in theirs.items():
        torch.testing.assert_close(ours[key], value, rtol=1e-4, atol=1e-4)


def randomize_norms(model: nn.Module) -> nn.Module:
    """Statistics as training leaves them, some variances tiny: there the epsilon counts."""
    for norm in model.modules():
        if isinstance(norm, nn.BatchNorm2d):
            assert norm.running_mean is not None
            assert norm.running_var is not None
            norm.running_mean.normal_(0, 0.1)
            norm.running_var.uniform_(1e-4, 2)
    return model


@pytest.fixture
def download(monkeypatch: pytest.MonkeyPatch) -> list[Download]:
    """Replaces every download by the functions in this list; an unexpected one fails the test."""
    answers: list[Download] = []

    def answer(url: str, **options: Any) -> dict[str, Tensor]:
        assert answers, f"unexpected download of {url}"
        return answers.pop(0)(url)

    monkeypatch.setattr("torchvision.models._api.load_state_dict_from_url", answer)
    return answers


@pytest.mark.parametrize("arch", SMALL)
def test_norms_do_not_look_at_the_batch(arch: str) -> None:
    torch.manual_seed(0)
    model = build_detector(arch, 2)
    assert not any(isinstance(module, nn.BatchNorm2d) for module in model.modules())
    photos = torch.rand(2, 3, 64, 64)
    together, alone = model.backbone(photos), model.backbone(photos[:1])
    for level, features in alone.items():
        torch.testing.assert_close(together[level][:1], features, rtol=1e-4, atol=1e-4)


def test_stock_architecture_from_nothing_downloads_nothing(download: list[Download]) -> None:
    model = build_detector("maskrcnn_resnet50_fpn", 2)
    assert not any(isinstance(module, nn.BatchNorm2d | FrozenBatchNorm2d) for module in model.modules())
    assert all(parameter.requires_grad for parameter in model.parameters())


def test_coco_weights_keep_all_but_the_predictors(download: list[Download]) -> None:
    bare = torchvision.models.get_model("maskrcnn_resnet50_fpn", weights=None, weights_backbone=None)
    coco = {key: value for key, value in bare.state_dict().items() if not key.endswith("num_batches_tracked")}
    download.append(lambda url: dict(coco))
    model = build_detector("maskrcnn_resnet50_fpn", 2, "COCO_V1", image_size=320)
    state = model.state_dict()
    assert state["roi_heads.box_predictor.cls_score.weight"].shape == (2, 1024)
    assert state["roi_heads.mask_predictor.mask_fcn_logits.weight"].shape == (2, 256, 1, 1)
    kept = [key for key in state if "predictor" not in key]
    assert len(kept) > 200
    assert all(torch.equal(state[key], coco[key]) for key in kept)
    assert not model.backbone.body.conv1.weight.requires_grad  # torchvision freezes the first layers


def test_backbone_weights_of_a_small_detector(download: list[Download]) -> None:
    classifier = randomize_norms(torchvision.models.resnet18())
    download.append(lambda url: classifier.state_dict())
    body = build_detector("resnet18_fpn", 2, "IMAGENET1K_V1").backbone.body
    x = torch.rand(1, 3, 64, 64)
    stem = nn.Sequential(*list(classifier.eval().children())[:5])
    torch.testing.assert_close(body(x)["0"], stem(x), rtol=1e-4, atol=1e-4)


def test_failed_download_is_one_sentence(download: list[Download]) -> None:
    def fail(url: str) -> dict[str, Tensor]:
        raise URLError("no route")

    download.append(fail)
    with pytest.raises(InputError, match=r"'COCO_V1' of maskrcnn_resnet50_fpn could not be downloaded .*no route"):
        build_detector("maskrcnn_resnet50_fpn", 2, "COCO_V1")


def test_a_saved_detector_comes_back(tmp_path: Path, download: list[Download]) -> None:
    torch.manual_seed(0)
    model = build_detector("resnet18_fpn", 2, image_size=64)
    path = tmp_path / "model.safetensors"
    path.write_bytes(encode_weights(model.state_dict(), Description("resnet18_fpn", ("leaf",), 64)))
    again = build_detector("resnet18_fpn", 2, str(path))
    assert again.transform.min_size == (64,)
    assert_same(detect(again), detect(model))
    other = build_detector("resnet18_fpn", 5, str(path), image_size=96)
    assert other.transform.min_size == (96,)
    assert other.roi_heads.box_predictor.cls_score.out_features == 5
    assert torch.equal(other.backbone.body.conv1.weight, model.backbone.body.conv1.weight)
    with pytest.raises(InputError, match="holds a resnet18_fpn, not the mobilenet_v3_large_fpn"):
        build_detector("mobilenet_v3_large_fpn", 2, str(path))


@pytest.mark.parametrize("arch", SMALL)
def test_batch_norm_checkpoint_is_frozen_without_changing_its_answers(arch: str, tmp_path: Path) -> None:
    torch.manual_seed(0)
    trained = randomize_norms(build_bare(arch, 2))
    torch.save({"model": trained.state_dict(), "epoch": 3}, tmp_path / "checkpoint.pth")
    loaded = build_detector(arch, 2, str(tmp_path / "checkpoint.pth"), image_size=64)
    trained.transform = loaded.transform
    assert_same(detect(loaded), detect(trained))
    save_file(loaded.state_dict(), tmp_path / "frozen.safetensors")
    again = build_detector(arch, 2, str(tmp_path / "frozen.safetensors")).state_dict()
    assert all(torch.equal(again[key], value) for key, value in loaded.state_dict().items())


@pytest.mark.parametrize(
    ("arch", "num_classes", "weights", "message"),
    [
        ("resnet99", 2, None, "architecture 'resnet99' is unknown, expected one of resnet18_fpn, "),
        ("fasterrcnn_resnet50_fpn", 2, None, "is unknown"),
        ("resnet18_fpn", 1, None, "num_classes is 1, expected at least 2"),
        ("resnet18_fpn", 2, "COCO_V1", "neither a file nor a name that torchvision has"),
    ],
)
def test_problems(arch: str, num_classes: int, weights: str | None, message: str) -> None:
    with pytest.raises(InputError, match=message):
        build_detector(arch, num_classes, weights)


def test_categories_that_do_not_fit_the_head_are_refused(tmp_path: Path) -> None:
    """They would get random predictors, and find nonsense."""
    path, state = tmp_path / "model.safetensors", build_detector("resnet18_fpn", 2).state_dict()
    path.write_bytes(encode_weights(state, Description("resnet18_fpn", ("leaf", "stem"), 64)))
    with pytest.raises(InputError, match="names 2 categories, its head has 1"):
        build_detector("resnet18_fpn", 3, str(path))
    broken = state | {CLS: torch.tensor([0.0, float("nan")])}
    path.write_bytes(encode_weights(broken, Description("resnet18_fpn", ("leaf",), 64)))
    with pytest.raises(InputError, match=f"{CLS} holds a number that is not finite"):
        build_detector("resnet18_fpn", 2, str(path))


CLS = "roi_heads.box_predictor.cls_score.bias"


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({"a": torch.zeros(1)}, "is not a Mask R-CNN"),
        ({CLS: torch.zeros(2)}, r"does not fit mobilenet_v3_large_fpn: it lacks backbone\S+ \(and \d+ more\)"),
        ({CLS: torch.zeros(2), "backbone.body.0.0.weight": torch.zeros(1)}, "does not fit .*: size mismatch for "),
    ],
)
def test_weights_that_do_not_fit(tmp_path: Path, content: Any, message: str) -> None:
    torch.save(content, tmp_path / "weights.pt")
    with pytest.raises(InputError, match=message):
        build_detector("mobilenet_v3_large_fpn", 2, str(tmp_path / "weights.pt"))
