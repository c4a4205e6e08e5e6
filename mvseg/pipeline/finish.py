"""From what is known to the result: final masks and ids, shapes, traits, and findings."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING

from mvseg.checks.check_scene import check_scene
from mvseg.config import RunConfig
from mvseg.corrections.settle import settle
from mvseg.detection.numbers import DETECTION
from mvseg.errors import warn
from mvseg.findings.finding import Finding, Values, keep_causes
from mvseg.masks import Masks
from mvseg.matching.split import split_merged
from mvseg.pipeline.known import Known
from mvseg.results.result import Result
from mvseg.system.running import timed

if TYPE_CHECKING:
    from mvseg.reconstruction.config import ReconstructConfig
    from mvseg.reconstruction.surface.leaf_surface import LeafSurface

# What needs torchvision, trimesh or scikit-image is imported where it is used: they take longer to load than small
# scenes to match.


REFUSED = ("broken_photo", "photo_size", "photo_turned")  # by the first stage that reads the photo


def finish(known: Known, *, same_segmenter: Mapping[int, LeafSurface] | None = None) -> Result:
    """The final masks and ids, shapes and traits; and the findings, of which it warns (InputWarning). For the arguments
    see `shape_leaves`."""
    result, opened = shape_leaves(known, same_segmenter=same_segmenter), known.opened
    shapes = opened.config.reconstruct
    with timed("check"):
        check = check_scene(
            result.scene,
            result.regions,
            photos=opened.photos,
            features=shapes is not None and opened.photos.exist,
            is_detected=opened.given is None,
        )
    noticed = *check.findings, known.disagreement, _find_missing(known, result), _find_doubtful(result)
    findings = keep_causes(each for each in noticed if each is not None and each.code not in REFUSED)
    for finding in findings:
        if finding.level != "note":
            warn(finding)
    result = replace(result, findings=findings)
    return result if shapes is None else _measure(result, opened.config, shapes)


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
        if fate.finding is not None:
            warn(fate.finding)
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


def _find_missing(known: Known, result: Result) -> Finding | None:
    """Whether leaves were probably missed, where a detector found them, see `find_missing`."""
    from mvseg.verification.unexplained import find_missing

    if not known.opened.is_chosen or (known.edits and not len(result.masks)):  # the user says that there is none
        return None
    return find_missing(result.masks, known.opened.photos, sure_score=DETECTION.sure_score)


def _find_doubtful(result: Result) -> Finding | None:
    surfaces = result.surfaces or {}
    leaves = tuple(str(leaf) for leaf, each in sorted(surfaces.items()) if not each.quality.is_good)
    if not leaves:
        return None
    values: Values = {"count": len(leaves), "total": len(surfaces), "leaves": leaves}
    return Finding("doubtful_shapes", values=values, level="note")


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
