"""What the result of a scene depends on, as one hash: a result with the same key need not be made again."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from mvseg._version import code_hash
from mvseg.batch.status import FileHash
from mvseg.config import RunConfig
from mvseg.detectors.zoo import find_weights
from mvseg.errors import InputError
from mvseg.formats.masks.yolo import NAME_FILES
from mvseg.results.provenance import hash_files
from mvseg.scene import Scene


def scene_key(
    scene: Scene, masks: Path | None, config: RunConfig, *, known: Mapping[str, FileHash]
) -> tuple[str, dict[str, FileHash]]:
    """The hash of a scene's inputs and options, and the files that it was made from.

    It covers the cameras as they were understood, the photos, the masks or else the detector's weights, all options
    and mvseg's code; not where the files lie. Hidden files count for nothing.

    Args:
        scene: the scene.
        masks: its masks; None where a detector finds them.
        config: the options.
        known: files that were hashed before: one whose size and time of change are the same is not read again.

    Raises:
        InputError: a file cannot be read, or the weights are not there.
    """
    photos = [view.path for view in scene.views if view.path.is_file()]
    if masks is not None:
        others = _mask_files(masks)
    else:
        others = [find_weights(config.detect.weights) or Path(config.detect.weights)]
    hashes = _hash_all([*photos, *others], known)
    options = asdict(config)
    if masks is not None:
        del options["detect"]
    else:
        options["detect"]["weights"] = None  # their hash counts, not their name
    told = {
        "code": code_hash(),
        "scene": _describe_scene(scene),
        "photos": [[view.name, hashes[str(view.path)][2]] for view in scene.views if str(view.path) in hashes],
        "others": [[_name_below(path, masks), hashes[str(path)][2]] for path in others],
        "options": options,
    }
    return hashlib.sha256(json.dumps(told, default=str).encode()).hexdigest(), hashes


def _describe_scene(scene: Scene) -> list[Any]:
    cameras = scene.cameras
    lenses = [
        None if view.lens is None else [view.lens.model_name, view.lens.width, view.lens.height, *view.lens.params]
        for view in scene.views
    ]
    numbers = [tensor.tolist() for tensor in (cameras.K, cameras.R, cameras.t, cameras.sizes)]
    return [scene.name, scene.unit, scene.up, [view.name for view in scene.views], lenses, numbers]


def _mask_files(masks: Path) -> list[Path]:
    """The files of masks, and the names of classes that may lie in the folder above."""
    if not masks.is_dir():
        return [masks]
    files = sorted(path for path in masks.rglob("*") if path.is_file() and not path.name.startswith("."))
    return files + [masks.parent / name for name in NAME_FILES if (masks.parent / name).is_file()]


def _name_below(path: Path, masks: Path | None) -> str:
    if masks is None:
        return "weights"
    return path.relative_to(masks).as_posix() if path.is_relative_to(masks) and path != masks else path.name


def _hash_all(files: Sequence[Path], known: Mapping[str, FileHash]) -> dict[str, FileHash]:
    hashes = {}
    for path in files:
        try:
            about = path.stat()
            earlier = known.get(str(path))
            if earlier is not None and earlier[:2] == (about.st_size, about.st_mtime_ns):
                hashes[str(path)] = earlier
            else:
                hashes[str(path)] = (about.st_size, about.st_mtime_ns, hash_files(path))
        except OSError as error:
            raise InputError(f"{path}: cannot be read ({error.strerror})") from None
    return hashes
