"""The zoo: what ships is whole, loads by name, and a damaged file is refused."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file

import mvseg.detectors.zoo as zoo
from benchmarks.pack_detector import pack_detector
from mvseg.cli import main
from mvseg.detectors.mask_rcnn import count_parameters
from mvseg.detectors.zoo import find_weights, list_detectors, load_detector
from mvseg.errors import InputError
from mvseg.training.data import list_samples
from mvseg.training.state import start_state
from tiny_training import make_config, write_finished_run, write_photos

SHIPPED = [entry.name for entry in list_detectors()]


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_finished_run(tmp_path_factory.mktemp("zoo") / "run")


@pytest.fixture
def packed(run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """That run in a zoo of its own, called leaf-test."""
    pack_detector(run, tmp_path / "zoo" / "leaf-test")
    monkeypatch.setattr(zoo, "HOMES", (tmp_path / "zoo",))
    return tmp_path / "zoo" / "leaf-test"


@pytest.mark.parametrize("name", SHIPPED)
def test_what_ships_is_whole_small_and_described(name: str) -> None:
    entry = next(entry for entry in list_detectors() if entry.name == name)
    assert entry.weights.stat().st_size <= 60e6
    assert {path.name for path in entry.weights.parent.iterdir()} >= {"card.md", "recipe", "metrics.json"}
    assert entry.metrics["test"]["mask_AP50"] > 0
    model = load_detector(name)
    assert not model.training
    with torch.no_grad():
        (found,) = model([torch.zeros(3, 64, 96)])
    assert found["masks"].shape[1:] == (1, 64, 96)


def test_photos_are_scaled_down_never_up_unless_a_size_is_asked_for(packed: Path) -> None:
    photos = [torch.rand(3, 200, 300), torch.rand(3, 40, 60)]
    asked, default = (load_detector("leaf-test", image_size=size).transform for size in (96, None))
    assert default(photos[:1])[0].image_sizes == asked(photos[:1])[0].image_sizes == [(64, 96)]
    assert torch.equal(default(photos[:1])[0].tensors, asked(photos[:1])[0].tensors)
    assert asked(photos[1:])[0].image_sizes == [(64, 96)]
    assert default(photos[1:])[0].image_sizes == [(40, 60)]
    model = load_detector("leaf-test")
    with torch.no_grad():
        assert model(photos[1:])[0]["masks"].shape[1:] == (1, 40, 60)


def test_a_packed_run_loads_with_its_own_size_and_classes_and_has_the_hash_of_sha256sum(
    run: Path, packed: Path
) -> None:
    model = load_detector("leaf-test")
    assert model.transform.max_size == 96
    assert model.roi_heads.box_predictor.cls_score.out_features == 4
    assert load_detector("leaf-test", image_size=128).transform.max_size == 128
    direct = load_detector(run / "model.safetensors")
    assert count_parameters(model) == count_parameters(direct)
    for key, value in direct.state_dict().items():
        stored = model.state_dict()[key]
        assert stored.dtype == value.dtype
        torch.testing.assert_close(stored, value, rtol=1e-3, atol=1e-6)
    line = (packed / zoo.HASH).read_text()
    assert line == f"{hashlib.sha256((packed / zoo.WEIGHTS).read_bytes()).hexdigest()}  {zoo.WEIGHTS}\n"


def test_a_damaged_or_missing_file_is_refused(packed: Path) -> None:
    weights = packed / zoo.WEIGHTS
    content = bytearray(weights.read_bytes())
    content[-1] ^= 1
    weights.write_bytes(bytes(content))
    with pytest.raises(InputError, match=r"weights\.safetensors: the SHA-256 is .* the file is damaged"):
        load_detector("leaf-test")
    weights.unlink()
    with pytest.raises(InputError, match="the weights of 'leaf-test' are missing"):
        find_weights("leaf-test")


def test_unknown_names_and_files_without_description_are_refused(packed: Path, tmp_path: Path) -> None:
    assert find_weights("nobody") is None
    with pytest.raises(InputError, match=r"'nobody' is neither a shipped detector \(leaf-test\) nor a file"):
        load_detector("nobody")
    save_file(torch.nn.Linear(2, 2).state_dict(), tmp_path / "bare.safetensors")
    with pytest.raises(InputError, match="does not say its architecture"):
        load_detector(tmp_path / "bare.safetensors")


def test_damaged_neighbours_do_not_keep_a_detector_from_loading(
    packed: Path, run: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pack_detector(run, packed.parent / "unmeasured")
    (packed.parent / "unmeasured" / "metrics.json").write_text('{"validation": {"mask_AP": null}}')
    (packed.parent / "unmeasured" / zoo.WEIGHTS).unlink()
    assert main(["models"]) == 0
    assert "unmeasured      weights missing, not measured" in capsys.readouterr().out
    (packed.parent / "unmeasured" / "metrics.json").unlink()
    assert load_detector("leaf-test").transform.max_size == 96
    assert main(["models"]) == 2
    assert "is not a complete detector" in capsys.readouterr().err


def test_loading_leaves_the_random_generator_alone(packed: Path) -> None:
    before = torch.get_rng_state()
    load_detector("leaf-test")
    assert torch.equal(torch.get_rng_state(), before)


def test_training_starts_from_a_shipped_detector(packed: Path, tmp_path: Path) -> None:
    photos, labels = write_photos(tmp_path / "data", 2)
    config = make_config(tmp_path / "data", tmp_path / "out", arch="mobilenet_v3_large_fpn", weights="leaf-test")
    state = start_state(config, list_samples(photos, labels), device=torch.device("cpu"))
    theirs = load_detector("leaf-test")
    key = "backbone.body.0.0.weight"
    assert torch.equal(state.model.state_dict()[key], theirs.state_dict()[key])
    assert state.model.roi_heads.box_predictor.cls_score.out_features == 2  # background and one class


def test_the_command_lists(run: Path, packed: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pack_detector(run, packed.parent / "leaf-other", 160)
    assert main(["models"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines] == ["leaf-other", "leaf-test"]
    assert "AP50 0.750" in lines[0]
    assert json.loads((packed.parent / "leaf-other" / "metrics.json").read_text())["validation"]["epoch"] == 3
    assert load_detector("leaf-other").transform.max_size == 160
