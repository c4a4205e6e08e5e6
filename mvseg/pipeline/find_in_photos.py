"""Leaves in the photos: the detector looks, at the size at which the views agree best, and the views choose.

A detector knows leaves of some sizes in pixels. Scores do not reveal which sizes work on a new plant; agreement between
views does: the agreed area (`rate_pass`) orders sizes nearly as the truth does. Not in the paper.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
import torch
from torch import Tensor

from mvseg.arrays import Bools
from mvseg.detection.cached_detections import CachedDetections
from mvseg.detection.crops import plant_boxes
from mvseg.detection.detect_scene import detect_scene
from mvseg.detection.numbers import DETECTION
from mvseg.detectors import MIN_IMAGE_SIZE
from mvseg.errors import collect_warnings, warn
from mvseg.findings.finding import Finding
from mvseg.pipeline.open_scene import Opened
from mvseg.pipeline.plant import Plant, make_plant, whole_photos
from mvseg.reconstruction.spread_views import spread_views
from mvseg.verification.leaf_scores import order_ratings
from mvseg.verification.numbers import CHOICE, COLORS
from mvseg.verification.picture import is_familiar


def find_in_photos(opened: Opened, *, cache: CachedDetections | None = None) -> Plant:
    """Look for leaves in the photos; the views choose leaves and masks. Raises InputError: see `detect_scene`.

    The detector looks at several sizes, see `choose_size`, unless one is given, or the views clearly agree about the
    leaves of a species that the detector knows. Of twice as many photos as `DETECTION.judging_views`, or more, so many
    choose the size, or the two between which all photos choose. All sizes are of the parts that the first pass chose.
    """
    size = opened.config.detect.image_size
    if size is not None or opened.holds:
        return announce(run_pass(opened, size, cache=cache))
    few, views = select_judges(opened)
    first = run_pass(few, None, cache=cache)
    boxes, colors, cameras = first.boxes, colors_to_judge_by(first), opened.scene.cameras
    first = replace(first, colors=colors)
    best, is_clear = [first], first.agreement >= DETECTION.clear_agreement
    if not (is_clear and is_familiar(first.masks, sure_score=DETECTION.sure_score)):
        best = choose_size(partial(run_pass, few, cache=cache, boxes=boxes, colors=colors), first)
    if few is opened:
        return announce(best[0])
    if torch.equal(boxes, whole_photos(few.scene)):
        boxes = whole_photos(opened.scene)
    else:
        masks = first.matched["matched"]
        regions = replace(masks.regions, view_index=views[masks.view_index], num_views=len(cameras))
        boxes = plant_boxes(replace(masks, regions=regions), cameras)
    if best[0] is first:  # a species that the detector knows: no other size is worth a pass over all photos
        return announce(run_pass(opened, None, cache=cache, boxes=boxes))
    run = partial(run_pass, opened, cache=cache, boxes=boxes, colors=colors)
    return announce(order_sizes([run(None if each is first else each.image_size) for each in best])[0])


def announce(plant: Plant) -> Plant:
    """Warn of the findings of the pass that was selected."""
    for finding in plant.findings:
        warn(finding)
    return replace(plant, colors=None, findings=())


def colors_to_judge_by(first: Plant) -> Bools:
    """Leaf colours of the first pass, which may miss leaves but finds little else; all where it has too few leaves."""
    is_known = first.opened.photos.exist and first.masks.num_instances >= CHOICE.least_leaves
    return first.leaf_colors if is_known else np.ones((COLORS.bins,) * 3, bool)


def select_judges(opened: Opened) -> tuple[Opened, Tensor]:
    """The scene with the views that choose the size, and their indices (S,)."""
    cameras, most = opened.scene.cameras, DETECTION.judging_views
    if len(cameras) < 2 * most:
        return opened, torch.arange(len(cameras))
    views = spread_views(cameras, most)
    scene = opened.scene.select(views)
    return replace(opened, scene=scene, photos=opened.photos.select(scene, views.tolist())), views


def choose_size(see: Callable[[int], Plant], first: Plant) -> list[Plant]:
    """Look again and again at a smaller size, as long as the agreed area grows; return one pass, or two, see
    `order_sizes`.

    Where the views do not clearly agree about the best leaves so far (`DETECTION.clear_agreement`), it takes more sizes
    without growth (`DETECTION.patience`): there, agreed areas of neighbouring sizes differ by chance.

    Args:
        see: finds leaves at a size: the longer side, pixels, that photos are scaled to.
        first: the pass at the usual size.
    """
    results, size, num_misses = [first], float(first.image_size), 0
    while (size := size * DETECTION.size_step) >= MIN_IMAGE_SIZE:
        best = order_sizes(results)[0]
        results.append(see(round(size)))
        num_misses = 0 if order_sizes(results)[0] is results[-1] else num_misses + 1
        if num_misses > (0 if best.agreement >= DETECTION.clear_agreement else DETECTION.patience):
            break
    return order_sizes(results)


def choose_near(see: Callable[[int], Plant], size: int, *, most: int) -> list[Plant]:
    """Look once at a size, once at a larger and once at a smaller one: with weights that have learned at that size.
    `most`: the longer side of the photos, pixels. Returns as `choose_size`."""
    larger, smaller = min(round(size / DETECTION.size_step), most), round(size * DETECTION.size_step)
    sizes = [size, *(each for each in (larger, smaller) if each > size or MIN_IMAGE_SIZE <= each < size)]
    return order_sizes([see(each) for each in sizes])


def order_sizes(results: Sequence[Plant]) -> list[Plant]:
    """The best pass, see `order_ratings`; then the next, if its agreed area is at least `DETECTION.as_good` times as
    large, for the caller to decide between the two by all views."""
    first, *others = [results[index] for index in order_ratings([each.rating for each in results])]
    least = DETECTION.as_good * first.rating.agreed_area
    return [first, *(each for each in others[:1] if each.rating.agreed_area >= least)]


def run_near(plant: Plant, *, cache: CachedDetections | None) -> Plant:
    """Run taught weights at the size that they have learned at, and at the sizes next to it, see `choose_near`; only at
    `DetectConfig.image_size`, where it is given."""
    opened, boxes, size = plant.opened, plant.boxes, plant.opened.config.detect.image_size
    if size is not None:
        return run_pass(opened, size, cache=cache, boxes=boxes)
    few, views = select_judges(opened)
    run = partial(run_pass, cache=cache, colors=plant.leaf_colors)
    results = choose_near(partial(run, few, boxes=boxes[views]), plant.image_size, most=plant.longest_side)
    if few is opened:
        return results[0]
    return order_sizes([run(opened, each.image_size, boxes=boxes) for each in results])[0]


def run_pass(
    opened: Opened,
    size: int | None,
    *,
    cache: CachedDetections | None,
    boxes: Tensor | None = None,
    colors: Bools | None = None,
) -> Plant:
    """Run the detector once over all views, at a size, see `DetectConfig.image_size`; the plant holds its warnings, as
    it may be thrown away. `colors`: of leaves, by which it is compared with other passes."""
    detect = replace(opened.config.detect, image_size=size)
    with collect_warnings() as findings:
        match, proposer = opened.config.match, opened.proposer
        detected = detect_scene(opened.photos, detect, match=match, cache=cache, boxes=boxes, proposer=proposer)
        plant = make_plant(opened, detected.sure, detected)
        if not len(detected.sure):
            warn(Finding("nothing_detected", values={"score": detect.min_score}))
    return replace(plant, findings=tuple(findings), colors=colors)
