"""The whole method as a list of calls."""

from __future__ import annotations

import json
import time
import warnings
from collections.abc import Iterator, Mapping
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import torch
from tqdm import tqdm

from mvseg._version import __version__
from mvseg.config import RunConfig
from mvseg.detection.cached_detections import KeptDetections, delete_kept, read_detections, write_detections
from mvseg.detection.config import DetectConfig
from mvseg.errors import InputError, InputWarning
from mvseg.formats.lens import opencv_distortion
from mvseg.formats.masks.recognise import recognise_masks
from mvseg.formats.photos import check_photos, describe_folder, read_photo
from mvseg.formats.scene_folder import load_scene, read_masks
from mvseg.matching.match import check_baselines, match_regions
from mvseg.matching.result import Matching
from mvseg.matching.split import split_merged
from mvseg.results.provenance import hash_files
from mvseg.results.result import Result
from mvseg.scene import Scene
from mvseg.traits.up import find_up

if TYPE_CHECKING:
    from mvseg.detection.mask_rcnn import MultiViewMaskRCNN
    from mvseg.masks import Proposals
    from mvseg.reconstruction.surface.leaf_surface import LeafSurface

# What needs torchvision, trimesh or scikit-image is imported where it is used: they take longer to load than small
# scenes to match.


def run_scene(
    folder: Path,
    masks: Path | None = None,
    config: RunConfig = RunConfig(),
    *,
    keep: Path | None = None,
    workers: ProcessPoolExecutor | None = None,
    progress: bool = False,
) -> Result:
    """From a scene folder, with or without masks, to ids in every view and, if asked for, shapes in 3D and traits.

    Args:
        folder: the scene, see `load_scene`.
        masks: of any kind that `load_masks` reads; None: a detector finds them in the photos.
        config: the options of all stages.
        keep: folder for the detections in this scene's photos, made when it is needed: a run that was cut off goes on
            from them, and one with other options of later stages uses them again. What it holds of other photos or
            options is deleted; `delete_kept` deletes the rest.
        workers: processes that surfaces are fitted in, see `start_workers`; None: this one.
        progress: show progress bars.

    Returns:
        The result; nothing is written but what `keep` says.

    Raises:
        InputError: bad input; see the stages.
    """
    seconds: dict[str, float] = {}
    scores = from_views = None
    starts: dict[int, LeafSurface] = {}
    with _timed(seconds, "load"):
        scene = place_scene(load_scene(folder), config)
        check_photos(scene)
        check_baselines(scene.cameras)
        wanted = () if config.categories is None else [name.strip() for name in config.categories.split(",")]
        found = None if masks is None else recognise_masks(scene, masks)
        regions = None if found is None else read_masks(scene, found, crowd=config.coco_crowd, categories=wanted)
    if masks is None and not scene.views[0].path.is_file():
        beside = describe_folder(scene.views[0].path.parent)
        end = f"; {beside}" if beside else ""
        raise InputError(f"{folder}: there are neither photos nor masks (--masks), expected one of them{end}")
    if regions is None:
        with _timed(seconds, "detect"):
            detections, matching = detect_regions(scene, config, keep=keep, prune=True, progress=progress)
            scene = pose_scene(scene, matching)
        if config.detect.witnesses:
            with _timed(seconds, "witnesses"):
                from mvseg.verification.other_views import hear_witnesses

                detections, matching, starts = hear_witnesses(
                    detections,
                    matching,
                    cameras=scene.cameras,
                    photos=partial(read_photo, scene),
                    workers=workers,
                    progress=progress,
                )
        regions, scores, from_views = detections.regions, detections.scores, detections.from_views
    else:
        with _timed(seconds, "match"):
            matching = match_regions(regions, scene.cameras, config.match, progress=progress)
            scene = pose_scene(scene, matching)
    shapes = config.reconstruct
    is_checked = shapes is not None and shapes.check_ids and shapes.shape != "voxels" and from_views is None
    if config.split_merged and not is_checked:
        regions, matching, source = split_merged(regions, matching)
        scores = None if scores is None else scores[source]
        from_views = None if from_views is None else from_views[source]
    surfaces: Mapping[int, LeafSurface] | None = None
    voxels = traits = moved = None
    if shapes is not None:
        with _timed(seconds, "reconstruct"):
            from mvseg.reconstruction.shapes import reconstruct_shapes

            reconstruct = partial(
                reconstruct_shapes,
                cameras=scene.cameras,
                config=shapes,
                photos=partial(read_photo, scene) if scene.views[0].path.is_file() else None,
                workers=workers,
                progress=progress,
            )
            surfaces, voxels = reconstruct(regions, matching.instance_ids, starts=starts)
            if is_checked and surfaces is not None:
                from mvseg.verification.checked_ids import check_ids

                checked = check_ids(regions, matching, surfaces, cameras=scene.cameras)
                matching, moved, known = checked.matching, int(checked.is_moved.sum()), checked.unchanged(surfaces)
                cut: set[int] = set()
                if config.split_merged:
                    cut = {instance for mask in matching.merged for instance in (mask.own, mask.other)}
                    known = {instance: surface for instance, surface in known.items() if instance not in cut}
                    regions, matching, source = split_merged(regions, matching)
                    scores = None if scores is None else scores[source]
                if moved or cut:
                    surfaces, voxels = reconstruct(regions, matching.instance_ids, known=known)
        with _timed(seconds, "measure"):
            from mvseg.traits.measure import measure_plant

            traits = measure_plant(scene, regions, matching, surfaces=surfaces, voxels=voxels, config=config.traits)
    if from_views is not None:
        from mvseg.verification.recut import recut_masks

        regions = recut_masks(
            regions, matching.instance_ids, surfaces or starts, cameras=scene.cameras, is_found=~from_views
        )
    return Result(
        scene=scene,
        regions=regions,
        matching=matching,
        surfaces=surfaces,
        voxels=voxels,
        traits=traits,
        seconds=seconds,
        detection_scores=scores,
        from_other_views=from_views,
        mask_kind="" if found is None else found.kind,
        num_moved=moved,
    )


def place_scene(scene: Scene, config: RunConfig) -> Scene:
    """The scene in the world that the user asks for: scale, unit and direction of up.

    Warns (InputWarning) of a unit that contradicts the scene's and comes without a scale.

    Raises:
        InputError: up cannot be found, see `find_up`.
    """
    if config.scale is not None:
        scene = replace(scene, cameras=scene.cameras.scale(config.scale))
    if config.unit is not None:
        if scene.unit not in ("", config.unit) and config.scale is None:
            message = f"the cameras are in {scene.unit}: unit {config.unit} without a scale only renames it"
            warnings.warn(message, InputWarning, stacklevel=3)
        scene = replace(scene, unit=config.unit)
    return find_up(scene, config.up)


def pose_scene(scene: Scene, matching: Matching) -> Scene:
    """The scene with the poses that its masks were matched with, see `MatchConfig.refine_poses`.

    Warns (InputWarning) of refined cameras that no rig file can hold.
    """
    if matching.poses is None or not matching.poses.is_refined:
        return scene
    odd = [view for view in scene.views if view.lens is not None and opencv_distortion(view.lens) is None]
    if odd:
        message = f"the refined cameras are not written: view {odd[0].name} has a lens that no rig file can hold"
        warnings.warn(message, InputWarning, stacklevel=3)
    return replace(scene, cameras=matching.poses.cameras)


def detect_regions(
    scene: Scene,
    config: RunConfig = RunConfig(),
    *,
    keep: Path | None = None,
    prune: bool = False,
    progress: bool = False,
) -> tuple[Proposals, Matching]:
    """Find and match the instances in the photos of a scene, see `MultiViewMaskRCNN.find_regions`.

    Runs on the first GPU, if there is one. Torch's thread count and random generators are left alone. One photo at a
    time is in memory. For `keep` see `run_scene`; `prune` deletes what it holds of other photos and options.

    Raises:
        InputError: unknown weights, or a photo that is missing, broken or of another size than its camera says.
    """
    from mvseg.detection.crops import boxes_to_look_at, crop_cameras, place_crops
    from mvseg.detection.mask_rcnn import MultiViewMaskRCNN
    from mvseg.detectors.zoo import load_detector

    detect = config.detect
    detector = load_detector(detect.weights, image_size=detect.image_size, min_score=detect.min_score)
    device = "cuda" if torch.cuda.is_available() else "cpu"
    model = MultiViewMaskRCNN(
        detector, num_iterations=detect.num_iterations, scales=detect.scales, match=config.match
    ).to(device)
    kept = None if keep is None else KeptDetections(keep, _describe_detector(detect, model, device))
    found, names = _look(model, scene, kept=kept, progress=progress)
    detections, matching = model.match_detections(found, scene.cameras, progress=progress)
    if detect.crop == "auto":
        longest = model.transform.max_size
        boxes = boxes_to_look_at(detections.regions, matching, scene.cameras, longest=longest)
        if boxes is not None:
            found, more_names = _look(model, scene, boxes, kept=kept, progress=progress)
            cropped = crop_cameras(scene.cameras, boxes)
            detections, matching = model.match_detections(found, cropped, progress=progress)
            detections, names = place_crops(detections, boxes), names | more_names
            if matching.poses is not None:  # of the crops
                posed = replace(matching.poses.cameras, K=scene.cameras.K, sizes=scene.cameras.sizes)
                matching = replace(matching, poses=replace(matching.poses, cameras=posed))
    if keep is not None and prune:
        delete_kept(keep, but=names)
    if not len(detections.regions):
        message = f"the detector finds nothing that scores {detect.min_score:g} or more"
        warnings.warn(message, InputWarning, stacklevel=3)
    return detections, matching


def _look(
    model: MultiViewMaskRCNN,
    scene: Scene,
    boxes: torch.Tensor | None = None,
    *,
    kept: KeptDetections | None,
    progress: bool,
) -> tuple[list[dict[str, torch.Tensor]], set[str]]:
    """What the detector finds in every photo, or in its box (V, 4) xyxy, and the names of the files that keep it."""
    found, names = [], set()
    device = next(model.parameters()).device
    for view in tqdm(range(len(scene.views)), desc="detection", unit="view", disable=not progress):
        box = None if boxes is None else boxes[view].tolist()
        path = kept.path(scene, view, box) if kept is not None and scene.views[view].path.is_file() else None
        shown = None if path is None else read_detections(path)
        if shown is None:
            x1, y1, x2, y2 = box or (0, 0, *scene.cameras.sizes[view].tolist())
            photo = torch.from_numpy(read_photo(scene, view)[y1:y2, x1:x2]).to(device).permute(2, 0, 1)
            shown = model.detect(photo.float().div_(255))
            if path is not None:
                write_detections(path, shown)
        if path is not None:
            names.add(path.name)
        found.append(shown)
    return found, names


def _describe_detector(detect: DetectConfig, model: MultiViewMaskRCNN, device: str) -> str:
    """Everything but the photo that detections depend on. (What the views say of them does not change them.)"""
    from mvseg.detectors.zoo import find_weights

    weights = find_weights(detect.weights) or Path(detect.weights)
    options = asdict(detect) | {"weights": hash_files(weights)}
    options |= {"num_iterations": None, "witnesses": None, "crop": None}
    options |= {"proposals": [model.proposal_iou, model.proposals_per_view], "mvseg": __version__}
    return json.dumps(options | {"torch": torch.__version__, "device": device})


@contextmanager
def _timed(seconds: dict[str, float], stage: str) -> Iterator[None]:
    start = time.perf_counter()
    yield
    seconds[stage] = time.perf_counter() - start
