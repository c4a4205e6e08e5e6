"""The stages of the method: each takes what is known of a scene, and gives it back with more."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mvseg.checks.check_scene import warn_of_contradictions
from mvseg.config import ENOUGH_VIEWS, RunConfig
from mvseg.corrections.apply import Corrected, apply, apply_everywhere
from mvseg.corrections.file import Corrections
from mvseg.corrections.same_scene import named_views
from mvseg.errors import InputWarning, warn
from mvseg.formats.find_views import natural_order
from mvseg.formats.masks.recognise import recognise_masks
from mvseg.formats.photos import Photos, check_photos, require_photos
from mvseg.formats.scene_folder import load_scene, read_masks
from mvseg.masks import Masks, Origin
from mvseg.matching.links import NO_LINKS
from mvseg.matching.match import check_baselines, match_masks
from mvseg.matching.result import Matching, MatchReport
from mvseg.matching.split import split_merged
from mvseg.poses.refine_poses import refine_scene
from mvseg.reconstruction.spread_views import spread_views
from mvseg.regions import stack_regions
from mvseg.results.result import Instances, Result
from mvseg.scene import Cameras, Scene
from mvseg.traits.up import place_scene

if TYPE_CHECKING:
    from mvseg.detection.detect_scene import Found
    from mvseg.verification.choose import Leaves

# What needs torchvision, trimesh or scikit-image is imported where it is used: they take longer to load than small
# scenes to match.


NOTHING_LEFT = "the corrections reject every mask: no leaf is left"
NOTHING_FOUND = Matching(Masks.of(stack_regions([], [], [], labels=[], num_views=0)), MatchReport("none"))


@dataclass(frozen=True, eq=False)
class Unedited:
    """What is known of a scene whose leaves a detector found, before a person says anything.

    Attributes:
        leaves: that the views choose.
        matched: the masks of all matchings that they are chosen from, the sure ones first.
    """

    leaves: Leaves
    matched: tuple[Masks, ...]


@dataclass(frozen=True, eq=False, kw_only=True)
class State(Result):
    """A result in the making, between two stages, and how the run works.

    Attributes:
        config: the options of all stages.
        photos: of the scene.
        matching: the masks as they were given, until they are matched.
        cache: see `run_scene`.
        found: by the detector; None: the masks were given.
        unedited: what the views chose; None: they were not asked, or not yet.
        shown: the masks that edits were applied to; None: none were, or not yet.
        corrected: what edits left; None: the same.
        colors: of leaves, see `colors_of_leaves`; None: those of the masks, wherever a stage asks.
    """

    config: RunConfig
    photos: Photos
    matching: Matching = NOTHING_FOUND
    cache: Path | None = None
    found: Found | None = None
    unedited: Unedited | None = None
    shown: Masks | None = None
    corrected: Corrected | None = None
    colors: NDArray[np.bool_] | None = None

    def with_masks(self, masks: Masks) -> State:
        """The same with other masks. Gaps between their ids close; what is known of the instances follows, but for
        their shapes: those of the same masks are kept, see `fit_kept`."""
        instances = replace(self.instances, surfaces=None, voxels=None).close_gaps(masks)
        return replace(self, matching=self.matching.with_masks(masks.close_gaps()), instances=instances)

    def result(self) -> Result:
        """What the run gives back."""
        result = Result(**{each.name: getattr(self, each.name) for each in fields(Result)})
        return result if self.corrected is None else replace(result, fates=self.corrected.fates)


def load(
    folder: Path, masks: Path | None, config: RunConfig, *, corrections: Corrections | None = None, **how: Any
) -> State:
    """Cameras of the views that are taken, and their masks if there are any.

    Warns (InputWarning) of given masks in views that are left out.
    """
    loaded = load_scene(folder)
    photos = Photos(loaded)
    whole = place_scene(loaded, photos, scale=config.scale, unit=config.unit, up=config.up)
    taken = _take_views(whole, config.views or ("all" if masks else ENOUGH_VIEWS), corrections)
    scene = whole.select(taken)
    left_out = tuple(view.name for index, view in enumerate(whole.views) if index not in taken)
    check_photos(scene)
    check_baselines(scene.cameras)
    photos = photos.select(scene, taken.tolist())
    state = State(config=config, scene=scene, photos=photos, views_left_out=left_out, **how)
    state = replace(state, corrections=corrections)
    if masks is None:
        require_photos(scene, folder)
        return state
    found = recognise_masks(whole, masks)
    regions = read_masks(whole, found, crowd=config.coco_crowd, categories=config.category_names)
    if left_out:
        num_given, regions = len(regions), regions.of_views(taken)
        message = f"{len(taken)} of {len(whole.views)} views are taken (views is {config.views})"
        warn(f"{masks}: {num_given - len(regions)} of {num_given} masks are left out: {message}")
    return replace(state, matching=Matching(Masks.of(regions), MatchReport("none")), mask_kind=found.kind)


def _take_views(scene: Scene, most: int | Literal["all"], corrections: Corrections | None) -> Tensor:
    """(S,) int64, ascending: the views that are taken, see `RunConfig.views`. Their names decide between equally good
    choices, so that the order of the views does not matter."""
    if most == "all":
        return torch.arange(len(scene.views))
    order = torch.tensor(sorted(range(len(scene.views)), key=lambda view: natural_order(scene.views[view].name)))
    taken = order[spread_views(scene.cameras[order], most)].tolist()
    named = [] if corrections is None else named_views(corrections, scene)
    return torch.tensor(sorted({*taken, *named}))


def detect(state: State) -> State:
    """Find instances in every photo, see `detect_scene`."""
    from mvseg.detection.detect_scene import detect_scene

    config = state.config
    found = detect_scene(state.photos, config.detect, match=config.match, cache=state.cache)
    return replace(state, found=found)


def correct(state: State) -> State:
    """Edits of a person change the masks and link them, see `apply`; the next stage matches these.

    These are masks that a person sees: where the views choose, those that they choose without edits, and what else was
    surely detected beside these.

    Warns (InputWarning) of each edit that points at nothing, or that a later one contradicts.
    """
    corrections, masks = state.corrections, state.masks
    assert corrections is not None
    if state.unedited is not None:
        from mvseg.verification.choose import add_beside

        masks = add_beside(state.unedited.leaves.masks, state.unedited.matched[0], state.scene.cameras)
    corrected = apply(corrections, masks, state.scene)
    waits = {number for number, *_ in corrected.refused}  # for `settle_edits`
    for fate in corrected.fates:
        if fate.message and fate.edit not in waits:
            warnings.warn(fate.message, InputWarning, stacklevel=3)
    if len(masks) and not len(corrected.masks):
        warnings.warn(NOTHING_LEFT, InputWarning, stacklevel=3)
    return replace(state, corrected=corrected, shown=masks, instances=Instances(), left=())


def match(state: State) -> State:
    """The same id for masks of the same instance, see `match_masks`."""
    matching = _match_with(state, state.scene.cameras)
    if not len(matching) and not state.mask_kind and state.corrected is None:
        message = f"the detector finds nothing that scores {state.config.detect.min_score:g} or more"
        warnings.warn(message, InputWarning, stacklevel=3)
    return replace(state, matching=matching)


def match_refined(state: State) -> State:
    """The same with refined poses, see `refine_scene`."""
    scene, poses = refine_scene(state.scene, partial(_match_with, state))
    return match(replace(state, scene=scene, poses=poses))


def _match_with(state: State, cameras: Cameras) -> Matching:
    """The masks as they are given, or as edits leave them, or those that a detector finds with these cameras."""
    if state.corrected is None and state.found is not None:
        return state.found.match(cameras)
    given = (state.masks, NO_LINKS) if state.corrected is None else (state.corrected.masks, state.corrected.links)
    return match_masks(given[0], cameras, state.config.match, links=given[1])


def correct_instances(state: State) -> State:
    """Edits of a person about whole instances, see `apply_everywhere`.

    Warns (InputWarning) of each earlier edit that one of them contradicts.
    """
    assert state.corrected is not None
    masks, corrected = apply_everywhere(state.corrected, state.masks.to("cpu"))
    for message in corrected.messages:
        if message not in state.corrected.messages:
            warnings.warn(message, InputWarning, stacklevel=3)
    if len(state.masks) and not len(masks):
        warnings.warn(NOTHING_LEFT, InputWarning, stacklevel=3)
    return replace(state.with_masks(masks), corrected=corrected)


def split(state: State) -> State:
    """Cut masks that show two instances, see `split_merged`."""
    return state.with_masks(split_merged(state.masks))


def choose(state: State) -> State:
    """The views choose leaves and masks from the excessive set, see `choose_leaves`; `select_by_views` for the rest."""
    assert state.found is not None
    with warnings.catch_warnings(action="ignore", category=InputWarning):  # what there is to say, `match` has said
        more = state.found.match_more(state.scene.cameras)
    leaves = _choose_leaves(state, more)
    unedited = Unedited(leaves, (state.masks.to("cpu"), *more))
    return _with_leaves(replace(state, unedited=unedited), leaves)


def choose_corrected(state: State) -> State:
    """The same after edits. What is known without them stays among the candidates."""
    known, shown = state.unedited, state.shown
    assert known is not None
    assert shown is not None
    masks = state.masks.to("cpu")
    leaves = _choose_leaves(state, known.matched, gone=_taken_away(shown, masks))
    return _with_leaves(state, leaves)


def _choose_leaves(state: State, more: Sequence[Masks], **how: Any) -> Leaves:
    """From the masks of a state, and more that are matched; for `how` see `choose_leaves`."""
    from mvseg.verification.choose import choose_leaves

    assert state.found is not None
    return choose_leaves(
        state.masks,
        state.found.proposals(state.scene.cameras),
        cameras=state.scene.cameras,
        more=more,
        min_probability=state.config.detect.min_probability,
        **how,
    )


def _with_leaves(state: State, leaves: Leaves) -> State:
    from mvseg.detection.few_views import select_by_views

    masks = select_by_views(leaves.masks, state.masks, min_views=state.config.detect.min_views)
    instances = Instances(starts=leaves.surfaces, probabilities=leaves.probabilities)
    return replace(state, instances=instances, left=leaves.left).with_masks(masks)


def snap(state: State) -> State:
    """Edges of the detector's masks follow those of colour, see `snap_masks`."""
    from mvseg.verification.snap_edges import snap_masks

    return state.with_masks(snap_masks(state.masks, state.photos))


def say_what_is_missing(state: State) -> State:
    """Warns (InputWarning) where leaves were probably missed, see `describe_missing`."""
    from mvseg.detection.config import SURE_SCORE
    from mvseg.verification.unexplained import describe_missing

    if state.corrected is not None and not len(state.masks):  # a person says that there is none
        return state
    if said := describe_missing(state.masks, state.photos, sure_score=SURE_SCORE):
        warnings.warn(said, InputWarning, stacklevel=3)
    return state


def _taken_away(before: Masks, after: Masks) -> Masks:
    """The detected masks of a table that are not in it any more, after a person's edits."""
    is_left = torch.isin(after.origin.cpu(), torch.tensor([Origin.DETECTED, Origin.CONFIRMED]))
    return before.select(~torch.isin(before.regions.labels, after.regions.labels.cpu()[is_left]))


def check_cameras(state: State) -> State:
    """Warns where masks or photos contradict the cameras, see `warn_of_contradictions`; photos are not asked where ids
    alone are wanted."""
    has_photos = state.config.reconstruct is not None and state.photos.exist
    warn_of_contradictions(state.scene, state.regions, photos=state.photos if has_photos else None)
    return state


def check_ids(state: State) -> State:
    """Surfaces correct the ids, see `mvseg.verification.checked_ids`; those of the other instances are known then."""
    from mvseg.verification import checked_ids

    state = reconstruct(state, with_voxels=False)
    surfaces, cameras = state.surfaces or {}, state.scene.cameras
    checked = checked_ids.check_ids(state.masks, surfaces, cameras=cameras, config=state.config.match)
    num_moved = int((state.masks.instance_ids != checked.instance_ids).sum())
    return replace(state.with_masks(checked), num_moved=num_moved)


def follow(state: State) -> State:
    """The other views of what a person drew get masks, see `follow_drawn`; all others stay as they are."""
    from mvseg.verification.drawn_leaves import follow_drawn

    masks, starts = follow_drawn(
        state.masks,
        cameras=state.scene.cameras,
        photos=state.photos if state.photos.exist else None,
        colors=state.colors,
    )
    return replace(state, instances=Instances(starts=starts)).with_masks(masks)


def reconstruct(state: State, *, with_voxels: bool = True) -> State:
    """A shape for every instance, see `reconstruct_shapes`."""
    from mvseg.reconstruction.shapes import reconstruct_shapes

    assert state.config.reconstruct is not None
    surfaces, voxels = reconstruct_shapes(
        state.regions,
        state.masks.instance_ids,
        state.scene.cameras,
        config=state.config.reconstruct,
        starts=state.instances.starts,
        with_voxels=with_voxels,
    )
    return replace(state, instances=replace(state.instances, surfaces=surfaces, voxels=voxels))


def settle_edits(state: State) -> State:
    """Edits that say "no leaf" where no mask is may answer a question of the page, see `settle`; warns (InputWarning)
    of each that does not."""
    from mvseg.corrections.settle import settle

    assert state.corrected is not None
    surfaces = state.surfaces or state.instances.starts
    left, corrected = settle(state.corrected, state.left, surfaces, cameras=state.scene.cameras)
    waited = {number for number, *_ in corrected.refused}
    for fate in corrected.fates:
        if fate.message and fate.edit in waited:
            warnings.warn(fate.message, InputWarning, stacklevel=3)
    return replace(state, left=left, corrected=corrected)


def measure(state: State) -> State:
    """Traits of the leaves and of the plant, see `measure_plant`."""
    from mvseg.traits.measure import measure_plant

    traits = measure_plant(
        state.scene,
        state.matching,
        surfaces=state.surfaces,
        voxels=state.voxels or {},
        photos=state.photos,
        config=state.config.traits,
    )
    return replace(state, instances=replace(state.instances, traits=traits))
