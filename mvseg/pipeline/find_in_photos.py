"""Leaves in the photos: the detector looks, at the size at which the views agree best, and the views choose."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from mvseg.detection.cached_detections import CachedDetections
from mvseg.detection.choose_size import choose_near, choose_size
from mvseg.detection.config import DetectConfig
from mvseg.detection.crops import plant_boxes
from mvseg.detection.detect_scene import detect_scene
from mvseg.detection.find_leaves import PassResult, find_leaves, join_passes
from mvseg.detection.numbers import DETECTION
from mvseg.errors import collect_warnings, warn
from mvseg.findings.finding import Finding
from mvseg.matching.result import Matching
from mvseg.pipeline.open_scene import Opened
from mvseg.pipeline.plant import Plant, whole_photos
from mvseg.reconstruction.spread_views import spread_views
from mvseg.results.result import Instances


def find_in_photos(opened: Opened, *, cache: CachedDetections | None = None) -> Plant:
    """Look for leaves in the photos; the views choose leaves and masks.

    The detector looks at several sizes, unless one is given: see `choose_size`. With twice as many photos as
    `DETECTION.judging_views`, or more, so many of them choose the size, or the two between which all photos choose.

    Raises:
        InputError: see `detect_scene`.
    """
    detect = opened.config.detect
    if detect.image_size is not None or not opened.is_chosen:
        return plant_of_pass(opened, run_pass(opened, detect, cache=cache))
    few, views = _select_judges(opened)
    first = run_pass(few, detect, cache=cache)
    boxes = first.passes[0].boxes

    def see(size: int) -> PassResult:
        return run_pass(few, replace(detect, image_size=size), cache=cache, boxes=boxes)

    best = choose_size(see, first)
    if few is opened:
        return plant_of_pass(opened, _choose_pass(opened, best, detect))
    if boxes is not None:
        masks, cameras = first.passes[0].sure.masks, opened.scene.cameras
        regions = replace(masks.regions, view_index=views[masks.view_index], num_views=len(cameras))
        boxes = plant_boxes(replace(masks, regions=regions), cameras)
    if best[0] is first:  # a species that the detector knows: no other size is worth a pass over all photos
        return plant_of_pass(opened, run_pass(opened, detect, cache=cache, boxes=boxes))
    sizes = [None if each is first else each.passes[0].longest for each in best]
    return plant_of_pass(opened, _run_in_all(opened, sizes, detect, cache=cache, boxes=boxes))


def _run_in_all(
    opened: Opened,
    sizes: Sequence[int | None],
    detect: DetectConfig,
    *,
    cache: CachedDetections | None,
    boxes: Tensor | None,
) -> PassResult:
    """Run the detector over all views at one or two sizes (None: its own), and choose."""
    results = [run_pass(opened, replace(detect, image_size=size), cache=cache, boxes=boxes) for size in sizes]
    return _choose_pass(opened, sorted(results, key=lambda each: -each.agreed_area), detect)


def _choose_pass(opened: Opened, results: Sequence[PassResult], detect: DetectConfig) -> PassResult:
    """Select from one or two passes, the better one first: the best one, or both as one set, by the largest agreed
    area."""
    best, *others = results
    for other in others:
        with collect_warnings():  # those of the passes say it
            both = join_passes(best, other, opened.scene.cameras, config=detect, cache=opened.surfaces)
        best = max(best, both, key=lambda each: each.agreed_area)
    return best


def _select_judges(opened: Opened) -> tuple[Opened, Tensor]:
    """The scene with the views that choose the size, and their indices (S,)."""
    cameras, most = opened.scene.cameras, DETECTION.judging_views
    if len(cameras) < 2 * most:
        return opened, torch.arange(len(cameras))
    views = spread_views(cameras, most)
    scene = opened.scene.select(views)
    return replace(opened, scene=scene, photos=opened.photos.select(scene, views.tolist())), views


def run_near(plant: Plant, detect: DetectConfig, *, cache: CachedDetections | None) -> PassResult:
    """Run taught weights at the size that they have learned at, and at the sizes next to it, see `choose_near`; only at
    `DetectConfig.image_size`, where it is given."""
    opened, boxes = plant.opened, plant.boxes
    few, views = _select_judges(opened)
    if detect.image_size is not None:
        return run_pass(opened, detect, cache=cache, boxes=boxes)

    def see(size: int) -> PassResult:
        return run_pass(few, replace(detect, image_size=size), cache=cache, boxes=boxes[views])

    found = choose_near(see, plant.image_size, most=plant.longest_side)
    if few is opened:
        return _choose_pass(opened, found, detect)
    return _run_in_all(opened, [each.passes[0].longest for each in found], detect, cache=cache, boxes=boxes)


def run_pass(
    opened: Opened,
    detect: DetectConfig,
    *,
    cache: CachedDetections | None,
    boxes: Tensor | None = None,
) -> PassResult:
    """Run the detector once over all views; the result holds its warnings, as it may be thrown away.

    Args:
        detect: which detector, and at which size.
    """
    with collect_warnings() as findings:
        detected = detect_scene(opened.photos, detect, match=opened.config.match, cache=cache, boxes=boxes)
        cameras, splits = opened.scene.cameras, opened.config.split_merged and not opened.is_checked
        result = find_leaves(detected, cameras, config=detect, splits=splits, cache=opened.surfaces)
    return replace(result, findings=tuple(findings))


def plant_of_pass(opened: Opened, result: PassResult) -> Plant:
    """Make a plant of the pass that was selected; warn of its findings."""
    for finding in result.findings:
        warn(finding)
    detected = result.passes[0]
    if not len(detected.sure):
        warn(Finding("nothing_detected", values={"score": opened.config.detect.min_score}))
    matching = Matching(result.matched[0], result.report)
    plant = Plant(
        opened=opened,
        matching=matching,
        instances=Instances(),
        proposals=result.proposals,
        matched=result.matched,
        image_size=detected.longest,
        boxes=whole_photos(opened.scene) if detected.boxes is None else detected.boxes,
        rejected=(),
        disagreement=opened.find_disagreement(matching),
        alone_area=result.alone_area,
    )
    return plant.with_leaves(result.leaves) if opened.is_chosen else plant
