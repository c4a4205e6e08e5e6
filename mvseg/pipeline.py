"""The whole method as a list of stages: each takes what is known of a scene, and gives it back with more."""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Mapping
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from mvseg.checks.contradictions import warn_of_contradictions
from mvseg.config import RunConfig
from mvseg.corrections.apply import Corrected, apply, apply_everywhere, fates_everywhere
from mvseg.corrections.file import Corrections, load_corrections
from mvseg.errors import InputWarning
from mvseg.formats.masks.recognise import recognise_masks
from mvseg.formats.photos import Photos, check_photos, require_photos
from mvseg.formats.scene_folder import load_scene, read_masks
from mvseg.masks import Masks
from mvseg.matching.match import check_baselines, match_masks, match_regions
from mvseg.matching.result import Matching
from mvseg.matching.split import split_merged
from mvseg.poses.refine_poses import RefinedPoses, refine_scene
from mvseg.results.result import Result
from mvseg.scene import Cameras, Scene
from mvseg.traits.world_frame import place_scene

if TYPE_CHECKING:
    from mvseg.reconstruction.surface.leaf_surface import LeafSurface
    from mvseg.reconstruction.voxels import VoxelGrid
    from mvseg.traits.measure import Traits

# What needs torchvision, trimesh or scikit-image is imported where it is used: they take longer to load than small
# scenes to match.


@dataclass(frozen=True, eq=False)
class State:
    """What is known of a scene between two stages, and how the run works.

    Attributes:
        config: the options of all stages.
        scene: cameras and views.
        photos: of the scene.
        cache, workers, progress: see `run_scene`.
        find: from cameras to the masks of the scene; what `load` or `detect` leaves.
        match: from cameras to the same masks, matched; what `load`, `detect` or `correct` leaves.
        corrections: of a person; None: there are none.
        corrected: what came of them.
        matching: the table of masks, and what matching says of the scene.
        poses: what came of refining them; None where that was not asked for.
        colors: of leaves, see `leaf_colors`; None: those of the masks, wherever a stage asks.
        starts: {instance id: surface} that the masks were verified with; where the final ones start.
        surfaces, voxels, traits, mask_kind, num_moved: see `Result`; `surfaces` may hold only those that are known
            already until `reconstruct`.
    """

    config: RunConfig
    scene: Scene
    photos: Photos
    cache: Path | None = None
    workers: ProcessPoolExecutor | None = None
    progress: bool = False
    find: Callable[[Cameras], Masks] | None = None
    match: Callable[[Cameras], Matching] | None = None
    corrections: Corrections | None = None
    corrected: Corrected | None = None
    matching: Matching | None = None
    poses: RefinedPoses | None = None
    colors: NDArray[np.bool_] | None = None
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

    def with_masks(self, masks: Masks) -> State:
        """The same with another state of the table of masks."""
        return replace(self, matching=self.matched.with_masks(masks))

    def result(self, seconds: Mapping[str, float] = MappingProxyType({})) -> Result:
        """What the run gives back; `seconds`: {stage: wall time}."""
        return Result(
            scene=self.scene,
            matching=self.matched,
            photos=self.photos,
            poses=self.poses,
            surfaces=self.surfaces,
            voxels=self.voxels,
            traits=self.traits,
            seconds=dict(seconds),
            mask_kind=self.mask_kind,
            num_moved=self.num_moved,
            corrections=self.corrections,
            fates=() if self.corrected is None else self.corrected.fates,
        )


Stage = Callable[[State], State]


def run_scene(
    folder: Path,
    masks: Path | None = None,
    config: RunConfig = RunConfig(),
    *,
    corrections: Corrections | Path | None = None,
    cache: Path | None = None,
    workers: ProcessPoolExecutor | None = None,
    progress: bool = False,
) -> Result:
    """From a scene folder, with or without masks, to ids in every view and, if asked for, shapes in 3D and traits.

    Args:
        folder: the scene, see `load_scene`.
        masks: of any kind that `load_masks` reads; None: a detector finds them in the photos.
        config: the options of all stages.
        corrections: of a person, or the file of them, see `load_corrections`; without any edits they change nothing.
        cache: folder for the detections in this scene's photos, made when it is needed: a run that was cut off goes on
            from them, and one with other options of later stages uses them again. What it holds of other photos or
            options is deleted; `delete_cached` deletes the rest.
        workers: processes that surfaces are fitted in, see `start_workers`; None: this one.
        progress: show progress bars.

    Returns:
        The result; nothing is written but what `cache` says.

    Raises:
        InputError: bad input; see the stages.
    """
    begun = time.perf_counter()
    if isinstance(corrections, Path):
        corrections = load_corrections(corrections)
    has_edits = corrections is not None and len(corrections.edits) > 0
    state = load(folder, masks, config, cache=cache, workers=workers, progress=progress)
    state = replace(state, corrections=corrections)
    seconds = {"load": time.perf_counter() - begun}
    for name, stage in list_stages(config, has_masks=masks is not None, has_edits=has_edits).items():
        begun = time.perf_counter()
        state = stage(state)
        seconds[name] = time.perf_counter() - begun
    return state.result(seconds)


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
        "follow": follow if has_edits and (is_verified or shapes is not None) else None,
        "split": split if config.split_merged and not is_checked else None,
        "verify": verify if is_verified else None,
        "check": check_cameras,
        "check_ids": check_ids if is_checked else None,
        "split_checked": split if config.split_merged and is_checked else None,
        "reconstruct": None if shapes is None else reconstruct,
        "measure": None if shapes is None else measure,
        "recut": recut if is_verified else None,
    }
    return {name: stage for name, stage in stages.items() if stage is not None}


# --- the stages


def load(folder: Path, masks: Path | None, config: RunConfig, **how: Any) -> State:
    """Cameras, and the masks if there are any."""
    scene = place_scene(load_scene(folder), scale=config.scale, unit=config.unit, up=config.up)
    check_photos(scene)
    check_baselines(scene.cameras)
    state = State(config=config, scene=scene, photos=Photos(scene), **how)
    if masks is None:
        require_photos(scene, folder)
        return state
    found = recognise_masks(scene, masks)
    regions = read_masks(scene, found, crowd=config.coco_crowd, categories=config.category_names)
    matcher = partial(match_regions, regions, config=config.match, progress=state.progress)
    return replace(state, match=matcher, find=lambda _: Masks.of(regions), mask_kind=found.kind)


def detect(state: State) -> State:
    """Find instances in every photo, see `detect_scene`."""
    from mvseg.detection.detect_scene import detect_scene

    config = state.config
    matcher = detect_scene(state.photos, config.detect, match=config.match, cache=state.cache, progress=state.progress)
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
    options = state.config.match
    matcher = partial(match_masks, corrected.masks, config=options, links=corrected.links, progress=state.progress)
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
    """The same with refined poses, see `refine_scene`."""
    assert state.match is not None
    scene, poses = refine_scene(state.scene, state.match)
    return match(replace(state, scene=scene, poses=poses))


def correct_instances(state: State) -> State:
    """Edits of a person about whole instances, see `apply_everywhere`.

    Warns (InputWarning) of each earlier edit that one of them contradicts.
    """
    assert state.corrected is not None
    before = state.matched.masks.to("cpu")
    corrected = replace(state.corrected, fates=fates_everywhere(state.corrected, before))
    for message in corrected.messages:
        if message not in state.corrected.messages:
            warnings.warn(message, InputWarning, stacklevel=3)
    masks = apply_everywhere(corrected, before)
    return replace(state.with_masks(masks), corrected=corrected)


def split(state: State) -> State:
    """Cut masks that show two instances; surfaces of these are not known any more."""
    from mvseg.verification.checked_ids import unchanged_surfaces

    before, after = state.matched.masks, split_merged(state.matched.masks)
    surfaces = None if state.surfaces is None else unchanged_surfaces(before, after, state.surfaces)
    return replace(state.with_masks(after), surfaces=surfaces)


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
    return replace(state.with_masks(masks.close_gaps()), starts=masks.renumber(starts))


def check_cameras(state: State) -> State:
    """Warns where masks or photos contradict the cameras, see `warn_of_contradictions`; photos are not asked where ids
    alone are wanted."""
    has_photos = state.config.reconstruct is not None and state.photos.exist
    warn_of_contradictions(state.scene, state.matched.masks.regions, photos=has_photos, progress=state.progress)
    return state


def check_ids(state: State) -> State:
    """Surfaces correct the ids, see `mvseg.verification.checked_ids`; those of the other instances are known then."""
    from mvseg.verification import checked_ids

    before, surfaces = state.matched.masks, reconstruct(state, with_voxels=False).surfaces or {}
    held = None
    if state.corrected is not None and not state.corrected.everywhere:  # these edits change the rows that links name
        held = state.corrected.links.named(len(before))
    after = checked_ids.check_ids(before, surfaces, cameras=state.scene.cameras, held=held)
    known = after.renumber(checked_ids.unchanged_surfaces(before, after, surfaces))
    num_moved = int((before.instance_ids != after.instance_ids).sum())
    return replace(state.with_masks(after.close_gaps()), surfaces=known, num_moved=num_moved)


def follow(state: State) -> State:
    """The other views of what a person drew get masks, see `follow_drawn`; all others stay as they are."""
    from mvseg.verification.drawn_leaves import follow_drawn

    masks, starts = follow_drawn(
        state.matched.masks,
        cameras=state.scene.cameras,
        photos=state.photos if state.photos.exist else None,
        colors=state.colors,
        workers=state.workers,
    )
    return replace(state.with_masks(masks), starts=starts)


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

    surfaces = state.surfaces or state.starts
    return state.with_masks(recut_masks(state.matched.masks, surfaces, cameras=state.scene.cameras))
