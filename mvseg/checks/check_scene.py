"""All checks of one scene, as a report that the command prints and a page can show; or as the warnings of a run."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from mvseg.checks.cameras import Coverage, camera_findings, find_coverage
from mvseg.checks.epipolar_distances import distance_findings
from mvseg.checks.finding import Finding
from mvseg.checks.groups import group_findings
from mvseg.checks.masks import mask_findings
from mvseg.checks.photo_matches import match_photos
from mvseg.checks.photos import PhotoFacts, photo_findings, read_photo_facts
from mvseg.checks.poses import PoseAgreement, pairwise_agreement, pose_findings
from mvseg.checks.turned_masks import low_fit_findings
from mvseg.errors import check_arguments, warn
from mvseg.formats.photos import Photos
from mvseg.matching.match import check_views
from mvseg.matching.pencil import is_coincident
from mvseg.regions import Regions
from mvseg.scene import Scene


@dataclass(frozen=True, eq=False)
class Check:
    """What the checks of a scene found.

    Attributes:
        scene: that was checked.
        regions: its masks, None without any.
        findings: in the order cameras, photos, masks, poses; empty for a sound scene that says its unit and up.
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
        return _has_error(self.findings)


@check_arguments
def check_scene(
    scene: Scene, regions: Regions | None = None, *, photos: Photos | None = None, features: bool = True
) -> Check:
    """Check the cameras, the photos and, where given, the masks of a scene, and the poses by the masks and the photos.

    No ids are given. Everything runs on the CPU, wherever the inputs are.

    Args:
        scene: of V views; photos may be absent.
        regions: its masks.
        photos: of the scene, where somebody has read them; None: they are read.
        features: compare features of neighbouring photos with the cameras.

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
        findings += mask_findings(regions, scene.cameras, names)
        if not bool(is_coincident(scene.cameras).all()):
            agreement = pairwise_agreement(regions, scene.cameras)
            low_fit = low_fit_findings(regions, scene.cameras, agreement)
            contradictions = pose_findings(agreement, names) + group_findings(agreement, names)
            # masks that are turned explain what contradicts the poses, which explains masks that hardly fit
            findings += low_fit if _has_error(low_fit) else contradictions
            findings += [] if _has_error(low_fit + contradictions) else low_fit
    if features:
        is_said = _has_error([each for each in findings if each.where == "poses"])
        findings += _compare_photos(photos, scene, only_focal=is_said)
    return Check(
        scene=scene,
        regions=regions,
        findings=tuple(findings),
        coverage=coverage,
        photos=tuple(facts),
        agreement=agreement,
    )


def _has_error(findings: Sequence[Finding]) -> bool:
    return any(finding.level == "error" for finding in findings)


def warn_of_contradictions(scene: Scene, regions: Regions, *, photos: Photos | None = None) -> tuple[Finding, ...]:
    """Warn (InputWarning) of masks of turned photos, of views that agree in groups only, and of poses and focal lengths
    that the photos contradict; returns what was found.

    Groups of views are found by masks, or else by photos. The matching warns of single views that disagree.

    Args:
        scene: of V >= 2 views.
        regions: its masks.
        photos: compare their features, too, which takes about 0.1 s per photo; None: there are none, or they are not
            asked.
    """
    scene = replace(scene, cameras=scene.cameras.to("cpu"))
    agreement = pairwise_agreement(regions, scene.cameras)
    low_fit = low_fit_findings(regions.to("cpu"), scene.cameras, agreement)
    names = tuple(view.name for view in scene.views)
    findings = low_fit if _has_error(low_fit) else group_findings(agreement, names)
    if photos is not None:
        findings += _compare_photos(photos, scene, only_focal=bool(findings))
    for finding in findings:
        warn(finding.what)
    return tuple(findings)


def _compare_photos(photos: Photos, scene: Scene, *, only_focal: bool) -> list[Finding]:
    matches = match_photos(photos, scene.cameras)
    return distance_findings(matches, scene.cameras, tuple(view.name for view in scene.views), only_focal=only_focal)
