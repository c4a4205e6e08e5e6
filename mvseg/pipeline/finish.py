"""From one plant to the result: final masks and ids, shapes, findings, and traits."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

from mvseg.checks.check_scene import check_scene
from mvseg.config import RunConfig
from mvseg.corrections.apply import read_stem_marks
from mvseg.corrections.corrected import APPLIED, NOTHING
from mvseg.corrections.file import Corrections
from mvseg.detection.numbers import DETECTION
from mvseg.errors import warn
from mvseg.findings.finding import Finding, Values, keep_causes
from mvseg.masks import STEM_CLASS
from mvseg.pipeline.plant import Plant
from mvseg.reconstruction.surface.leaf_surface import LeafSurface
from mvseg.results.result import Result
from mvseg.system.running import timed
from mvseg.verification.evidence import paint_view

# What needs torchvision, trimesh or scikit-image is imported where it is used: they take longer to load than small
# scenes to match.


REFUSED = ("broken_photo", "photo_size", "photo_turned")  # by the first stage that reads the photo


def check_result(result: Result, plant: Plant) -> Result:
    """Add the findings, and warn (InputWarning) of them."""
    opened = plant.opened
    with timed("check"):
        check = check_scene(result.scene, result.regions, photos=opened.photos, is_detected=opened.given is None)
    doubtful = _find_doubtful(result.surfaces or {}, _stems_of(result, opened.config))
    noticed = *check.findings, plant.disagreement, _find_missing(plant, result), doubtful
    findings = keep_causes(each for each in noticed if each is not None and each.code not in REFUSED)
    for finding in findings:
        if finding.level != "note":
            warn(finding)
    return replace(result, findings=findings)


def shape_leaves(plant: Plant, *, same_segmenter: Mapping[int, LeafSurface] | None = None) -> Result:
    """The final masks and ids, and their surfaces, as the page shows them. `same_segmenter`: the surfaces before edits,
    see `fit_surfaces`. Warns (InputWarning) of each edit that points at nothing, is odd, or contradicted."""
    opened = plant.opened
    plant = plant if opened.holds else complete_masks(plant)
    shapes = opened.config.reconstruct
    surfaces = None if shapes is None or shapes.shape == "voxels" else fit_leaves(plant, same_segmenter)
    plant = settle_edits(plant, surfaces or plant.instances.starts)
    for fate in plant.edits:
        if fate.finding is not None:
            warn(fate.finding)
    return Result(
        scene=plant.scene,
        matching=plant.matching,
        instances=replace(plant.instances, surfaces=surfaces),
        photos=opened.photos,
        rejected=plant.rejected,
        mask_kind=opened.mask_kind,
        views_left_out=opened.views_left_out,
        fates=plant.edits,
        learned=plant.learned,
        inputs={str(path.resolve()): sha256 for path, sha256 in opened.inputs.items()},
    )


def settle_edits(plant: Plant, surfaces: Mapping[int, LeafSurface]) -> Plant:
    """Apply "no leaf here" edits that point at no mask but answer a question, at a rejected candidate, which goes if
    the edit is about all photos, or at a surface without a mask."""
    gone, answers, cameras = set[int](), set[int](), plant.scene.cameras
    for each in plant.refused:
        place = each.view, each.column, each.row
        candidates = {n for n, other in enumerate(plant.rejected) if other.masks.regions.at(*place)}
        gone |= candidates if each.everywhere else set()
        width, height = cameras.sizes[each.view].tolist()
        is_in_photo = 0 <= each.column < width and 0 <= each.row < height
        if candidates or (is_in_photo and paint_view(surfaces, cameras, each.view)[each.row, each.column] > 0):
            answers.add(each.edit)
    edits = tuple(replace(each, fate=APPLIED, problem="") if each.edit in answers else each for each in plant.edits)
    return replace(plant, edits=edits, rejected=tuple(each for n, each in enumerate(plant.rejected) if n not in gone))


def complete_masks(plant: Plant) -> Plant:
    """Add the parts of leaves that the chosen masks lack, and move their edges to where colours change."""
    from mvseg.verification.missing_parts import find_missing_parts
    from mvseg.verification.snap_edges import snap_masks

    masks, photos = plant.masks.to("cpu"), plant.opened.photos
    with timed("snap"):
        missing = find_missing_parts(masks, plant.instances.starts, photos, cameras=plant.scene.cameras)
        return plant.with_masks(snap_masks(masks, photos, missing=missing, cache=plant.opened.cache))


def fit_leaves(plant: Plant, same_segmenter: Mapping[int, LeafSurface] | None) -> dict[int, LeafSurface]:
    """Fit a surface to the masks of each leaf, see `fit_surfaces`."""
    from mvseg.reconstruction.surface.fit_surfaces import fit_surfaces

    regions, ids, cameras = plant.masks.regions, plant.masks.instance_ids, plant.scene.cameras
    starts, cache = plant.instances.starts, plant.opened.cache
    with timed("surfaces"):
        return fit_surfaces(regions, ids, cameras, starts=starts, same_segmenter=same_segmenter, cache=cache)


def _find_missing(plant: Plant, result: Result) -> Finding | None:
    from mvseg.verification.picture import find_missing

    if plant.opened.holds or (plant.edits and not len(result.masks)):  # the user says that there is none
        return None
    return find_missing(result.masks, plant.opened.photos, sure_score=DETECTION.sure_score)


def _stems_of(result: Result, config: RunConfig) -> list[int]:
    stems = result.masks.instance_ids[result.masks.classes == STEM_CLASS].unique().tolist()
    return [each for each in stems if each > 0] if config.stem_category is not None else []


def _find_doubtful(surfaces: Mapping[int, LeafSurface], stems: Sequence[int]) -> Finding | None:
    surfaces = {leaf: each for leaf, each in surfaces.items() if leaf not in stems}
    leaves = tuple(str(leaf) for leaf, each in sorted(surfaces.items()) if each.reasons)
    if not leaves:
        return None
    values: Values = {"count": len(leaves), "total": len(surfaces), "leaves": leaves}
    return Finding("doubtful_shapes", values=values, level="note")


def measure(result: Result, config: RunConfig, corrections: Corrections | None = None) -> Result:
    """Add voxels and traits (`measure_plant`); nothing without shapes. Warns (InputWarning) of edits about no stem."""
    if config.reconstruct is None:
        return result
    from mvseg.reconstruction.shapes import reconstruct_voxels
    from mvseg.traits.measure import measure_plant

    regions, ids, cameras = result.masks.regions, result.masks.instance_ids, result.scene.cameras
    with timed("voxels"):
        voxels = reconstruct_voxels(regions, ids, cameras, config=config.reconstruct, surfaces=result.surfaces)
    marks = read_stem_marks(corrections, result.scene)
    with timed("measure"):
        traits = measure_plant(
            result.scene,
            result.matching,
            surfaces=result.surfaces,
            voxels=voxels,
            photos=result.photos,
            config=config.traits,
            stems=_stems_of(result, config),
            probabilities=result.instances.probabilities,
            stem_marks=[mark for mark in marks.values() if mark is not None],
        )
    fates = list(result.fates)
    for number, mark in marks.items():
        if mark is None or (mark.is_stem and not traits.stems):
            lost = fates[number - 1] = replace(fates[number - 1], fate=NOTHING, problem="there is no stem")
            if lost.finding is not None:
                warn(lost.finding)
    return replace(result, instances=replace(result.instances, voxels=voxels, traits=traits), fates=tuple(fates))
