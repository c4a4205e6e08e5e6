"""The whole method: from a scene's folder to the same id for a leaf in every view, and its shape.

`run_scene` is the page to begin with. Everybody calls the same lines: `mvseg infer` and `mvseg batch` call it, and the
page that a person corrects keeps one `Known`, and calls those that follow.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray

from mvseg.checks.check_scene import warn_of_contradictions
from mvseg.config import RunConfig
from mvseg.corrections.apply import Fate, Refused, apply, apply_everywhere
from mvseg.corrections.file import Corrections, load_corrections
from mvseg.corrections.same_scene import check_made_for
from mvseg.corrections.settle import settle
from mvseg.detection.cached_detections import CachedDetections
from mvseg.errors import collect_warnings, warn
from mvseg.masks import Masks, Origin
from mvseg.matching.match import match_masks
from mvseg.matching.result import Matching
from mvseg.matching.split import split_merged
from mvseg.open_scene import Opened, open_scene
from mvseg.poses.refine_poses import RefinedPoses, refine_scene
from mvseg.results.result import Instances, Result
from mvseg.scene import Scene
from mvseg.system.running import running, timed
from mvseg.verification.leaf_color import colors_of_leaves

if TYPE_CHECKING:
    from mvseg.reconstruction.config import ReconstructConfig
    from mvseg.reconstruction.surface.leaf_surface import LeafSurface
    from mvseg.verification.choose import Leaves, LeftOut

# What needs torchvision, trimesh or scikit-image is imported where it is used: they take longer to load than small
# scenes to match.

NOTHING_LEFT = "the corrections reject every mask: no leaf is left"


def run_scene(
    folder: Path | str,
    masks: Path | str | None = None,
    config: RunConfig = RunConfig(),
    *,
    corrections: Corrections | Path | str | None = None,
    force_corrections: bool = False,
    cache: Path | str | None = None,
) -> Result:
    """From a scene folder, with or without masks, to ids in every view and, if asked for, shapes in 3D and traits.

    Args:
        folder: the scene, see `load_scene`.
        masks: of any kind that `load_masks` reads; None: a detector finds them in the photos.
        config: the options of all stages.
        corrections: of a person, or the file of them, see `load_corrections`; without any edits they change nothing.
        force_corrections: apply them even if they were made for other photos.
        cache: folder for the detections in this scene's photos, made when it is needed: a run that was cut off goes on
            from them, and one with other options of later stages uses them again. What it holds of other photos or
            options is deleted; `delete_cached` deletes the rest.

    Returns:
        The result; nothing is written but what `cache` says.

    Raises:
        InputError: bad input; corrections of another scene; see the stages.
    """
    if isinstance(corrections, Path | str):
        corrections = load_corrections(corrections)
    with running(keep=True) as now:
        opened = open_scene(folder, masks, config, corrections=corrections)
        if corrections is not None and not force_corrections:
            check_made_for(corrections, opened.photos)
        kept = None if cache is None else CachedDetections(Path(cache))
        known = find_leaves(opened, cache=kept) if opened.given is None else match_given(opened, opened.given)
        if corrections is not None and corrections.edits:
            known = apply_edits(known, corrections)
        result = finish(known)
        if kept is not None:
            kept.delete_others()
    return replace(result, corrections=corrections, seconds=now.seconds)


# --- which mask shows which leaf


@dataclass(frozen=True, eq=False)
class Known:
    """What is known of a scene: which mask shows which leaf, and what else there is to choose from.

    Attributes:
        opened: the scene as it was opened.
        scene: the same, with refined cameras where they were asked for, and are better.
        matching: the masks with their ids, and what matching says of the scene.
        instances: `starts` and `probabilities` of those that the views chose; nothing else.
        proposals: R masks on the CPU, the excessive set of the detector; those that were given.
        matched: tables of masks of it that are matched, the sure ones first; () where masks were given.
        left: candidates that the views did not choose.
        poses: what came of refining the cameras; None: nobody asked for it.
        edits: what came of a person's edits; () without any.
        refused: pixels where a person says that no leaf is, and where no mask is.
    """

    opened: Opened
    scene: Scene
    matching: Matching
    instances: Instances
    proposals: Masks
    matched: tuple[Masks, ...]
    left: tuple[LeftOut, ...]
    poses: RefinedPoses | None
    edits: tuple[Fate, ...] = ()
    refused: tuple[Refused, ...] = ()

    @property
    def masks(self) -> Masks:
        """The table of masks."""
        return self.matching.masks

    @cached_property
    def leaf_colors(self) -> NDArray[np.bool_]:
        """The colours of leaves, see `colors_of_leaves`."""
        return colors_of_leaves(self.masks.to("cpu"), self.opened.photos)

    def with_masks(self, masks: Masks) -> Known:
        """The same with other masks. Gaps between their ids close; what is known of the instances follows."""
        return replace(
            self, matching=self.matching.with_masks(masks.close_gaps()), instances=self.instances.close_gaps(masks)
        )


def match_given(opened: Opened, given: Masks) -> Known:
    """The same id for given masks of the same leaf, see `match_masks`."""
    config, scene, poses = opened.config, opened.scene, None
    with timed("match"):
        match = partial(match_masks, given, config=config.match)
        if config.refine_poses:
            scene, poses = refine_scene(scene, match)
        matching = match(scene.cameras)
    known = Known(opened, scene, matching, Instances(), proposals=given.to("cpu"), matched=(), left=(), poses=poses)
    return _cut_merged(known)


def find_leaves(opened: Opened, *, cache: CachedDetections | None = None) -> Known:
    """Look for leaves in the photos, at the size at which the views agree best; the views choose leaves and masks."""
    from mvseg.detection.choose_size import choose_size
    from mvseg.detection.detect_scene import detect_scene
    from mvseg.detection.find_leaves import Found, find_leaves

    config, detect, scene, poses = opened.config, opened.config.detect, opened.scene, None
    splits = config.split_merged and not opened.is_checked
    with collect_warnings() as said:
        look = detect_scene(opened.photos, detect, match=config.match, cache=cache)
        if config.refine_poses:
            scene, poses = refine_scene(scene, partial(look.match, min_score=detect.min_score))
            look = look.with_cameras(scene.cameras, detect.min_score)
        found = find_leaves([look], scene.cameras, config=detect, splits=splits)
    found = replace(found, said=tuple(said))

    def see(size: int) -> Found:
        with collect_warnings() as said:
            at_size = replace(detect, image_size=size)
            other = detect_scene(opened.photos, at_size, match=config.match, cache=cache, boxes=look.boxes)
            posed = other if poses is None else other.with_cameras(scene.cameras, detect.min_score)
            found = find_leaves([posed], scene.cameras, config=detect, splits=splits)
        return replace(found, said=tuple(said))

    if detect.image_size is None and opened.is_chosen and (look.boxes is None or not found.is_familiar):
        found = choose_size(see, found)
    for sentence in found.said:
        warn(sentence)
    if not len(found.looks[0].sure):
        warn(f"the detector finds nothing that scores {detect.min_score:g} or more")
    matching = Matching(found.matched[0], found.report)
    known = Known(opened, scene, matching, Instances(), found.proposals, found.matched, left=(), poses=poses)
    return _choose(known, found.leaves) if opened.is_chosen else known


def apply_edits(known: Known, corrections: Corrections) -> Known:
    """What a person says changes masks and links them, and these are matched anew, see `mvseg.corrections.apply`.

    Edits are about masks that a person sees: those that were given, or those that the views chose, and what else was
    surely detected beside these.
    """
    from mvseg.verification.choose import add_beside, choose_leaves
    from mvseg.verification.drawn_leaves import follow_drawn

    opened, cameras, config = known.opened, known.scene.cameras, known.opened.config
    shown = known.masks if opened.given is None else known.proposals
    if opened.is_chosen:
        shown = add_beside(known.masks, known.matched[0], cameras)
    with timed("correct"):
        corrected = apply(corrections, shown, known.scene)
    with timed("match"):
        matching = match_masks(corrected.masks, cameras, config.match, links=corrected.links)
    masks, corrected = apply_everywhere(corrected, matching.masks.to("cpu"))
    if len(shown) and not len(masks):
        warn(NOTHING_LEFT)
    edited = replace(
        known, matching=matching, instances=Instances(), left=(), edits=corrected.fates, refused=corrected.refused
    ).with_masks(masks)
    if opened.is_chosen or config.reconstruct is not None:
        with timed("follow"):
            photos = opened.photos if opened.photos.exist else None
            colors = known.leaf_colors if photos is not None and known.matching.num_instances else None
            masks, starts = follow_drawn(edited.masks, cameras=cameras, photos=photos, colors=colors)
            edited = replace(edited, instances=Instances(starts=starts)).with_masks(masks)
    edited = _cut_merged(edited)
    if not opened.is_chosen:
        return edited
    with timed("choose"):
        masks = edited.masks.to("cpu")
        leaves = choose_leaves(
            masks,
            known.proposals,
            cameras=cameras,
            more=known.matched,
            gone=_taken_away(shown, masks),
            min_probability=config.detect.min_probability,
        )
    return _choose(edited, leaves)


def _choose(known: Known, leaves: Leaves) -> Known:
    """The same with the leaves that the views chose."""
    from mvseg.detection.few_views import select_by_views

    masks = select_by_views(leaves.masks, known.masks, min_views=known.opened.config.detect.min_views)
    instances = Instances(starts=leaves.surfaces, probabilities=leaves.probabilities)
    return replace(known, instances=instances, left=leaves.left).with_masks(masks)


def _cut_merged(known: Known) -> Known:
    """Masks that show two leaves are cut, where that is asked for; surfaces know best which ones do, so where they
    check the ids, they come first."""
    is_cut = known.opened.config.split_merged and not known.opened.is_checked
    return known.with_masks(split_merged(known.masks)) if is_cut else known


def _taken_away(before: Masks, after: Masks) -> Masks:
    """The detected masks of a table that are not in it any more, after a person's edits."""
    is_left = torch.isin(after.origin.cpu(), torch.tensor([Origin.DETECTED, Origin.CONFIRMED]))
    return before.select(~torch.isin(before.regions.labels, after.regions.labels.cpu()[is_left]))


# --- the result


def finish(known: Known) -> Result:
    """The final masks and ids, shapes and traits; and what there is to say of them."""
    result, config = shape_leaves(known), known.opened.config
    _warn_of_missing(known, result)
    with timed("check"):
        has_photos = config.reconstruct is not None and known.opened.photos.exist
        warn_of_contradictions(result.scene, result.regions, photos=known.opened.photos if has_photos else None)
    return result if config.reconstruct is None else _measure(result, config, config.reconstruct)


def shape_leaves(known: Known) -> Result:
    """The final masks and ids, and their surfaces: what the page shows that a person corrects.

    Warns (InputWarning) of each edit that points at nothing, is odd, or contradicted by a later one.
    """
    opened, config, num_moved = known.opened, known.opened.config, None
    if opened.is_chosen:
        from mvseg.verification.snap_edges import snap_masks

        with timed("snap"):
            known = known.with_masks(snap_masks(known.masks, opened.photos))
    if opened.is_checked:
        from mvseg.verification.checked_ids import check_ids

        fitted = _fit_surfaces(known)
        with timed("check_ids"):
            checked = check_ids(known.masks, fitted, cameras=known.scene.cameras, config=config.match)
        num_moved = int((known.masks.instance_ids != checked.instance_ids).sum())
        known = known.with_masks(split_merged(checked.close_gaps()) if config.split_merged else checked)
    has_surfaces = config.reconstruct is not None and config.reconstruct.shape != "voxels"
    surfaces = _fit_surfaces(known) if has_surfaces else None
    shown = surfaces or known.instances.starts
    left, fates = settle(known.edits, known.refused, known.left, shown, cameras=known.scene.cameras)
    for fate in fates:
        if fate.message:
            warn(fate.message)
    return Result(
        scene=known.scene,
        matching=known.matching,
        instances=replace(known.instances, surfaces=surfaces),
        photos=opened.photos,
        left=left,
        poses=known.poses,
        mask_kind=opened.mask_kind,
        num_moved=num_moved,
        views_left_out=opened.views_left_out,
        fates=fates,
    )


def _fit_surfaces(known: Known) -> Mapping[int, LeafSurface]:
    from mvseg.reconstruction.surface.kept_surfaces import fit_kept

    with timed("surfaces"):
        masks, starts = known.masks, known.instances.starts
        return fit_kept(masks.regions, masks.instance_ids, known.scene.cameras, starts=starts)


def _warn_of_missing(known: Known, result: Result) -> None:
    """Warns (InputWarning) where leaves were probably missed, see `describe_missing`."""
    from mvseg.detection.config import SURE_SCORE
    from mvseg.verification.unexplained import describe_missing

    if not known.opened.is_chosen or (known.edits and not len(result.masks)):  # a person says that there is none
        return
    if said := describe_missing(result.masks, known.opened.photos, sure_score=SURE_SCORE):
        warn(said)


def _measure(result: Result, config: RunConfig, shapes: ReconstructConfig) -> Result:
    """Voxels, and traits of the leaves and of the plant, see `measure_plant`."""
    from mvseg.reconstruction.shapes import reconstruct_voxels
    from mvseg.traits.measure import measure_plant

    masks, cameras = result.masks, result.scene.cameras
    with timed("voxels"):
        voxels = reconstruct_voxels(masks.regions, masks.instance_ids, cameras, config=shapes, surfaces=result.surfaces)
    with timed("measure"):
        traits = measure_plant(
            result.scene,
            result.matching,
            surfaces=result.surfaces,
            voxels=voxels,
            photos=result.photos,
            config=config.traits,
        )
    return replace(result, instances=replace(result.instances, voxels=voxels, traits=traits))
