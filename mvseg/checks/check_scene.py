"""All checks of one scene: what `mvseg check` prints, and every run tells beside its result."""

from __future__ import annotations

from dataclasses import dataclass, replace

from mvseg.checks.cameras import Coverage, camera_findings, find_coverage
from mvseg.checks.groups import group_findings
from mvseg.checks.masks import mask_findings
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


@dataclass(frozen=True, eq=False)
class Check:
    """Outcome of the checks of a scene.

    Attributes:
        findings: the gravest first; empty for a sound scene that says its unit and up.
        agreement: of the masks with the poses; None without masks, or if all cameras are at one place.
    """

    scene: Scene
    regions: Regions | None
    findings: tuple[Finding, ...]
    coverage: Coverage
    photos: tuple[PhotoFacts, ...]
    agreement: PoseAgreement | None


@check_arguments
def check_scene(
    scene: Scene, regions: Regions | None = None, *, photos: Photos | None = None, is_detected: bool = False
) -> Check:
    """Check the cameras, the photos and, where given, the masks of a scene, and the poses by the masks.

    No ids are given. Everything runs on the CPU, wherever the inputs are.

    Args:
        scene: of V views; photos may be absent.
        photos: of the scene, where somebody has read them; None: they are read.
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
    findings = camera_findings(scene, coverage) + photo_findings(facts, scene, has_masks=regions is not None)
    agreement = None
    if regions is not None:
        check_views(regions, scene.cameras)
        findings += mask_findings(regions, scene.cameras, names, is_detected=is_detected)
        if not bool(is_coincident(scene.cameras).all()):
            agreement = pairwise_agreement(regions, scene.cameras)
            findings += low_fit_findings(regions, scene.cameras, agreement, is_detected=is_detected)
            findings += pose_findings(agreement, names) + group_findings(agreement, names)
    return Check(scene, regions, keep_causes(findings), coverage, tuple(facts), agreement)
