"""The whole method as a list of calls."""

from __future__ import annotations

import hashlib
import platform
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch

import mvseg
from mvseg.config import MatchConfig, ReconstructConfig
from mvseg.formats.folder import load_masks, load_scene
from mvseg.formats.photos import check_photos
from mvseg.matching import match_regions
from mvseg.reconstruction import reconstruct_instances
from mvseg.result import Result


def run_scene(
    folder: Path,
    masks: Path,
    match: MatchConfig | None = None,
    reconstruct: ReconstructConfig | None = None,
    *,
    progress: bool = False,
) -> Result:
    """From a scene folder and masks to instances, with ids in every view and, if asked for, in 3D.

    Args:
        folder: the scene, see `load_scene`.
        masks: label PNGs or COCO JSON, see `load_masks`.
        match: how regions are matched; None for the defaults.
        reconstruct: how instances become voxels; None for ids only.
        progress: show progress bars.

    Returns:
        The result; nothing is written.

    Raises:
        InputError: the input is wrong; see the stages.
    """
    seconds: dict[str, float] = {}
    with _timed(seconds, "load"):
        scene = load_scene(folder)
        check_photos(scene)
        regions = load_masks(scene, masks)
    with _timed(seconds, "match"):
        matching = match_regions(regions, scene.cameras, match, progress=progress)
    shapes = None
    if reconstruct is not None:
        with _timed(seconds, "reconstruct"):
            shapes = reconstruct_instances(
                regions, matching.instance_ids, scene.cameras, reconstruct, progress=progress
            )
    return Result(scene, regions, matching, shapes, seconds)


@contextmanager
def _timed(seconds: dict[str, float], stage: str) -> Iterator[None]:
    start = time.perf_counter()
    yield
    seconds[stage] = time.perf_counter() - start


def describe_run(result: Result, masks: Path, config: dict[str, Any], warnings: list[str]) -> dict[str, Any]:
    """What run.json says of where a result comes from: version, inputs with their SHA-256, config, warnings."""
    source = result.scene.source
    inputs = {str(path): _hash_files(path) for path in (source, masks) if path is not None}
    return {
        "mvseg": mvseg.__version__,
        "torch": torch.__version__,
        "python": platform.python_version(),
        "scene": result.scene.name,
        "inputs": inputs,
        "config": config,
        "warnings": warnings,
    }


def _hash_files(path: Path) -> str:
    """SHA-256 of a file; of a folder, that of the lines "<SHA-256 of the file>  <its path>", sorted by path."""
    if not path.is_dir():
        return hashlib.sha256(path.read_bytes()).hexdigest()
    files = sorted(file for file in path.rglob("*") if file.is_file())
    lines = [f"{_hash_files(file)}  {file.relative_to(path).as_posix()}\n" for file in files]
    return hashlib.sha256("".join(lines).encode()).hexdigest()
