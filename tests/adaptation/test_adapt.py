"""The adaptation as a whole, with a stand-in for the detector and for the training."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from mvseg.adaptation.adapt import Agreement, adapt_detector, read_adaptable
from mvseg.adaptation.config import AdaptConfig
from mvseg.cli import main
from mvseg.config import RunConfig
from mvseg.detection.config import DetectConfig
from mvseg.detectors.weights_file import Description, encode_weights, read_weights
from mvseg.errors import InputError, InputWarning
from mvseg.formats.scene_folder import load_masks
from mvseg.masks import Proposals
from mvseg.matching.result import Matching
from mvseg.reconstruction.surface.leaf_surface import LeafSurface
from mvseg.scene import Scene
from mvseg.training.config import TrainConfig
from scene_folders import write_scene

MODULE = "mvseg.adaptation.adapt"
FOUND_BY_NEW = 3  # balls
NUM_ADDED = 0  # masks that only the other views show


@pytest.fixture(scope="module")
def plant(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_scene(tmp_path_factory.mktemp("scenes") / "plant")


@pytest.fixture
def trained(plant: Path, monkeypatch: pytest.MonkeyPatch) -> list[TrainConfig]:
    """The trainings that were asked for. Old weights find all balls, new ones the first `FOUND_BY_NEW`."""
    asked: list[TrainConfig] = []

    def detect(scene: Scene, run: RunConfig, **_: object) -> tuple[Proposals, Matching]:
        regions = load_masks(scene, plant / "truth")
        is_new = str(run.detect.weights).endswith("weights.safetensors")
        regions = regions.select(regions.labels <= (FOUND_BY_NEW if is_new else 3))
        count = len(regions)
        matching = Matching(
            instance_ids=regions.labels,
            match_scores=torch.full((count,), 0.9),
            num_instances=int(regions.labels.max()),
            method="nview",
        )
        ones = torch.ones(count)
        return Proposals(regions=regions, boxes=regions.boxes.float(), scores=ones, classes=ones.long()), matching

    def hear(found: Proposals, matching: Matching, **_: object) -> tuple[Proposals, Matching, dict[int, LeafSurface]]:
        return replace(found, from_views=torch.arange(len(found.regions)) < NUM_ADDED), matching, {}

    def train(config: TrainConfig) -> None:
        asked.append(config)
        config.output.mkdir(parents=True, exist_ok=True)
        (config.output / "config.yaml").write_text("")
        content = encode_weights({"a": torch.ones(1)}, Description(config.arch, ("leaf",), config.image_size))
        (config.output / "model.safetensors").write_bytes(content)

    for name, stand_in in (("detect_regions", detect), ("hear_witnesses", hear), ("train", train)):
        monkeypatch.setattr(f"{MODULE}.{name}", stand_in)
    return asked


def test_from_scenes_to_weights(plant: Path, trained: list[TrainConfig], tmp_path: Path) -> None:
    out = tmp_path / "out"
    run = RunConfig(detect=DetectConfig(image_size=120))
    before, after = adapt_detector([plant], out, AdaptConfig(num_samples=10, image_size=60), run=run)
    assert before == after == Agreement(num_found=12, num_kept=12, num_labels=12, num_photos=4)
    (config,) = trained
    assert config.arch == "efficientnet_lite0"
    assert config.epochs == 3  # of four photos, for ten samples
    assert config.scale_range == pytest.approx((1.4, 2.8))  # 0.7 and 1.4 times 120, in windows of 60 pixels
    assert sorted(path.name for path in config.labels.iterdir()) == [f"plant-00{view}.png" for view in range(4)]
    _, description = read_weights(out / "weights.safetensors")
    assert description == Description("efficientnet_lite0", ("leaf",), 120)  # as large as leaves were detected
    assert json.loads((out / "agreement.json").read_text())["after"]["num_kept"] == 12


def test_less_agreement_warns(
    plant: Path, trained: list[TrainConfig], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(globals(), "FOUND_BY_NEW", 2)
    with pytest.warns(InputWarning, match="kept 12 of 12 masks before and keep 8 of 8 now: the old weights may be"):
        adapt_detector([plant], tmp_path / "out")


@pytest.mark.usefixtures("trained")
def test_views_that_keep_little_warn(plant: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(globals(), "NUM_ADDED", 7)
    with pytest.warns(InputWarning, match="keep only 5 of the 12 masks found: expect wrong labels.*; look at .*labels"):
        adapt_detector([plant], tmp_path / "out", AdaptConfig(num_samples=10, image_size=60))


def test_a_second_run_goes_on(plant: Path, trained: list[TrainConfig], tmp_path: Path) -> None:
    out = tmp_path / "out"
    adapt_detector([plant], out)
    label = out / "labels" / "labels" / "plant-000.png"
    label.unlink()
    adapt_detector([plant], out)
    assert not label.exists()  # labels of a training that has begun are not written again
    assert len(trained) == 2
    assert all(config.resume for config in trained)


def test_nothing_to_learn_from(plant: Path, trained: list[TrainConfig], tmp_path: Path) -> None:
    with pytest.raises(InputError, match="none of the 12 masks found is confirmed in 4 views with a match score of 1"):
        adapt_detector([plant], tmp_path / "out", AdaptConfig(min_match_score=1.0))
    with pytest.raises(InputError, match="two of the scenes plant, plant have one name"):
        adapt_detector([plant, plant], tmp_path / "out")


def test_weights_that_cannot_be_adapted(tmp_path: Path) -> None:
    content = encode_weights({"a": torch.ones(1)}, Description("resnet18_fpn", ("leaf", "pot"), 64))
    (tmp_path / "two.safetensors").write_bytes(content)
    with pytest.raises(InputError, match=r"two\.safetensors has the categories leaf, pot, expected one to adapt"):
        read_adaptable(str(tmp_path / "two.safetensors"))


@pytest.mark.parametrize(
    ("option", "message"),
    [
        ("--adapt.min_views=1", "adapt.min_views is 1, expected at least 2"),
        ("--adapt.lr=0", "adapt.lr is 0, expected a positive number"),
        ("--adapt.min_match_score=2", "adapt.min_match_score is 2, expected a number from 0 to 1"),
    ],
)
def test_command_refuses(
    plant: Path, tmp_path: Path, option: str, message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["adapt", str(plant), "--out", str(tmp_path / "out"), option]) == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_command(
    plant: Path, trained: list[TrainConfig], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    assert main(["adapt", str(plant), "--out", str(out), "--quiet", "--adapt.seed", "5"]) == 0
    assert trained[0].seed == 5
    shown = capsys.readouterr().out.splitlines()
    assert shown[0] == "before: 12 masks found, 12 left when the other views are heard"
    assert shown[-1] == f"{out / 'weights.safetensors'}: for --detect.weights"
