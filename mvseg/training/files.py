"""The files of a training run. Each is written whole: to a temporary name first, then moved over the old one."""

from __future__ import annotations

import json
import logging
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import safetensors.torch
import torch
import yaml  # type: ignore[import-untyped]
from torch import nn

from mvseg.errors import InputError

logger = logging.getLogger(__name__)


def write_whole(path: Path, write: Callable[[Path], Any]) -> None:
    """Let `write` make a file under a temporary name, then move it to `path`: a reader, or a run that was killed at any
    moment, finds the old content or the new one, never a part."""
    partial = path.with_name(path.name + ".partial")
    write(partial)
    with partial.open("rb+") as file:
        os.fsync(file.fileno())
    os.replace(partial, path)


def write_text_whole(path: Path, text: str) -> None:
    write_whole(path, lambda partial: partial.write_text(text, encoding="utf-8"))


def write_config(path: Path, config: Mapping[str, Any]) -> None:
    """Write the resolved config as YAML; plain values only."""
    write_text_whole(path, yaml.safe_dump(dict(config), sort_keys=False))


def write_metrics(path: Path, metrics: Mapping[str, Any]) -> None:
    write_text_whole(path, json.dumps(metrics, indent=2, allow_nan=False) + "\n")


def write_weights(path: Path, model: nn.Module, metadata: Mapping[str, str]) -> None:
    """Write a model's state dict as .safetensors, on the CPU and contiguous."""
    state = {key: value.detach().cpu().contiguous() for key, value in model.state_dict().items()}
    content = safetensors.torch.save(state, dict(metadata))  # save_file would make a file that only its owner can read
    write_whole(path, lambda partial: partial.write_bytes(content))


def write_checkpoint(path: Path, content: Mapping[str, Any]) -> None:
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
    """Forget the records after `step`, and a torn last line: what a killed run did after its last checkpoint."""
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


def open_tensorboard(folder: Path, step: int) -> Any | None:
    """A TensorBoard writer that goes on after `step`, or None, with one line in the log, when it is not installed."""
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError:
        logger.info("tensorboard is not installed (pip install tensorboard): losses go to log.jsonl only")
        return None
    return SummaryWriter(str(folder), purge_step=step + 1)
