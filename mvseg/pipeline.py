"""The whole method as a list of calls."""

from __future__ import annotations

import time
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

import torch
from tqdm import tqdm

from mvseg.config import RunConfig
from mvseg.detectors.zoo import load_detector
from mvseg.errors import InputError, InputWarning
from mvseg.formats.photos import check_photos, read_photo
from mvseg.formats.scene_folder import load_masks, load_scene
from mvseg.matching.match import match_regions
from mvseg.matching.result import Matching
from mvseg.matching.split import split_merged
from mvseg.multiview.mask_rcnn import MultiViewMaskRCNN
from mvseg.multiview.proposals import Proposals
from mvseg.reconstruction.config import ReconstructConfig
from mvseg.reconstruction.surface.fit_surfaces import fit_surfaces
from mvseg.reconstruction.surface.leaf_surface import LeafSurface
from mvseg.reconstruction.voxels import VoxelGrid, reconstruct_instances
from mvseg.regions import Regions
from mvseg.results.result import Result
from mvseg.scene import Scene


def run_scene(
    folder: Path, masks: Path | None = None, config: RunConfig = RunConfig(), *, progress: bool = False
) -> Result:
    """From a scene folder, with or without masks, to instances with ids in every view and, if asked for, shapes in 3D.

    Args:
        folder: the scene, see `load_scene`.
        masks: label PNGs or COCO JSON, see `load_masks`; None: a detector finds them in the photos.
        config: the options of all stages.
        progress: show progress bars.

    Returns:
        The result; nothing is written.

    Raises:
        InputError: bad input; see the stages.
    """
    seconds: dict[str, float] = {}
    scores = None
    with _timed(seconds, "load"):
        scene = load_scene(folder)
        check_photos(scene)
        regions = load_masks(scene, masks, crowd=config.coco_crowd) if masks is not None else None
    if masks is None and not scene.views[0].path.is_file():
        raise InputError(f"{folder}: there are neither photos nor masks (--masks), expected one of them")
    if regions is None:
        with _timed(seconds, "detect"):
            detections, matching = detect_regions(scene, config, progress=progress)
            regions, scores = detections.regions, detections.scores
    else:
        with _timed(seconds, "match"):
            matching = match_regions(regions, scene.cameras, config.match, progress=progress)
    if config.split_merged:
        regions, matching, source = split_merged(regions, matching)
        scores = None if scores is None else scores[source]
    shapes: Mapping[int, VoxelGrid | LeafSurface] | None = None
    if config.reconstruct is not None:
        with _timed(seconds, "reconstruct"):
            shapes = reconstruct(regions, matching, scene, config=config.reconstruct, progress=progress)
    return Result(
        scene=scene, regions=regions, matching=matching, shapes=shapes, seconds=seconds, detection_scores=scores
    )


def detect_regions(
    scene: Scene, config: RunConfig = RunConfig(), *, progress: bool = False
) -> tuple[Proposals, Matching]:
    """Find and match the instances in the photos of a scene, see `MultiViewMaskRCNN.find_regions`.

    Runs on the first GPU, if there is one. Torch's thread count and random generators are left alone.

    Raises:
        InputError: unknown weights, or a photo that is missing, broken or of another size than its camera says.
    """
    detect = config.detect
    detector = load_detector(detect.weights, image_size=detect.image_size, min_score=detect.min_score)
    device = "cuda" if torch.cuda.is_available() else "cpu"
    model = MultiViewMaskRCNN(detector, num_iterations=detect.num_iterations, match=config.match).to(device)
    views = tqdm(range(len(scene.views)), desc="detection", unit="view", disable=not progress)
    photos = (torch.from_numpy(read_photo(scene, view)).to(device).permute(2, 0, 1).float() / 255 for view in views)
    detections, matching = model.find_regions(photos, scene.cameras)
    if not len(detections.regions):
        message = f"the detector finds nothing that scores {detect.min_score:g} or more"
        warnings.warn(message, InputWarning, stacklevel=3)
    return detections, matching


def reconstruct(
    regions: Regions, matching: Matching, scene: Scene, *, config: ReconstructConfig, progress: bool = False
) -> Mapping[int, VoxelGrid | LeafSurface]:
    """{instance id: shape}, as `config.shape` says."""
    if config.shape == "surface":
        return fit_surfaces(regions, matching.instance_ids, scene.cameras, progress=progress)
    return reconstruct_instances(regions, matching.instance_ids, scene.cameras, config=config, progress=progress)


@contextmanager
def _timed(seconds: dict[str, float], stage: str) -> Iterator[None]:
    start = time.perf_counter()
    yield
    seconds[stage] = time.perf_counter() - start
