"""One hash of all that the result of a scene depends on: a result with the same key need not be made again."""

from __future__ import annotations

import hashlib
import json
import os
from dataclasses import asdict
from pathlib import Path
from typing import Any

from mvseg._version import code_hash
from mvseg.errors import InputError
from mvseg.formats.masks.yolo import name_files
from mvseg.runs.request import RunRequest
from mvseg.scene import Scene
from mvseg.system.file_hash import hash_files


def scene_key(scene: Scene, request: RunRequest) -> str:
    """The hash of a scene's inputs and of the options of a request.

    It covers the cameras as they were read; names, sizes and times of photos and masks, which reveal changes without
    reading gigabytes; without masks, the detector's weights; all options and mvseg's code; but not the paths of the
    files. Hidden files are ignored. Raises InputError if a file cannot be read, or the weights are not there.
    """
    options, masks = asdict(request.config), request.masks
    try:
        if masks is None:
            from mvseg.detectors.zoo import weights_path  # loads torchvision

            options["detect"]["weights"] = None  # their hash counts, not their name
            others: Any = hash_files(Path(weights_path(request.config.detect.weights)))
        else:
            del options["detect"]
            others = [_describe_file(path, masks) for path in _mask_files(masks)]
        edits = None if request.corrections is None else hash_files(request.corrections)
        photos = [_describe_file(view.path, view.path.parent) for view in scene.views if view.path.is_file()]
    except OSError as error:
        raise InputError(f"{error.filename}: cannot be read ({error.strerror})") from None
    told = [code_hash(), _describe_scene(scene), photos, others, edits, options]
    return hashlib.sha256(json.dumps(told, default=str).encode()).hexdigest()


def _describe_scene(scene: Scene) -> list[Any]:
    cameras = scene.cameras
    lenses = [
        None if view.lens is None else [view.lens.model_name, view.lens.width, view.lens.height, *view.lens.params]
        for view in scene.views
    ]
    numbers = [tensor.tolist() for tensor in (cameras.K, cameras.R, cameras.t, cameras.sizes)]
    return [scene.name, scene.unit, scene.up, [view.name for view in scene.views], lenses, numbers]


def _describe_file(path: Path, start: Path) -> list[str | int]:
    about = path.stat()
    return [Path(os.path.relpath(path, start)).as_posix(), about.st_size, about.st_mtime_ns]


def _mask_files(masks: Path) -> list[Path]:
    if not masks.is_dir():
        return [masks]
    files = sorted(path for path in masks.rglob("*") if path.is_file() and not path.name.startswith("."))
    return files + [path for path in name_files(masks) if path.is_file() and path.parent != masks]
