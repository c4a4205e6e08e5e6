"""From what is known to the result: final masks and ids, shapes, traits, and what there is to say of them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING

from mvseg.checks.check_scene import warn_of_contradictions
from mvseg.checks.masks import describe_cut
from mvseg.config import RunConfig
from mvseg.corrections.settle import settle
from mvseg.detection.numbers import DETECTION
from mvseg.errors import warn
from mvseg.masks import Masks
from mvseg.matching.split import split_merged
from mvseg.pipeline.known import Known
from mvseg.results.result import Result
from mvseg.system.running import timed

if TYPE_CHECKING:
    from mvseg.reconstruction.config import ReconstructConfig
    from mvseg.reconstruction.surface.leaf_surface import LeafSurface
    from mvseg.verification.unexplained import Missing

# What needs torchvision, trimesh or scikit-image is imported where it is used: they take longer to load than small
# scenes to match.


def finish(known: Known, *, same_segmenter: Mapping[int, LeafSurface] | None = None) -> Result:
    """The final masks and ids, shapes and traits; and what there is to say of them. For the arguments see
    `shape_leaves`."""
    result, config = shape_leaves(known, same_segmenter=same_segmenter), known.opened.config
    if known.disagreement:
        warn(known.disagreement)
    if (missing := _find_missing(known, result)) is not None:
        warn(f"{missing.why}; what helps: {missing.helps}")
    result = replace(result, missing=missing, disagreement=known.disagreement)
    with timed("check"):
        has_photos = config.reconstruct is not None and known.opened.photos.exist
        photos = known.opened.photos if has_photos else None
        result = replace(result, contradictions=warn_of_contradictions(result.scene, result.regions, photos=photos))
    if config.reconstruct is None:
        return result
    if cut := describe_cut(result.regions.to("cpu"), result.scene.cameras.to("cpu")):
        warn(cut)
    return _measure(result, config, config.reconstruct)


def shape_leaves(known: Known, *, same_segmenter: Mapping[int, LeafSurface] | None = None) -> Result:
    """The final masks and ids, and their surfaces: what the page shows that a person corrects.

    Warns (InputWarning) of each edit that points at nothing, is odd, or contradicted by a later one.

    Args:
        known: the masks.
        same_segmenter: the surfaces before edits, see `fit_surfaces`; None: there are no edits.
    """
    opened, config, num_moved = known.opened, known.opened.config, None
    if opened.is_chosen:
        with timed("snap"):
            known = known.with_masks(complete_masks(known))
    if opened.is_checked:
        from mvseg.verification.checked_ids import check_ids

        fitted = _fit_surfaces(known, same_segmenter)
        with timed("check_ids"):
            checked = check_ids(
                known.masks, fitted, cameras=known.scene.cameras, config=config.match, cache=opened.surfaces
            )
        num_moved = int((known.masks.instance_ids != checked.instance_ids).sum())
        known = known.with_masks(split_merged(checked) if config.split_merged else checked)
    has_surfaces = config.reconstruct is not None and config.reconstruct.shape != "voxels"
    surfaces = _fit_surfaces(known, same_segmenter) if has_surfaces else None
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
        mask_kind=opened.mask_kind,
        num_moved=num_moved,
        views_left_out=opened.views_left_out,
        fates=fates,
        learned=known.learned,
    )


def complete_masks(known: Known) -> Masks:
    """The masks that the views chose, with the parts of leaves that they lack, and their edges where colours change."""
    from mvseg.verification.missing_parts import find_missing_parts
    from mvseg.verification.snap_edges import snap_masks

    masks, photos = known.masks.to("cpu"), known.opened.photos
    missing = find_missing_parts(masks, known.instances.starts, photos, cameras=known.scene.cameras)
    return snap_masks(masks, photos, missing=missing, cache=known.opened.snapped)


def _fit_surfaces(known: Known, same_segmenter: Mapping[int, LeafSurface] | None) -> dict[int, LeafSurface]:
    from mvseg.reconstruction.surface.fit_surfaces import fit_surfaces

    with timed("surfaces"):
        return fit_surfaces(
            known.masks.regions,
            known.masks.instance_ids,
            known.scene.cameras,
            starts=known.instances.starts,
            same_segmenter=same_segmenter,
            cache=known.opened.surfaces,
        )


def _find_missing(known: Known, result: Result) -> Missing | None:
    """Whether leaves were probably missed, where a detector found them, see `find_missing`."""
    from mvseg.verification.unexplained import find_missing

    if not known.opened.is_chosen or (known.edits and not len(result.masks)):  # a person says that there is none
        return None
    may_learn = known.opened.config.learn != "off"
    return find_missing(result.masks, known.opened.photos, sure_score=DETECTION.sure_score, may_learn=may_learn)


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
