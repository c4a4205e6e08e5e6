"""All checks of one scene: what `mvseg check` prints, and every run tells beside its result."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mvseg.checks.cameras import Coverage, camera_findings, find_coverage
from mvseg.checks.epipolar_distances import distance_findings, groups_that_fit, list_significant
from mvseg.checks.groups import group_findings
from mvseg.checks.masks import detected_findings, mask_findings
from mvseg.checks.photo_matches import match_photos
from mvseg.checks.photos import PhotoFacts, photo_findings, read_photo_facts
from mvseg.checks.poses import PoseAgreement, pairwise_agreement, pose_findings
from mvseg.checks.turned_masks import low_fit_findings
from mvseg.errors import check_arguments
from mvseg.findings.finding import Finding, keep_causes
from mvseg.formats.photos import Photos
from mvseg.matching.match import check_views
from mvseg.matching.pencil import is_coincident
from mvseg.regions import Regions
from mvseg.scene import Scene

# What masks that disagree with poses are, where photos show that the poses are right.
OF_OTHER_PHOTOS = {"view_off": "masks_of_other_photo", "poses_disagree": "masks_of_other_photos"}


@dataclass(frozen=True, eq=False)
class Check:
    """Outcome of the checks of a scene.

    Attributes:
        scene: that was checked.
        regions: its masks, None without any.
        findings: the gravest first; empty for a sound scene that says its unit and up.
        coverage: what the cameras look at.
        photos: one entry per view.
        agreement: of the masks with the poses; None without masks, or if all cameras are at one place.
    """

    scene: Scene
    regions: Regions | None
    findings: tuple[Finding, ...]
    coverage: Coverage
    photos: tuple[PhotoFacts, ...]
    agreement: PoseAgreement | None

    @property
    def has_errors(self) -> bool:
        return any(finding.level == "error" for finding in self.findings)


@check_arguments
def check_scene(
    scene: Scene,
    regions: Regions | None = None,
    *,
    photos: Photos | None = None,
    features: bool = True,
    is_detected: bool = False,
) -> Check:
    """Check the cameras, the photos and, where given, the masks of a scene, and the poses by the masks and the photos.

    No ids are given. Everything runs on the CPU, wherever the inputs are.

    Args:
        scene: of V views; photos may be absent.
        photos: of the scene, where somebody has read them; None: they are read.
        features: compare features of neighbouring photos with the cameras, which takes about 0.1 s per photo.
        is_detected: a detector found the masks in these photos, so they are of no others.

    Raises:
        InputError: regions and scene of different numbers of views.
    """
    scene = replace(scene, cameras=scene.cameras.to("cpu"))
    regions = None if regions is None else regions.to("cpu")
    names = tuple(view.name for view in scene.views)
    coverage = find_coverage(scene.cameras)
    photos = photos or Photos(scene)
    facts = read_photo_facts(photos)
    matches = match_photos(photos, scene.cameras) if features else []
    findings = camera_findings(scene, coverage) + photo_findings(facts, scene, has_masks=regions is not None)
    agreement = None
    if regions is not None:
        check_views(regions, scene.cameras)
        select = detected_findings if is_detected else mask_findings
        findings += select(regions, scene.cameras, names)
        if not bool(is_coincident(scene.cameras).all()):
            agreement = pairwise_agreement(regions, scene.cameras)
            findings += low_fit_findings(regions, scene.cameras, agreement, is_detected=is_detected)
            by_masks = pose_findings(agreement, names) + group_findings(agreement, names)
            findings += _judge(
                by_masks, groups_that_fit(list_significant(matches), scene.cameras), is_detected=is_detected
            )
    findings += distance_findings(matches, scene.cameras, names)
    return Check(
        scene=scene,
        regions=regions,
        findings=keep_causes(findings),
        coverage=coverage,
        photos=tuple(facts),
        agreement=agreement,
    )


def _judge(findings: Sequence[Finding], groups: NDArray[np.int64], *, is_detected: bool) -> list[Finding]:
    """Findings about poses from masks. Views whose photos fit the cameras of most others (`groups_that_fit`) are
    excepted: their poses are right, so their masks are of another photo, or mistakes of the detector."""
    sizes = np.bincount(groups)
    is_sound = (groups == sizes.argmax()) & (sizes.max() > len(groups) / 2)
    judged = []
    for each in findings:
        if not (is_sound[list(each.views)].all() and is_sound.any()):  # about the whole scene: most views are sound
            judged.append(each)
        elif each.code in OF_OTHER_PHOTOS and not is_detected:
            judged.append(replace(each, code=OF_OTHER_PHOTOS[each.code]))
    return judged
