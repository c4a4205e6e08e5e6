"""From one plant to the result: final masks and ids, shapes, findings, and traits."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING

from mvseg.checks.check_scene import check_scene
from mvseg.config import RunConfig
from mvseg.corrections.settle import settle_edits
from mvseg.detection.numbers import DETECTION
from mvseg.errors import warn
from mvseg.findings.finding import Finding, Values, keep_causes
from mvseg.masks import STEM_CLASS
from mvseg.pipeline.plant import Plant
from mvseg.results.result import Result
from mvseg.system.running import timed

if TYPE_CHECKING:
    from mvseg.reconstruction.surface.leaf_surface import LeafSurface

# What needs torchvision, trimesh or scikit-image is imported where it is used: they take longer to load than small
# scenes to match.


REFUSED = ("broken_photo", "photo_size", "photo_turned")  # by the first stage that reads the photo


def check_result(result: Result, plant: Plant) -> Result:
    """Add the findings, and warn (InputWarning) of them."""
    opened = plant.opened
    with timed("check"):
        check = check_scene(result.scene, result.regions, photos=opened.photos, is_detected=opened.given is None)
    doubtful = _find_doubtful(result, has_stems=plant.opened.config.stem_category is not None)
    noticed = *check.findings, plant.disagreement, _find_missing(plant, result), doubtful
    findings = keep_causes(each for each in noticed if each is not None and each.code not in REFUSED)
    for finding in findings:
        if finding.level != "note":
            warn(finding)
    return replace(result, findings=findings)


def shape_leaves(plant: Plant, *, same_segmenter: Mapping[int, LeafSurface] | None = None) -> Result:
    """The final masks and ids, and their surfaces: what the page shows that the user corrects.

    Warns (InputWarning) of each edit that points at nothing, is odd, or contradicted by a later one.

    Args:
        same_segmenter: the surfaces before edits, see `fit_surfaces`; None: there are no edits.
    """
    opened = plant.opened
    plant = plant if opened.holds else complete_masks(plant)
    shapes = opened.config.reconstruct
    surfaces = None if shapes is None or shapes.shape == "voxels" else fit_leaves(plant, same_segmenter)
    shown = surfaces or plant.instances.starts
    rejected, fates = settle_edits(plant.edits, plant.refused, plant.rejected, shown, cameras=plant.scene.cameras)
    for fate in fates:
        if fate.finding is not None:
            warn(fate.finding)
    return Result(
        scene=plant.scene,
        matching=plant.matching,
        instances=replace(plant.instances, surfaces=surfaces),
        photos=opened.photos,
        rejected=rejected,
        mask_kind=opened.mask_kind,
        views_left_out=opened.views_left_out,
        fates=fates,
        learned=plant.learned,
    )


def complete_masks(plant: Plant) -> Plant:
    """Add the parts of leaves that the chosen masks lack, and move their edges to where colours change."""
    from mvseg.verification.missing_parts import find_missing_parts
    from mvseg.verification.snap_edges import snap_masks

    masks, photos = plant.masks.to("cpu"), plant.opened.photos
    with timed("snap"):
        missing = find_missing_parts(masks, plant.instances.starts, photos, cameras=plant.scene.cameras)
        return plant.with_masks(snap_masks(masks, photos, missing=missing, cache=plant.opened.snapped))


def fit_leaves(plant: Plant, same_segmenter: Mapping[int, LeafSurface] | None) -> dict[int, LeafSurface]:
    """Fit a surface to the masks of each leaf, see `fit_surfaces`."""
    from mvseg.reconstruction.surface.fit_surfaces import fit_surfaces

    with timed("surfaces"):
        return fit_surfaces(
            plant.masks.regions,
            plant.masks.instance_ids,
            plant.scene.cameras,
            starts=plant.instances.starts,
            same_segmenter=same_segmenter,
            cache=plant.opened.surfaces,
        )


def _find_missing(plant: Plant, result: Result) -> Finding | None:
    from mvseg.verification.unexplained import find_missing

    if plant.opened.holds or (plant.edits and not len(result.masks)):  # the user says that there is none
        return None
    return find_missing(result.masks, plant.opened.photos, sure_score=DETECTION.sure_score)


def _find_doubtful(result: Result, *, has_stems: bool) -> Finding | None:
    of_stems = result.masks.instance_ids[result.masks.classes == STEM_CLASS].tolist() if has_stems else ()
    surfaces = {leaf: each for leaf, each in (result.surfaces or {}).items() if leaf not in of_stems}
    leaves = tuple(str(leaf) for leaf, each in sorted(surfaces.items()) if not each.quality.is_good)
    if not leaves:
        return None
    values: Values = {"count": len(leaves), "total": len(surfaces), "leaves": leaves}
    return Finding("doubtful_shapes", values=values, level="note")


def measure(result: Result, config: RunConfig) -> Result:
    """Add voxels, and traits of the leaves and of the plant, see `measure_plant`; nothing without shapes."""
    if config.reconstruct is None:
        return result
    from mvseg.reconstruction.shapes import reconstruct_voxels
    from mvseg.traits.measure import measure_plant

    regions, ids, cameras = result.masks.regions, result.masks.instance_ids, result.scene.cameras
    with timed("voxels"):
        voxels = reconstruct_voxels(regions, ids, cameras, config=config.reconstruct, surfaces=result.surfaces)
    has_stems = config.stem_category is not None
    stems = ids[result.masks.classes == STEM_CLASS].unique().tolist() if has_stems else ()
    with timed("measure"):
        traits = measure_plant(
            result.scene,
            result.matching,
            surfaces=result.surfaces,
            voxels=voxels,
            photos=result.photos,
            config=config.traits,
            stems=[instance for instance in stems if instance > 0],
            probabilities=result.instances.probabilities,
        )
    return replace(result, instances=replace(result.instances, voxels=voxels, traits=traits))
