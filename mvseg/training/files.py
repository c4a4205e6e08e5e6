"""The files of a training run; all but the growing log are written whole or not at all."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
import yaml  # type: ignore[import-untyped]
from torch import nn

from mvseg.detectors.weights_file import Description, encode_weights
from mvseg.errors import InputError
from mvseg.system.atomic import write_text_whole, write_whole


def write_config(path: Path, config: Mapping[str, Any]) -> None:
    """Write the resolved config as YAML; plain values only."""
    write_text_whole(path, yaml.safe_dump(dict(config), sort_keys=False))


def write_metrics(path: Path, metrics: Mapping[str, Any]) -> None:
    """Write metrics as JSON; numbers must be finite."""
    write_text_whole(path, json.dumps(metrics, indent=2, allow_nan=False) + "\n")


def write_weights(path: Path, model: nn.Module, description: Description) -> None:
    """Write a model's state dict as .safetensors."""
    content = encode_weights(model.state_dict(), description)
    write_whole(path, lambda partial: partial.write_bytes(content))


def write_checkpoint(path: Path, content: Mapping[str, Any]) -> None:
    """Write a checkpoint; `read_checkpoint` reads it."""
    write_whole(path, lambda partial: torch.save(dict(content), partial))


def read_checkpoint(path: Path, device: torch.device) -> dict[str, Any]:
    """Read what `write_checkpoint` wrote; nothing in the file is executed.

    Raises:
        InputError: the file is not such a checkpoint.
    """
    try:
        content = torch.load(path, map_location=device, weights_only=True)
        content["model"], content["optimizer"], content["step"], content["config"]
    except Exception as error:  # torch.load has no common exception for a damaged file
        raise InputError(f"{path} is not a checkpoint of a training run ({type(error).__name__})") from error
    return content


def append_record(path: Path, record: Mapping[str, Any]) -> None:
    """Add a line of JSON to a log."""
    with path.open("a", encoding="utf-8") as file:
        file.write(json.dumps(record) + "\n")


def cut_log(path: Path, step: int) -> None:
    """Remove the records after `step`, and a torn last line: what a killed run did after its last checkpoint."""
    if not path.is_file():
        return
    kept = []
    for line in path.read_text(encoding="utf-8").splitlines():
        try:
            record = json.loads(line)
        except json.JSONDecodeError:
            break
        if record["step"] <= step:
            kept.append(line + "\n")
    write_text_whole(path, "".join(kept))
