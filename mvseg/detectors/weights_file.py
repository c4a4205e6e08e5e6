"""Weights files of detectors: read without executing anything in them, written, described.

A file of this project is a .safetensors whose metadata says what it holds: "arch", "categories" (a JSON list, without
background) and "image_size".
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import safetensors.torch
import torch
from safetensors import safe_open
from torch import Tensor, nn

from mvseg.detectors import MAX_IMAGE_SIZE, MIN_IMAGE_SIZE
from mvseg.errors import InputError

DETECTOR_FILE = "detector.safetensors"  # in a result folder: the weights that have learned its plant


@dataclass(frozen=True)
class Description:
    """Description of a detector in its weights file: architecture, see `list_architectures`; categories without
    background; and the longer side, in pixels, that photos are scaled to."""

    arch: str
    categories: tuple[str, ...]
    image_size: int


def encode_weights(state: Mapping[str, Tensor], description: Description) -> bytes:
    """The content of a .safetensors file. (safetensors itself would write a file that only its owner can read.)"""
    plain = {key: value.detach().cpu().contiguous() for key, value in state.items()}
    categories, image_size = json.dumps(description.categories), str(description.image_size)
    metadata = {"arch": description.arch, "categories": categories, "image_size": image_size}
    return _sort_metadata(safetensors.torch.save(plain, metadata))


def _sort_metadata(content: bytes) -> bytes:
    end = 8 + int.from_bytes(content[:8], "little")
    header = json.loads(content[8:end])
    header["__metadata__"] = dict(sorted(header["__metadata__"].items()))
    text = json.dumps(header, separators=(",", ":"), ensure_ascii=False).encode()
    text += b" " * (-len(text) % 8)  # tensors start at a multiple of 8
    return len(text).to_bytes(8, "little") + text + content[end:]


def read_weights(path: Path) -> tuple[dict[str, Tensor], Description | None]:
    """State dict and description of a weights file; None where it has no description. Of a checkpoint that holds a
    moving average, that is what is read. Raises InputError if there is no such file, it is neither a .safetensors nor a
    checkpoint of tensors, or the description is malformed."""
    if not path.is_file():
        raise InputError(f"weights '{path}' are neither a file nor a name that torchvision has for this architecture")
    try:
        if path.suffix == ".safetensors":
            with safe_open(path, framework="pt") as file:
                state = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118
                metadata = file.metadata() or {}
            return state, _read_description(path, metadata)
        content = torch.load(path, map_location="cpu", weights_only=True)
    except InputError:
        raise
    except Exception as error:  # a damaged file may raise anything in torch.load
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise InputError(f"{path} cannot be read as weights ({reason})") from error
    if isinstance(content, dict):
        parts = [content.get(key) for key in ("ema", "model")]
        content = next((part for part in parts if isinstance(part, dict) and part), content)
    if not isinstance(content, dict) or not all(isinstance(value, Tensor) for value in content.values()):
        raise InputError(f"{path} holds no state dict, expected one, or one under 'ema' or 'model'")
    return content, None


def _read_description(path: Path, metadata: Mapping[str, str]) -> Description | None:
    if not {"arch", "categories", "image_size"} <= metadata.keys():
        return None
    try:
        categories = json.loads(metadata["categories"])
    except (ValueError, RecursionError):
        categories = None
    if not isinstance(categories, list) or not categories or not all(isinstance(name, str) for name in categories):
        found = metadata["categories"][:40]
        raise InputError(f"{path}: its metadata say categories '{found}', expected a JSON list of names")
    size = metadata["image_size"]
    if not (size.isascii() and size.isdigit() and MIN_IMAGE_SIZE <= int(size[:9]) <= MAX_IMAGE_SIZE):
        expected = f"pixels from {MIN_IMAGE_SIZE} to {MAX_IMAGE_SIZE}"
        raise InputError(f"{path}: its metadata say image_size '{size[:40]}', expected {expected}")
    return Description(metadata["arch"], tuple(categories), int(size))


def load_weights(model: nn.Module, state: Mapping[str, Tensor]) -> None:
    """Load a state dict that must fit exactly. Raises InputError, a reason that names the first missing, unknown or
    differently shaped parameter."""
    try:
        keys = model.load_state_dict(dict(state), strict=False)
    except RuntimeError as error:
        detail = str(error).splitlines()[1].strip() if "\n" in str(error) else str(error)
        raise InputError(detail) from error
    for kind, names in (("lacks", keys.missing_keys), ("has the unknown", keys.unexpected_keys)):
        if names:
            raise InputError(f"it {kind} {names[0]} (and {len(names) - 1} more)")
