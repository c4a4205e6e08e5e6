"""Weights files: there and back, and every way to get them wrong."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import load_file, save_file

from mvseg.detectors.weights_file import Description, encode_weights, load_weights, read_weights
from mvseg.errors import InputError

STATE = {"weight": torch.arange(6.0).reshape(2, 3), "bias": torch.ones(2)}
DESCRIPTION = Description("resnet18_fpn", ("leaf", "Stängel"), 320)


def test_weights_and_description_come_back_and_those_of_others_have_none(tmp_path: Path) -> None:
    path = tmp_path / "model.safetensors"
    path.write_bytes(encode_weights({**STATE, "weight": STATE["weight"].T}, DESCRIPTION))
    state, description = read_weights(path)
    assert description == DESCRIPTION
    assert torch.equal(state["weight"], STATE["weight"].T)  # a view, written out
    assert torch.equal(load_file(path)["bias"], STATE["bias"])
    save_file(STATE, tmp_path / "model.safetensors", {"format": "pt"})
    torch.save(STATE, tmp_path / "model.pt")
    for name in ("model.safetensors", "model.pt"):
        state, description = read_weights(tmp_path / name)
        assert description is None
        assert torch.equal(state["weight"], STATE["weight"])


@pytest.mark.parametrize("key", ["ema", "model"])
def test_the_state_in_a_checkpoint_is_read_the_average_first(key: str, tmp_path: Path) -> None:
    torch.save({"ema": None, "model": {"weight": torch.zeros(1)}, "step": 3} | {key: STATE}, tmp_path / "model.pt")
    assert torch.equal(read_weights(tmp_path / "model.pt")[0]["bias"], STATE["bias"])


@pytest.mark.parametrize("content", [{"a": 3}, [1, 2], *({key: torch.ones(3), "step": 3} for key in ("ema", "model"))])
def test_files_that_hold_something_else(tmp_path: Path, content: Any) -> None:
    torch.save(content, tmp_path / "weights.pt")
    with pytest.raises(InputError, match=r"weights\.pt holds no state dict"):
        read_weights(tmp_path / "weights.pt")


@pytest.mark.parametrize("name", ["weights.pt", "weights.safetensors"])
def test_weights_that_cannot_be_read(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_bytes(b"torn off")
    with pytest.raises(InputError, match=f"{name} cannot be read as weights"):
        read_weights(tmp_path / name)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        *(("categories", value) for value in ("leaf", "3", "null", "[", "[]", '"leaf"', "[[1]]", "[" * 10_000)),
        *(("image_size", value) for value in ("large", "x", "0", "-5", "31", "1000000", "9" * 5000, "5_12")),
    ],
    ids=lambda value: value[:8],
)
def test_a_malformed_description(tmp_path: Path, key: str, value: str) -> None:
    metadata = {"arch": "resnet18_fpn", "categories": '["leaf"]', "image_size": "320"}
    save_file(STATE, tmp_path / "weights.safetensors", metadata | {key: value})
    with pytest.raises(InputError, match=rf"weights\.safetensors: its metadata say {key} "):
        read_weights(tmp_path / "weights.safetensors")


def test_equal_weights_make_equal_files() -> None:
    """safetensors itself writes the metadata in a new order each time."""
    files = {encode_weights(STATE, DESCRIPTION) for _ in range(20)}
    assert len(files) == 1


@pytest.mark.parametrize(
    ("state", "message"),
    [
        ({"weight": STATE["weight"]}, r"it lacks bias \(and 0 more\)"),
        (STATE | {"more": torch.zeros(1)}, r"it has the unknown more \(and 0 more\)"),
        (STATE | {"bias": torch.zeros(5)}, "size mismatch for bias"),
    ],
)
def test_weights_must_fit_exactly(state: dict[str, torch.Tensor], message: str) -> None:
    with pytest.raises(InputError, match=message):
        load_weights(torch.nn.Linear(3, 2), state)
