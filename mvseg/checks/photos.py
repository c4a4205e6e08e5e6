"""Checks photos against their cameras, and for useless content."""

from __future__ import annotations

import math
from collections import defaultdict
from dataclasses import dataclass

import numpy as np

from mvseg.checks.numbers import IMAGES
from mvseg.errors import InputError
from mvseg.findings.finding import Finding, Rule, Values, list_findings
from mvseg.formats.image_file import is_turned, read_exposure, read_image_size
from mvseg.formats.photos import PhotoContent, Photos, photos_in
from mvseg.scene import Scene
from mvseg.system.running import progress_bar


@dataclass(frozen=True)
class PhotoFacts:
    """One photo.

    Attributes:
        size: width and height as stored; None for a photo that is missing or cannot be read.
        problem: why it cannot be read; "" otherwise, also for a missing one.
        turned: EXIF asks viewers to turn it.
        content: None if no stage can use it.
    """

    size: tuple[int, int] | None = None
    problem: str = ""
    turned: bool = False
    content: PhotoContent | None = None
    digest: str = ""
    exposure: float = math.nan


def read_photo_facts(photos: Photos) -> list[PhotoFacts]:
    views = progress_bar(range(len(photos.scene.views)), name="checking photos", unit="photo")
    return [_read_facts(photos, view) for view in views]


def photo_findings(facts: list[PhotoFacts], scene: Scene, *, has_masks: bool) -> list[Finding]:
    """Findings about the photos of V views, by V entries; all may be missing where masks are given."""
    names = tuple(view.name for view in scene.views)
    missing = tuple(view for view, each in enumerate(facts) if each.size is None and not each.problem)
    rules: list[Rule] = []
    if missing:
        first = scene.views[missing[0]].path
        where: Values = {"path": str(first), "found": tuple(path.name for path in photos_in(first.parent))}
        if len(missing) < len(facts):
            rules.append(("missing_photos", "error", missing, where))
        else:
            rules.append(("no_photos", "note", None, {}) if has_masks else ("no_photos_no_masks", "error", None, where))
    broken = [(view, each.problem) for view, each in enumerate(facts) if each.problem]
    rules += [("broken_photo", "error", (view,), {"reason": problem}) for view, problem in broken]
    return list_findings([*rules, *_size_rules(facts, scene), *_content_rules(facts), *_exposure_rules(facts)], names)


def _size_rules(facts: list[PhotoFacts], scene: Scene) -> list[Rule]:
    by_size: dict[tuple[int, ...], list[int]] = defaultdict(list)
    for view, (each, camera) in enumerate(zip(facts, scene.cameras.sizes.tolist(), strict=True)):
        if each.size not in (None, tuple(camera)):
            by_size[*each.size, *camera].append(view)
    rules: list[Rule] = []
    for (width, height, *camera), views in by_size.items():
        sizes = {"width": width, "height": height, "camera_width": camera[0], "camera_height": camera[1]}
        rules.append(("photo_turned" if [height, width] == camera else "photo_size", "error", views, sizes))
    turned = [view for view, each in enumerate(facts) if each.turned]
    return [*rules, ("turned_for_display", "warning", turned, {"count": len(turned)})]


def _content_rules(facts: list[PhotoFacts]) -> list[Rule]:
    contents = {view: each.content for view, each in enumerate(facts) if each.content is not None}
    blank = [view for view, each in contents.items() if _is_blank(each)]
    contents = {view: each for view, each in contents.items() if view not in blank}
    same: dict[str, list[int]] = defaultdict(list)
    for view, each in enumerate(facts):
        same[each.digest or str(view)].append(view)
    return [
        ("blank_photo", "error", blank, {}),
        ("dark_photo", "warning", [view for view, each in contents.items() if each.level < IMAGES.dark], {}),
        ("overexposed_photo", "warning", [view for view, each in contents.items() if each.burnt > IMAGES.burnt], {}),
        ("grey_photo", "note", [view for view, each in contents.items() if each.grey], {}),
        *(("same_photo", "error", views, {}) for views in same.values() if len(views) > 1),
    ]


def _is_blank(content: PhotoContent) -> bool:
    return content.contrast < max(IMAGES.rounding, min(IMAGES.blank, IMAGES.blank_share * content.level))


def _exposure_rules(facts: list[PhotoFacts]) -> list[Rule]:
    exposures = np.array([each.exposure for each in facts])
    if np.isfinite(exposures).sum() < 2:
        return []
    apart = np.abs(exposures - np.nanmedian(exposures))
    others = np.flatnonzero(apart > IMAGES.stops).tolist()  # NaN is no more than anything
    return [("other_exposure", "note", others, {"stops": float(np.nanmax(apart))})]


def _read_facts(photos: Photos, view: int) -> PhotoFacts:
    scene, path = photos.scene, photos.scene.views[view].path
    if not path.is_file():
        return PhotoFacts()
    try:
        size = read_image_size(path)
        content = photos.content(view) if size == tuple(scene.cameras.sizes[view].tolist()) else None
    except InputError as error:
        return PhotoFacts(problem=str(error.__cause__ or error))  # the reason alone
    turned, exposure = is_turned(path), read_exposure(path)
    return PhotoFacts(size=size, turned=turned, content=content, digest=photos.sha256(view), exposure=exposure)
