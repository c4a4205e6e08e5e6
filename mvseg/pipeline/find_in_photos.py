"""Leaves in the photos: the detector looks, at the size at which the views agree best, and the views choose."""

from __future__ import annotations

from dataclasses import replace

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
from mvseg.results.result import Instances


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
    detect = opened.config.detect
    with collect_warnings() as said:
        look = detect_scene(opened.photos, detect, match=opened.config.match, cache=cache)
        found = _choose(opened, look, detect)
    found = replace(found, said=tuple(said))
    boxes = found.looks[0].boxes
    if detect.image_size is None and opened.is_chosen and (boxes is None or not found.is_familiar):

        def see(size: int) -> Found:
            return look_once(opened, replace(detect, image_size=size), cache=cache, boxes=boxes)

        found = choose_size(see, found)
    return know(opened, found)


def look_once(
    opened: Opened,
    detect: DetectConfig,
    *,
    cache: CachedDetections | None,
    boxes: Tensor | None = None,
) -> Found:
    """What one look finds, with its warnings in it: it may be thrown away.

    Args:
        opened: the scene.
        detect: which detector, and at which size.
        cache: of the detections.
        boxes: see `detect_scene`.
    """
    with collect_warnings() as said:
        look = detect_scene(opened.photos, detect, match=opened.config.match, cache=cache, boxes=boxes)
        found = _choose(opened, look, detect)
    return replace(found, said=tuple(said))


def _choose(opened: Opened, look: Look, detect: DetectConfig) -> Found:
    return find_leaves([look], opened.scene.cameras, config=detect, splits=opened.is_cut, cache=opened.surfaces)


def know(opened: Opened, found: Found) -> Known:
    """What is known once a look is chosen; warns of what there is to say of it."""
    for sentence in found.said:
        warn(sentence)
    if not len(found.looks[0].sure):
        warn(f"the detector finds nothing that scores {opened.config.detect.min_score:g} or more")
    matching = Matching(found.matched[0], found.report)
    known = Known(
        opened=opened,
        matching=matching,
        instances=Instances(),
        proposals=found.proposals,
        matched=found.matched,
        looks=found.looks,
        left=(),
        disagreement=describe_disagreement(matching, opened.names),
    )
    return known.with_leaves(found.leaves) if opened.is_chosen else known
