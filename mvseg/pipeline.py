"""The whole method as a list of stages: each takes what is known of a scene, and gives it back with more."""

from __future__ import annotations

import json
import time
import warnings
from collections.abc import Callable, Mapping
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, field, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from tqdm import tqdm

from mvseg._version import code_hash
from mvseg.checks.contradictions import warn_of_contradictions
from mvseg.config import RunConfig
from mvseg.corrections.apply import Corrected, apply, apply_everywhere
from mvseg.corrections.file import Corrections, load_corrections
from mvseg.detection.cached_detections import KeptDetections, delete_kept, read_detections, write_detections
from mvseg.detection.config import DetectConfig
from mvseg.errors import InputError, InputWarning
from mvseg.formats.lens import opencv_distortion
from mvseg.formats.masks.recognise import recognise_masks
from mvseg.formats.photos import Photos, check_photos, describe_folder
from mvseg.formats.scene_folder import load_scene, read_masks
from mvseg.masks import Masks, Origin
from mvseg.matching.match import check_baselines, match_masks, match_regions
from mvseg.matching.result import Matching
from mvseg.matching.split import split_merged
from mvseg.poses.refine_poses import RefinedPoses, refine_poses
from mvseg.results.provenance import hash_files
from mvseg.results.result import Result
from mvseg.scene import Cameras, Scene
from mvseg.traits.up import find_up

if TYPE_CHECKING:
    from mvseg.detection.mask_rcnn import MultiViewMaskRCNN
    from mvseg.reconstruction.surface.leaf_surface import LeafSurface
    from mvseg.reconstruction.voxels import VoxelGrid
    from mvseg.traits.measure import Traits

# What needs torchvision, trimesh or scikit-image is imported where it is used: they take longer to load than small
# scenes to match.

Match = Callable[[Cameras], Matching]


@dataclass(frozen=True, eq=False)
class State:
    """What is known of a scene between two stages, and how the run works.

    Attributes:
        config: the options of all stages.
        scene: cameras and views.
        photos: of the scene.
        keep, workers, progress: see `run_scene`.
        match: from cameras to the masks of the scene, matched; what `detect` or `load` leaves, or `correct`.
        find: from cameras to the same masks before they are matched.
        corrections: of a person; None: there are none.
        corrected: what came of them.
        matching: the table of masks, and what matching says of the scene.
        poses: what came of refining them; None where that was not asked for.
        starts: {instance id: surface} that the masks were verified with; where the final ones start.
        surfaces, voxels, traits, mask_kind, num_moved: see `Result`; `surfaces` may hold only those that are known
            already until `reconstruct`.
    """

    config: RunConfig
    scene: Scene
    photos: Photos
    keep: Path | None = None
    workers: ProcessPoolExecutor | None = None
    progress: bool = False
    match: Match | None = None
    find: Callable[[Cameras], Masks] | None = None
    corrections: Corrections | None = None
    corrected: Corrected | None = None
    matching: Matching | None = None
    poses: RefinedPoses | None = None
    starts: Mapping[int, LeafSurface] = field(default_factory=dict)
    surfaces: Mapping[int, LeafSurface] | None = None
    voxels: Mapping[int, VoxelGrid] | None = None
    traits: Traits | None = None
    mask_kind: str = ""
    num_moved: int | None = None

    @property
    def matched(self) -> Matching:
        """The matching, for the stages after it."""
        assert self.matching is not None
        return self.matching


Stage = Callable[[State], State]


def run_scene(
    folder: Path,
    masks: Path | None = None,
    config: RunConfig = RunConfig(),
    *,
    corrections: Corrections | Path | None = None,
    keep: Path | None = None,
    workers: ProcessPoolExecutor | None = None,
    progress: bool = False,
) -> Result:
    """From a scene folder, with or without masks, to ids in every view and, if asked for, shapes in 3D and traits.

    Args:
        folder: the scene, see `load_scene`.
        masks: of any kind that `load_masks` reads; None: a detector finds them in the photos.
        config: the options of all stages.
        corrections: of a person, or the file of them, see `load_corrections`; without any edits they change nothing.
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
    begun = time.perf_counter()
    if isinstance(corrections, Path):
        corrections = load_corrections(corrections)
    has_edits = corrections is not None and len(corrections.edits) > 0
    state = load(folder, masks, config, keep=keep, workers=workers, progress=progress)
    state = replace(state, corrections=corrections)
    seconds = {"load": time.perf_counter() - begun}
    for name, stage in list_stages(config, has_masks=masks is not None, has_edits=has_edits).items():
        begun = time.perf_counter()
        state = stage(state)
        seconds[name] = time.perf_counter() - begun
    return Result(
        scene=state.scene,
        matching=state.matched,
        photos=state.photos,
        poses=state.poses,
        surfaces=state.surfaces,
        voxels=state.voxels,
        traits=state.traits,
        seconds=seconds,
        mask_kind=state.mask_kind,
        num_moved=state.num_moved,
        corrections=corrections,
        fates=() if state.corrected is None else state.corrected.fates,
    )


def list_stages(config: RunConfig, *, has_masks: bool, has_edits: bool = False) -> dict[str, Stage]:
    """The stages that a config asks for, in their order.

    Masks that were given are checked by surfaces where they are to be cut, since these know best which ones show two
    leaves. What a detector found is cut before surfaces are fitted to it.
    """
    shapes = config.reconstruct
    is_verified = not has_masks and config.detect.verify
    is_checked = shapes is not None and shapes.check_ids and shapes.shape != "voxels" and not is_verified
    stages = {
        "detect": None if has_masks else detect,
        "correct": correct if has_edits else None,
        "match": match_refined if config.refine_poses else match,
        "correct_instances": correct_instances if has_edits else None,
        "split": split if config.split_merged and not is_checked else None,
        "verify": verify if is_verified else None,
        "check": check_cameras,
        "check_ids": check_ids if is_checked else None,
        "split_checked": split if config.split_merged and is_checked else None,
        "follow": follow if has_edits and has_masks and shapes is not None else None,
        "reconstruct": None if shapes is None else reconstruct,
        "measure": None if shapes is None else measure,
        "recut": recut if is_verified else None,
    }
    return {name: stage for name, stage in stages.items() if stage is not None}


# --- the stages


def load(folder: Path, masks: Path | None, config: RunConfig, **how: Any) -> State:
    """Cameras, and the masks if there are any."""
    scene = place_scene(load_scene(folder), config)
    check_photos(scene)
    check_baselines(scene.cameras)
    state = State(config=config, scene=scene, photos=Photos(scene), **how)
    if masks is None:
        if not state.photos.exist:
            beside = describe_folder(scene.views[0].path.parent)
            end = f"; {beside}" if beside else ""
            raise InputError(f"{folder}: there are neither photos nor masks (--masks), expected one of them{end}")
        return state
    wanted = () if config.categories is None else [name.strip() for name in config.categories.split(",")]
    found = recognise_masks(scene, masks)
    regions = read_masks(scene, found, crowd=config.coco_crowd, categories=wanted)
    matcher = partial(match_regions, regions, config=config.match, progress=state.progress)
    return replace(state, match=matcher, find=lambda _: Masks.of(regions), mask_kind=found.kind)


def detect(state: State) -> State:
    """Find instances in every photo, and again, larger, where the plant fills a small part of the photos.

    Runs on the first GPU, if there is one. One photo at a time is in memory, and those that `Photos` keeps.

    Raises:
        InputError: unknown weights, or a photo that is missing, broken or of another size than its camera says.
    """
    from mvseg.detection.crops import boxes_to_look_at, crop_cameras, place_crops
    from mvseg.detection.mask_rcnn import MultiViewMaskRCNN
    from mvseg.detectors.zoo import load_detector

    options, cameras = state.config.detect, state.scene.cameras
    detector = load_detector(options.weights, image_size=options.image_size, min_score=options.min_score)
    device = "cuda" if torch.cuda.is_available() else "cpu"
    model = MultiViewMaskRCNN(detector, num_iterations=options.num_iterations, match=state.config.match).to(device)
    kept = None if state.keep is None else KeptDetections(state.keep, _describe_detector(options, model, device))
    found, names = _look(model, state, kept=kept)
    # the first look is matched once, and not again by the next stage
    matcher: Match = lru_cache(maxsize=1)(partial(model.match_detections, found, progress=state.progress))
    boxes = None
    if options.crop == "auto":
        boxes = boxes_to_look_at(matcher(cameras).masks, cameras, longest=model.transform.max_size)
    if boxes is not None:
        in_crops, more_names = _look(model, state, boxes, kept=kept)
        names |= more_names

        def matcher(cameras: Cameras) -> Matching:
            matching = model.match_detections(in_crops, crop_cameras(cameras, boxes), progress=state.progress)
            return matching.with_masks(place_crops(matching.masks, boxes))

    if state.keep is not None:
        delete_kept(state.keep, but=names)
    return replace(state, match=matcher, find=lambda cameras: matcher(cameras).masks)


def correct(state: State) -> State:
    """Edits of a person change the masks and link them, see `apply`; the next stage matches these.

    Warns (InputWarning) of each edit that points at nothing, or that a later one contradicts.
    """
    assert state.find is not None
    assert state.corrections is not None
    corrected = apply(state.corrections, state.find(state.scene.cameras), state.scene)
    for message in corrected.messages:
        warnings.warn(message, InputWarning, stacklevel=3)

    def matcher(cameras: Cameras) -> Matching:
        options = state.config.match
        return match_masks(corrected.masks, cameras, options, links=corrected.links, progress=state.progress)

    return replace(state, match=matcher, corrected=corrected)


def match(state: State) -> State:
    """The same id for masks of the same instance, see `match_regions`."""
    assert state.match is not None
    matching = state.match(state.scene.cameras)
    if not len(matching) and not state.mask_kind:
        message = f"the detector finds nothing that scores {state.config.detect.min_score:g} or more"
        warnings.warn(message, InputWarning, stacklevel=3)
    return replace(state, matching=matching)


def match_refined(state: State) -> State:
    """The same with refined poses, see `refine_poses`. Warns (InputWarning) of cameras that no rig file can hold."""
    assert state.match is not None
    poses = refine_poses(state.scene.cameras, state.match)
    odd = [view for view in state.scene.views if view.lens is not None and opencv_distortion(view.lens) is None]
    if odd and poses.is_refined:
        message = f"the refined cameras are not written: view {odd[0].name} has a lens that no rig file can hold"
        warnings.warn(message, InputWarning, stacklevel=3)
    scene = replace(state.scene, cameras=poses.cameras)
    return match(replace(state, scene=scene, poses=poses))


def correct_instances(state: State) -> State:
    """Edits of a person about whole instances, see `apply_everywhere`."""
    assert state.corrected is not None
    masks = apply_everywhere(state.corrected, state.matched.masks.to("cpu"))
    return replace(state, matching=state.matched.with_masks(masks))


def split(state: State) -> State:
    """Cut masks that show two instances; surfaces of these are not known any more."""
    from mvseg.verification.checked_ids import unchanged_surfaces

    before, after = state.matched.masks, split_merged(state.matched.masks)
    surfaces = None if state.surfaces is None else unchanged_surfaces(before, after, state.surfaces)
    return replace(state, matching=state.matched.with_masks(after), surfaces=surfaces)


def verify(state: State) -> State:
    """The other views correct what the detector found, see `verify_masks`, and `select_by_views` for the rest."""
    from mvseg.detection.few_views import select_by_views
    from mvseg.verification.other_views import verify_masks

    masks, starts = verify_masks(
        state.matched.masks,
        cameras=state.scene.cameras,
        photos=state.photos,
        workers=state.workers,
        progress=state.progress,
    )
    masks = select_by_views(masks, state.matched.masks, min_views=state.config.detect.min_views)
    matching = state.matched.with_masks(masks.close_gaps())
    return replace(state, matching=matching, starts=masks.renumber(starts))


def check_cameras(state: State) -> State:
    """Warns where masks or photos contradict the cameras, see `warn_of_contradictions`; photos are not asked where ids
    alone are wanted."""
    has_photos = state.config.reconstruct is not None and state.photos.exist
    warn_of_contradictions(state.scene, state.matched.masks.regions, photos=has_photos, progress=state.progress)
    return state


def check_ids(state: State) -> State:
    """Surfaces correct the ids, see `mvseg.verification.checked_ids`; those of the other instances are known then."""
    from mvseg.verification import checked_ids

    before = state.matched.masks
    surfaces = reconstruct(state, with_voxels=False).surfaces
    assert surfaces is not None
    after = checked_ids.check_ids(before, surfaces, cameras=state.scene.cameras, held=_linked(state))
    known = checked_ids.unchanged_surfaces(before, after, surfaces)
    return replace(
        state,
        matching=state.matched.with_masks(after.close_gaps()),
        surfaces=after.renumber(known),
        num_moved=int((before.instance_ids != after.instance_ids).sum()),
    )


def follow(state: State) -> State:
    """Where masks are given, the other views of what a person drew get masks, too; all others stay as they are."""
    from mvseg.verification.other_views import verify_masks

    before = state.matched.masks.to("cpu")
    drawn = before.instance_ids[(before.origin == Origin.CORRECTED) & (before.instance_ids > 0)]
    if not len(drawn):
        return state
    photos = state.photos if state.photos.exist else None
    every = torch.ones(len(before), dtype=torch.bool)
    after, _ = verify_masks(before, cameras=state.scene.cameras, photos=photos, held=every, workers=state.workers)
    stays = (after.origin != Origin.OTHER_VIEWS) | torch.isin(after.instance_ids, drawn)
    return replace(state, matching=state.matched.with_masks(after.select(stays)), surfaces=None)


def reconstruct(state: State, *, with_voxels: bool = True) -> State:
    """A shape for every instance, see `reconstruct_shapes`."""
    from mvseg.reconstruction.shapes import reconstruct_shapes

    assert state.config.reconstruct is not None
    masks = state.matched.masks
    surfaces, voxels = reconstruct_shapes(
        masks.regions,
        masks.instance_ids,
        state.scene.cameras,
        config=state.config.reconstruct,
        starts=state.starts,
        known=state.surfaces or {},
        with_voxels=with_voxels,
        workers=state.workers,
        progress=state.progress,
    )
    return replace(state, surfaces=surfaces, voxels=voxels)


def measure(state: State) -> State:
    """Traits of the leaves and of the plant, see `measure_plant`."""
    from mvseg.traits.color_correction import correct_views
    from mvseg.traits.measure import measure_plant

    traits = measure_plant(
        state.scene,
        state.matched,
        surfaces=state.surfaces,
        voxels=state.voxels or {},
        photos=state.photos,
        config=state.config.traits,
        corrections=correct_views(state.scene, state.config.color_card),
    )
    return replace(state, traits=traits)


def recut(state: State) -> State:
    """Cut the detector's masks anew by their surfaces, see `recut_masks`."""
    from mvseg.verification.recut import recut_masks

    masks = recut_masks(state.matched.masks, state.surfaces or state.starts, cameras=state.scene.cameras)
    return replace(state, matching=state.matched.with_masks(masks))


# --- parts of the stages


def place_scene(scene: Scene, config: RunConfig) -> Scene:
    """The scene in the world that the user asks for: scale, unit and direction of up.

    Warns (InputWarning) of a unit that contradicts the scene's and comes without a scale, and of an up that the cameras
    contradict (`Scene.seems_upside_down`).

    Raises:
        InputError: a scale of cameras that say their unit, without the unit of the lengths after it; up cannot be
            found, see `find_up`.
    """
    if config.scale is not None:
        if config.unit is None and scene.unit and config.scale != 1:
            problem = f"scale is {config.scale:g} without a unit, but the cameras are in {scene.unit}"
            raise InputError(f"{problem}: expected the unit of the scaled lengths, too, as in --unit {scene.unit}")
        scene = replace(scene, cameras=scene.cameras.scale(config.scale))
    if config.unit is not None:
        if scene.unit not in ("", config.unit) and config.scale is None:
            message = f"the cameras are in {scene.unit}: unit {config.unit} without a scale only renames it"
            warnings.warn(message, InputWarning, stacklevel=3)
        scene = replace(scene, unit=config.unit)
    scene = find_up(scene, config.up)
    if scene.seems_upside_down:
        message = "up may be upside down: the cameras look up at the plant, or hang upside down; if not, reverse it"
        warnings.warn(message, InputWarning, stacklevel=3)
    return scene


def _linked(state: State) -> torch.Tensor | None:
    """(D,) bool, the masks that a person links with others; None without any."""
    if state.corrected is None or state.corrected.everywhere or not len(state.corrected.links):
        return None
    held = torch.zeros(len(state.matched), dtype=torch.bool)
    held[torch.cat((state.corrected.links.must, state.corrected.links.cannot)).flatten()] = True
    return held


def detect_regions(
    scene: Scene, config: RunConfig = RunConfig(), *, keep: Path | None = None, progress: bool = False
) -> Matching:
    """Find and match the instances in the photos of a scene: the stages `detect` and `match`.

    For `keep` see `run_scene`.
    """
    return match(detect(State(config=config, scene=scene, photos=Photos(scene), keep=keep, progress=progress))).matched


def _look(
    model: MultiViewMaskRCNN, state: State, boxes: torch.Tensor | None = None, *, kept: KeptDetections | None
) -> tuple[list[dict[str, torch.Tensor]], set[str]]:
    """What the detector finds in every photo, or in its box (V, 4) xyxy, and the names of the files that keep it."""
    found, names, scene = [], set(), state.scene
    device = next(model.parameters()).device
    for view in tqdm(range(len(scene.views)), desc="detection", unit="view", disable=not state.progress):
        box = None if boxes is None else boxes[view].tolist()
        path = kept.path(scene, view, box) if kept is not None and state.photos.exist else None
        shown = None if path is None else read_detections(path)
        if shown is None:
            x1, y1, x2, y2 = box or (0, 0, *scene.cameras.sizes[view].tolist())
            photo = torch.from_numpy(state.photos(view)[y1:y2, x1:x2].copy()).to(device).permute(2, 0, 1)
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
    options |= {"num_iterations": None, "verify": None, "crop": None, "min_views": None}
    options |= {"proposals": [model.proposal_iou, model.proposals_per_view], "code": code_hash()}
    return json.dumps(options | {"torch": torch.__version__, "device": device})
