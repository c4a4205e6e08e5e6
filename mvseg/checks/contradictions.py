"""Warnings of a run about cameras that its masks and photos contradict, although each view agrees with some others."""

from __future__ import annotations

import warnings
from functools import partial

from mvseg.checks.epipolar_distances import distance_findings
from mvseg.checks.groups import group_findings
from mvseg.checks.photo_matches import match_photos
from mvseg.checks.poses import pairwise_agreement
from mvseg.errors import InputWarning
from mvseg.formats.photos import read_photo
from mvseg.regions import Regions
from mvseg.scene import Scene


def warn_of_contradictions(scene: Scene, regions: Regions, *, photos: bool = True, progress: bool = False) -> None:
    """Warn (InputWarning) of views that agree in groups only, and of focal lengths that the photos contradict.

    Groups of views are found by masks, or else by photos. The matching warns of single views that disagree.

    Args:
        scene: of V >= 2 views.
        regions: its masks.
        photos: compare features of the photos, if there are any, too; takes about 0.1 s per photo.
        progress: show progress bars.
    """
    cameras, names = scene.cameras.to("cpu"), tuple(view.name for view in scene.views)
    findings = group_findings(pairwise_agreement(regions, cameras), names)
    if photos:
        matches = match_photos(partial(read_photo, scene), cameras, progress=progress)
        findings += distance_findings(matches, cameras, names, only_focal=bool(findings))
    for finding in findings:
        warnings.warn(finding.what, InputWarning, stacklevel=3)
