"""Leaves in the photos: the detector looks, at the size at which the views agree best, and the views choose."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

from torch import Tensor

from mvseg.detection.cached_detections import CachedDetections
from mvseg.detection.choose_size import choose_size
from mvseg.detection.config import DetectConfig
from mvseg.detection.detect_scene import detect_scene
from mvseg.detection.find_leaves import Found, Look, find_leaves
from mvseg.errors import collect_warnings, warn
from mvseg.matching.match import describe_disagreement
from mvseg.matching.result import Matching
from mvseg.pipeline.known import Known
from mvseg.pipeline.open_scene import Opened
from mvseg.poses.refine_poses import RefinedPoses, refine_scene
from mvseg.results.result import Instances
from mvseg.scene import Scene


def find_in_photos(opened: Opened, *, cache: CachedDetections | None = None) -> Known:
    """Look for leaves in the photos; the views choose leaves and masks.

    Where the plant fills the photos, or the detector does not know its species, it looks at several sizes, unless one
    is given: see `choose_size`.

    Args:
        opened: the scene.
        cache: of the detections.

    Raises:
        InputError: see `detect_scene`.
    """
    detect, scene, poses = opened.config.detect, opened.scene, None
    with collect_warnings() as said:
        look = detect_scene(opened.photos, detect, match=opened.config.match, cache=cache)
        if opened.config.refine_poses:
            scene, poses = refine_scene(scene, partial(look.match, min_score=detect.min_score))
        found = _choose(opened, look, detect, scene=scene)
    found = replace(found, said=tuple(said))
    boxes = found.looks[0].boxes
    if detect.image_size is None and opened.is_chosen and (boxes is None or not found.is_familiar):

        def see(size: int) -> Found:
            return look_once(opened, replace(detect, image_size=size), scene=scene, cache=cache, boxes=boxes)

        found = choose_size(see, found)
    return know(opened, found, scene=scene, poses=poses)


def look_once(
    opened: Opened,
    detect: DetectConfig,
    *,
    scene: Scene,
    cache: CachedDetections | None,
    boxes: Tensor | None = None,
) -> Found:
    """What one look finds, with its warnings in it: it may be thrown away.

    Args:
        opened: the scene.
        detect: which detector, and at which size.
        scene: the same with its final cameras.
        cache: of the detections.
        boxes: see `detect_scene`.
    """
    with collect_warnings() as said:
        look = detect_scene(opened.photos, detect, match=opened.config.match, cache=cache, boxes=boxes)
        found = _choose(opened, look, detect, scene=scene)
    return replace(found, said=tuple(said))


def _choose(opened: Opened, look: Look, detect: DetectConfig, *, scene: Scene) -> Found:
    if scene.cameras is not opened.scene.cameras:
        look = look.with_cameras(scene.cameras, detect.min_score)
    return find_leaves([look], scene.cameras, config=detect, splits=opened.is_cut)


def know(opened: Opened, found: Found, *, scene: Scene, poses: RefinedPoses | None) -> Known:
    """What is known once a look is chosen; warns of what there is to say of it."""
    for sentence in found.said:
        warn(sentence)
    if not len(found.looks[0].sure):
        warn(f"the detector finds nothing that scores {opened.config.detect.min_score:g} or more")
    matching = Matching(found.matched[0], found.report)
    known = Known(
        opened=opened,
        scene=scene,
        matching=matching,
        instances=Instances(),
        proposals=found.proposals,
        matched=found.matched,
        looks=found.looks,
        left=(),
        poses=poses,
        disagreement=describe_disagreement(matching, opened.names),
    )
    return known.with_leaves(found.leaves) if opened.is_chosen else known
