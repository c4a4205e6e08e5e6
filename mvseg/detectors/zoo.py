"""The zoo: detectors that ship with mvseg, by name.

A detector is a folder of its name with

    weights.safetensors          float16; arch, categories and image_size in the file's metadata
    weights.safetensors.sha256   one line, as `sha256sum` writes and checks it
    recipe/                      the configs that it was trained with: `mvseg train --config recipe/train.yaml`
    metrics.json                 what it reached
    card.md                      data, intended use, limits

`benchmarks/pack_detector.py` makes such a folder from a training run.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torchvision.models.detection import MaskRCNN
from torchvision.models.detection.transform import GeneralizedRCNNTransform

from mvseg.detectors.mask_rcnn import build_detector
from mvseg.detectors.weights_file import DETECTOR_FILE, read_weights
from mvseg.errors import InputError

WEIGHTS, HASH = "weights.safetensors", "weights.safetensors.sha256"
# an installed mvseg carries models/ inside the package, a checkout has it beside the package
HOMES = (Path(str(files("mvseg") / "zoo")), Path(str(files("mvseg"))).parent / "models")


@dataclass(frozen=True)
class ZooEntry:
    """Detector that ships under the name of its folder; `sha256` is that of the weights, as the folder states it."""

    name: str
    weights: Path
    sha256: str
    metrics: dict[str, Any]


def list_detectors() -> tuple[ZooEntry, ...]:
    """The shipped detectors, sorted by name; the hash is read here and checked by `find_weights`. Raises InputError if
    a folder lacks its metrics, or its hash cannot be read."""
    return tuple(_read_entry(folder) for _, folder in sorted(_list_folders().items()))


def _list_folders() -> dict[str, Path]:
    return {path.parent.name: path.parent for home in reversed(HOMES) for path in home.glob(f"*/{HASH}")}


def _read_entry(folder: Path) -> ZooEntry:
    try:
        stated = (folder / HASH).read_text(encoding="utf-8").split()[0]
        metrics = json.loads((folder / "metrics.json").read_text(encoding="utf-8"))
    except (OSError, ValueError, IndexError) as error:
        raise InputError(f"{folder} is not a complete detector ({type(error).__name__}: {error})") from error
    return ZooEntry(name=folder.name, weights=folder / WEIGHTS, sha256=stated, metrics=metrics)


def find_weights(name: str) -> Path | None:
    """The weights file of a shipped detector, its hash checked; None when none of that name ships. Raises InputError if
    the file is missing, or its SHA-256 is not the one stated beside it."""
    folder = _list_folders().get(name)
    if folder is None:
        return None
    entry = _read_entry(folder)
    if not entry.weights.is_file():
        raise InputError(f"{entry.weights}: the weights of '{name}' are missing, expected a complete installation")
    actual = hashlib.sha256(entry.weights.read_bytes()).hexdigest()
    if actual != entry.sha256:
        found = f"the SHA-256 is {actual[:12]}..., expected {entry.sha256[:12]}..."
        raise InputError(f"{entry.weights}: {found}: the file is damaged")
    return entry.weights


def weights_path(name: str | Path) -> Path:
    """The weights file of a shipped detector, or that of a result whose plant a detector has learned, or else the path
    itself, which need not exist; see `find_weights`. Raises InputError for a folder without a learned detector."""
    if (shipped := find_weights(str(name))) is not None or not Path(name).is_dir():
        return shipped or Path(name)
    learned = Path(name) / DETECTOR_FILE
    if not learned.is_file():
        raise InputError(f"{name}: holds no {DETECTOR_FILE}, expected a result whose detector has learned its plant")
    return learned


def load_detector(weights: str | Path, *, image_size: int | None = None, min_score: float | None = None) -> MaskRCNN:
    """A trained detector, in eval mode, on the CPU, in float32.

    Args:
        weights: the name of a shipped detector (`list_detectors`), a .safetensors file that a training run wrote, or a
            result folder whose plant a detector has learned.
        image_size: longer side, in pixels, that photos are scaled to. None: larger photos are scaled down to the
            size that the file states, smaller ones are not scaled.
        min_score: detections that score less are discarded; `mvseg infer` does so at 0.3. None for torchvision's 0.05.

    Raises:
        InputError: neither a name nor a readable file, a wrong hash, or a file that does not say what it holds.
    """
    path = weights_path(weights)
    if not path.is_file():
        names = ", ".join(sorted(_list_folders())) or "none"
        raise InputError(f"'{weights}' is neither a shipped detector ({names}) nor a file of weights")
    _, description = read_weights(path)
    if description is None:
        raise InputError(f"{path} does not say its architecture, expected a model.safetensors of a training run")
    with torch.random.fork_rng(devices=[]):  # random weights are drawn before the file's take their place
        num_classes = len(description.categories) + 1
        detector = build_detector(description.arch, num_classes, str(path), image_size=image_size)
    if min_score is not None:
        detector.roi_heads.score_thresh = min_score
    if image_size is None:
        own = detector.transform
        detector.transform = _ShrinkOnly(own.min_size, own.max_size, own.image_mean, own.image_std, own.size_divisible)
    return detector.eval()


class _ShrinkOnly(GeneralizedRCNNTransform):  # type: ignore[misc]  # torchvision carries no types
    """Leaves photos alone whose longer side is at most `max_size`."""

    def resize(self, image: Tensor, target: dict[str, Tensor] | None = None) -> tuple[Tensor, dict[str, Tensor] | None]:
        return (image, target) if max(image.shape[-2:]) <= self.max_size else super().resize(image, target)
