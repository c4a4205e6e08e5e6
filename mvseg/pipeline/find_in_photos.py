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
from mvseg.detection.find_leaves import Found, Look, find_leaves
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
        return know(opened, look_once(opened, detect, cache=cache))
    few, views = _thin(opened)
    first = look_once(few, detect, cache=cache)
    boxes = first.looks[0].boxes

    def see(size: int) -> Found:
        return look_once(few, replace(detect, image_size=size), cache=cache, boxes=boxes)

    found = choose_size(see, first)
    if few is opened:
        return know(opened, found[0])
    if boxes is not None:
        masks, cameras = first.looks[0].sure.masks, opened.scene.cameras
        regions = replace(masks.regions, view_index=views[masks.view_index], num_views=len(cameras))
        boxes = plant_boxes(replace(masks, regions=regions), cameras)
    sizes = [None if each is first else each.looks[0].longest for each in found]
    return know(opened, _look_in_all(opened, sizes, detect, cache=cache, boxes=boxes))


def _look_in_all(
    opened: Opened,
    sizes: Sequence[int | None],
    detect: DetectConfig,
    *,
    cache: CachedDetections | None,
    boxes: Tensor | None,
) -> Found:
    """What all views find at that one of the sizes where their agreed area is largest; None is the detector's own."""
    seen = [look_once(opened, replace(detect, image_size=size), cache=cache, boxes=boxes) for size in sizes]
    return max(seen, key=lambda each: each.agreed_area)


def _thin(opened: Opened) -> tuple[Opened, Tensor]:
    """The scene with the views that choose the size, and their indices (S,)."""
    cameras, most = opened.scene.cameras, DETECTION.judging_views
    if len(cameras) < 2 * most:
        return opened, torch.arange(len(cameras))
    views = spread_views(cameras, most)
    scene = opened.scene.select(views)
    return replace(opened, scene=scene, photos=opened.photos.select(scene, views.tolist())), views


def look_near(plant: Plant, detect: DetectConfig, *, cache: CachedDetections | None) -> Found:
    """What weights find that have learned at the size of this look: there, or at the size next to it where the
    views agree better, see `choose_near`; there alone where a size is given."""
    opened, boxes = plant.opened, plant.boxes
    few, views = _thin(opened)
    if detect.image_size is not None:
        return look_once(opened, detect, cache=cache, boxes=boxes)

    def see(size: int) -> Found:
        return look_once(few, replace(detect, image_size=size), cache=cache, boxes=boxes[views])

    found = choose_near(see, plant.image_size, most=plant.longest_side)
    if few is opened:
        return found[0]
    return _look_in_all(opened, [each.looks[0].longest for each in found], detect, cache=cache, boxes=boxes)


def look_once(
    opened: Opened,
    detect: DetectConfig,
    *,
    cache: CachedDetections | None,
    boxes: Tensor | None = None,
) -> Found:
    """What one look finds, with its warnings in it: it may be thrown away.

    Args:
        detect: which detector, and at which size.
    """
    with collect_warnings() as said:
        look = detect_scene(opened.photos, detect, match=opened.config.match, cache=cache, boxes=boxes)
        found = _choose(opened, look, detect)
    return replace(found, said=tuple(said))


def _choose(opened: Opened, look: Look, detect: DetectConfig) -> Found:
    return find_leaves([look], opened.scene.cameras, config=detect, splits=opened.is_cut, cache=opened.surfaces)


def know(opened: Opened, found: Found) -> Plant:
    """What is known once a look is chosen; warns of what there is to say of it."""
    for finding in found.said:
        warn(finding)
    if not len(found.looks[0].sure):
        warn(Finding("nothing_detected", values={"score": opened.config.detect.min_score}))
    matching = Matching(found.matched[0], found.report)
    plant = Plant(
        opened=opened,
        matching=matching,
        instances=Instances(),
        proposals=found.proposals,
        matched=found.matched,
        image_size=found.looks[0].longest,
        boxes=whole_photos(opened.scene) if found.looks[0].boxes is None else found.looks[0].boxes,
        left=(),
        disagreement=opened.find_disagreement(matching),
    )
    return plant.with_leaves(found.leaves) if opened.is_chosen else plant
