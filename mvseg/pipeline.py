"""The whole method as a list of calls."""

from __future__ import annotations

import hashlib
import platform
import time
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from tqdm import tqdm

import mvseg
from mvseg.config import DetectConfig, MatchConfig, ReconstructConfig
from mvseg.detectors.zoo import find_weights, load_detector
from mvseg.errors import InputError, InputWarning
from mvseg.formats.photos import check_photos, read_photo
from mvseg.formats.scene_folder import load_masks, load_scene
from mvseg.matching.match_regions import Matching, match_regions, split_merged
from mvseg.multiview.mask_rcnn import MultiViewMaskRCNN, Proposals
from mvseg.reconstruction.voxels import reconstruct_instances
from mvseg.results.folder import Result
from mvseg.scene import Scene


def run_scene(
    folder: Path,
    masks: Path | None,
    match: MatchConfig | None = None,
    reconstruct: ReconstructConfig | None = None,
    *,
    detect: DetectConfig | None = None,
    progress: bool = False,
) -> Result:
    """From a scene folder, with or without masks, to instances, with ids in every view and, if asked for, in 3D.

    Args:
        folder: the scene, see `load_scene`.
        masks: label PNGs or COCO JSON, see `load_masks`; None: a detector finds them in the photos.
        match: how regions are matched; None for the defaults.
        reconstruct: how instances become voxels; None for ids only.
        detect: how instances are found without masks; None for the defaults.
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
        regions = load_masks(scene, masks) if masks is not None else None
    if masks is None and not scene.views[0].path.is_file():
        raise InputError(f"{folder}: there are neither photos nor masks (--masks), expected one of them")
    scores = None
    if regions is None:
        with _timed(seconds, "detect"):
            found, matching = detect_regions(scene, detect or DetectConfig(), match, progress=progress)
            regions, scores = found.regions, found.scores
    else:
        with _timed(seconds, "match"):
            matching = match_regions(regions, scene.cameras, match, progress=progress)
    if match is not None and match.split_merged:
        regions, matching, source = split_merged(regions, matching)
        scores = None if scores is None else scores[source]
    shapes = None
    if reconstruct is not None:
        with _timed(seconds, "reconstruct"):
            shapes = reconstruct_instances(
                regions, matching.instance_ids, scene.cameras, reconstruct, progress=progress
            )
    return Result(scene, regions, matching, shapes, seconds, scores)


def detect_regions(
    scene: Scene, detect: DetectConfig, match: MatchConfig | None, *, progress: bool = False
) -> tuple[Proposals, Matching]:
    """Find and match the instances in the photos of a scene, see `MultiViewMaskRCNN.find_regions`.

    Runs on the first GPU, if there is one. Torch's number of threads and generators stay as they are.

    Raises:
        InputError: unknown weights, or a photo that is missing, broken or of another size than its camera says.
    """
    detector = load_detector(detect.weights, image_size=detect.image_size, min_score=detect.min_score)
    device = "cuda" if torch.cuda.is_available() else "cpu"
    model = MultiViewMaskRCNN(detector, num_iterations=detect.num_iterations, match=match).to(device)
    views = tqdm(range(len(scene.views)), desc="detection", unit="view", disable=not progress)
    photos = (torch.from_numpy(read_photo(scene, view)).to(device).permute(2, 0, 1).float() / 255 for view in views)
    found, matching = model.find_regions(photos, scene.cameras)
    if not len(found.regions):
        nothing = f"the detector finds nothing that scores {detect.min_score:g} or more"
        warnings.warn(nothing, InputWarning, stacklevel=3)
    return found, matching


@contextmanager
def _timed(seconds: dict[str, float], stage: str) -> Iterator[None]:
    start = time.perf_counter()
    yield
    seconds[stage] = time.perf_counter() - start


def describe_run(result: Result, masks: Path | None, config: dict[str, Any], remarks: list[str]) -> dict[str, Any]:
    """What run.json says of where a result comes from: version, inputs with their SHA-256, config, warnings.

    `masks` is None for a result of a detector, whose weights `config["detect"]` names.
    """
    if masks is None:
        weights = config["detect"]["weights"]
        masks = find_weights(weights) or Path(weights)
    inputs = {str(path): _hash_files(path) for path in (result.scene.source, masks) if path is not None}
    return {
        "mvseg": mvseg.__version__,
        "torch": torch.__version__,
        "python": platform.python_version(),
        "scene": result.scene.name,
        "inputs": inputs,
        "config": config,
        "warnings": remarks,
    }


def _hash_files(path: Path) -> str:
    """SHA-256 of a file; of a folder, that of the lines "<SHA-256 of the file>  <its path>", sorted by path."""
    if not path.is_dir():
        return hashlib.sha256(path.read_bytes()).hexdigest()
    files = sorted(file for file in path.rglob("*") if file.is_file())
    lines = [f"{_hash_files(file)}  {file.relative_to(path).as_posix()}\n" for file in files]
    return hashlib.sha256("".join(lines).encode()).hexdigest()
