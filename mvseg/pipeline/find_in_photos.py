"""Leaves in the photos: the detector looks, at the size at which the views agree best, and the views choose."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mvseg.detection.cached_detections import CachedDetections
from mvseg.detection.choose_size import choose_near, choose_size, order_sizes
from mvseg.detection.config import DetectConfig
from mvseg.detection.crops import plant_boxes
from mvseg.detection.detect_scene import detect_scene
from mvseg.detection.find_leaves import PassResult, find_leaves
from mvseg.detection.numbers import DETECTION
from mvseg.errors import collect_warnings, warn
from mvseg.findings.finding import Finding
from mvseg.matching.result import Matching
from mvseg.pipeline.open_scene import Opened
from mvseg.pipeline.plant import Plant, hold_matched, whole_photos
from mvseg.reconstruction.spread_views import spread_views
from mvseg.verification.leaf_color import colored_shares
from mvseg.verification.numbers import CHOICE
from mvseg.verification.picture import colors_of_leaves, is_familiar

Colors = NDArray[np.bool_]  # of leaves, see `leaf_colors`


def find_in_photos(opened: Opened, *, cache: CachedDetections | None = None) -> Plant:
    """Look for leaves in the photos; the views choose leaves and masks. Raises InputError: see `detect_scene`.

    The detector looks at several sizes, see `choose_size`, unless one is given, or the views clearly agree about the
    leaves of a species that the detector knows. Of twice as many photos as `DETECTION.judging_views`, or more, so many
    choose the size, or the two between which all photos choose. All sizes are of the parts that the first pass chose.
    """
    detect = opened.config.detect
    if detect.image_size is not None or opened.holds:
        return plant_of_pass(opened, run_pass(opened, detect, cache=cache))
    few, views = select_judges(opened)
    first = run_pass(few, detect, cache=cache)
    colors, parts = colors_to_judge_by(few, first), first.detected.boxes
    first = judge_pass(few, first, colors)
    boxes = whole_photos(few.scene) if parts is None else parts
    is_clear = first.leaves.agreement >= DETECTION.clear_agreement
    best = [first]
    if not (is_clear and is_familiar(first.leaves.masks, sure_score=DETECTION.sure_score)):
        best = choose_size(partial(run_at, few, detect, colors=colors, cache=cache, boxes=boxes), first)
    if few is opened:
        return plant_of_pass(opened, best[0])
    boxes = whole_photos(opened.scene)
    if parts is not None:
        masks, cameras = first.detected.sure.masks, opened.scene.cameras
        regions = replace(masks.regions, view_index=views[masks.view_index], num_views=len(cameras))
        boxes = plant_boxes(replace(masks, regions=regions), cameras)
    if best[0] is first:  # a species that the detector knows: no other size is worth a pass over all photos
        return plant_of_pass(opened, run_pass(opened, detect, cache=cache, boxes=boxes))
    sizes = [None if each is first else each.detected.longest for each in best]
    results = [run_at(opened, detect, size, colors=colors, cache=cache, boxes=boxes) for size in sizes]
    return plant_of_pass(opened, order_sizes(results)[0])


def colors_to_judge_by(opened: Opened, first: PassResult) -> Colors | None:
    """Leaf colours of the first pass, which may miss leaves but finds little else; None where it has too few leaves."""
    masks = first.leaves.masks
    is_known = opened.photos.exist and masks.num_instances >= CHOICE.least_leaves
    return colors_of_leaves(masks, opened.photos) if is_known else None


def judge_pass(opened: Opened, result: PassResult, colors: Colors | None) -> PassResult:
    """The same with the share of leaf colour in each mask, by which passes are compared."""
    if colors is None:
        return result
    return replace(result, colored=colored_shares(result.leaves.masks, opened.photos, colors))


def select_judges(opened: Opened) -> tuple[Opened, Tensor]:
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
    if detect.image_size is not None:
        return run_pass(opened, detect, cache=cache, boxes=boxes)
    run = partial(run_at, colors=plant.leaf_colors if opened.photos.exist else None, cache=cache)
    few, views = select_judges(opened)
    results = choose_near(partial(run, few, detect, boxes=boxes[views]), plant.image_size, most=plant.longest_side)
    if few is opened:
        return results[0]
    return order_sizes([run(opened, detect, each.detected.longest, boxes=boxes) for each in results])[0]


def run_at(
    opened: Opened,
    detect: DetectConfig,
    size: int | None,
    *,
    colors: Colors | None,
    cache: CachedDetections | None,
    boxes: Tensor,
) -> PassResult:
    """Run the detector at a size, see `run_pass`, to compare the pass with others, see `judge_pass`."""
    return judge_pass(opened, run_pass(opened, replace(detect, image_size=size), cache=cache, boxes=boxes), colors)


def run_pass(
    opened: Opened,
    detect: DetectConfig,
    *,
    cache: CachedDetections | None,
    boxes: Tensor | None = None,
) -> PassResult:
    """Run the detector once over all views; the result holds its warnings, as it may be thrown away."""
    with collect_warnings() as findings:
        detected = detect_scene(opened.photos, detect, match=opened.config.match, cache=cache, boxes=boxes)
        photos = opened.photos if opened.photos.exist else None
        result = find_leaves(detected, opened.scene.cameras, config=detect, photos=photos, cache=opened.surfaces)
    return replace(result, findings=tuple(findings))


def plant_of_pass(opened: Opened, result: PassResult) -> Plant:
    """Make a plant of the pass that was selected; warn of its findings."""
    for finding in result.findings:
        warn(finding)
    detected = result.detected
    if not len(detected.sure):
        warn(Finding("nothing_detected", values={"score": opened.config.detect.min_score}))
    matching = Matching(result.matched[0], detected.sure.report)
    boxes = whole_photos(opened.scene) if detected.boxes is None else detected.boxes
    if opened.holds:
        return hold_matched(opened, matching, image_size=detected.longest, boxes=boxes)
    plant = Plant(
        opened=opened,
        matching=matching,
        proposals=result.proposals,
        matched=result.matched,
        image_size=detected.longest,
        boxes=boxes,
        disagreement=opened.find_disagreement(matching),
    )
    return plant.with_leaves(result.leaves)
