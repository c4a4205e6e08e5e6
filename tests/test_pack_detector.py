"""From a training run to a folder of the zoo."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file

from benchmarks.pack_detector import pack_detector
from mvseg.detectors.weights_file import read_weights
from mvseg.errors import InputError
from tiny_training import write_finished_run


@pytest.fixture
def run(tmp_path: Path) -> Path:
    return write_finished_run(tmp_path / "run")


def test_a_packed_run_is_whole(run: Path, tmp_path: Path) -> None:
    (tmp_path / "zoo").mkdir()
    (tmp_path / "zoo" / "card.md").write_text("mine")
    pack_detector(run, tmp_path / "zoo", 160)
    names = {path.name: path for path in (tmp_path / "zoo").iterdir()}
    assert set(names) == {"card.md", "weights.safetensors", "weights.safetensors.sha256", "recipe", "metrics.json"}
    assert names["card.md"].read_text() == "mine"
    assert (names["recipe"] / "train.yaml").read_text() == (run / "config.yaml").read_text()
    assert json.loads(names["metrics.json"].read_text())["validation"]["mask_AP50"] == 0.75
    weights = names["weights.safetensors"]
    stated, name = names["weights.safetensors.sha256"].read_text().split()
    assert (stated, name) == (hashlib.sha256(weights.read_bytes()).hexdigest(), weights.name)
    _, description = read_weights(weights)
    assert description is not None
    assert (description.categories, description.image_size) == (("a", "b", "c"), 160)
    for key, value in load_file(run / "model.safetensors").items():
        stored = load_file(weights)[key]
        assert stored.dtype == (torch.float16 if value.is_floating_point() else value.dtype)
        assert torch.equal(stored, value.to(stored.dtype))


def test_an_unfinished_run_cannot_be_packed(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"model\.safetensors: is missing"):
        pack_detector(tmp_path, tmp_path / "zoo")
    assert not (tmp_path / "zoo").exists()


def test_a_run_that_cannot_be_packed_is_named(run: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="image_size is -5"):
        pack_detector(run, tmp_path / "zoo", -5)
    with pytest.raises(InputError, match=r"metrics\.json: cannot be made"):
        pack_detector(run, run / "metrics.json")
    (run / "metrics.json").write_text("{}")
    with pytest.raises(InputError, match="has no 'best'"):
        pack_detector(run, tmp_path / "zoo")
    assert not (tmp_path / "zoo").exists()
