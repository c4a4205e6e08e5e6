"""Do the cameras agree with what the photos share? By epipolar distances of features, pair by pair.

A pair of photos whose features fit one fundamental matrix, but not that of their cameras, contradicts the cameras. One
factor of all focal lengths at which the features of the pairs fit far better is the error of the focal length.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from mvseg.checks.finding import Finding, Rule, list_findings
from mvseg.checks.groups import NEXT_STEP
from mvseg.checks.numbers import AGREEMENT, FEATURES
from mvseg.checks.photo_matches import PhotoMatches
from mvseg.formats.find_views import name_views
from mvseg.scene import Cameras

Floats = NDArray[np.float64]

FACTORS = np.exp(np.linspace(-1, 1, 101))  # of the focal length, in steps of 2 %; the middle one is 1

ONE_STEP = "it has the pose of another photo, or was moved; correct it or leave it out"
QUESTION = "do R and t map world points to the camera, and does each camera belong to its photo?"


def distance_findings(
    matches: Sequence[PhotoMatches], cameras: Cameras, names: tuple[str, ...], *, only_focal: bool = False
) -> list[Finding]:
    """How the features of the photos contradict the cameras.

    Nothing if too few features match (plain leaves before black cloth), or if most of them do not move between photos:
    on a turntable, what does not turn says nothing about the cameras. With `only_focal` poses are skipped: masks have
    warned of them already.
    """
    num_still = sum(pair.num_still for pair in matches)
    if num_still > sum(pair.xy.shape[1] for pair in matches):
        return []
    significant = [pair for pair in matches if pair.is_significant]
    factor = focal_factor(significant, cameras)
    rules: list[Rule] = []
    if factor != 1:
        before, after = (_median_px(significant, cameras, each) for each in (1.0, factor))
        facts = f"features of the photos miss their epipolar lines by {before:.1f} px, and by {after:.1f} px with that"
        what = f"the focal lengths seem wrong, expected about {factor:.2f} times as much ({facts}): is K that of these "
        what += "photos, of this zoom and in pixels of this size?"
        rules.append(("error", None, what))
        cameras = scale_focal(cameras, factor)
    if not only_focal:
        rules += _pose_rules(significant, cameras, names)
    return list_findings("poses", rules, names)


def focal_factor(matches: Sequence[PhotoMatches], cameras: Cameras) -> float:
    """The factor of all focal lengths with which the features fit; 1 if that is not certain.

    Another focal length is certain if it halves the median epipolar distance, brings it below what fits in 70 % of
    the pairs, differs by 5 % or more, and is not at the end of the tested range (0.37 to 2.7).
    """
    if len(matches) < FEATURES.fewest_pairs:
        return 1.0
    cost = np.stack([_median_distances(pair, cameras, FACTORS) for pair in matches], 1)
    best, given = int(np.median(cost, axis=1).argmin()), len(FACTORS) // 2
    is_inside = 0 < best < len(FACTORS) - 1
    is_far = abs(np.log(FACTORS[best])) > FEATURES.least_error
    is_better = np.median(cost[best]) < FEATURES.better * np.median(cost[given])
    shares = np.mean(cost[best] < cost[given]), np.mean(cost[best] < FEATURES.offset)
    is_certain = is_inside and is_far and is_better and min(shares) >= FEATURES.most
    return float(FACTORS[best]) if is_certain else 1.0


def scale_focal(cameras: Cameras, factor: float) -> Cameras:
    """Cameras with other focal lengths."""
    K = cameras.K.clone()
    K[:, [0, 1], [0, 1]] *= factor
    return replace(cameras, K=K)


def fundamental(views: tuple[int, int], cameras: Cameras) -> Floats:
    """(3, 3) F with x_j^T F x_i = 0 for the views i and j."""
    first, second = views
    K, R, centers = cameras.K.numpy(), cameras.R.numpy(), cameras.centers.numpy()
    x, y, z = R[second] @ (centers[first] - centers[second])
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.asarray(np.linalg.inv(K[second]).T @ cross @ R[second] @ R[first].T @ np.linalg.inv(K[first]))


def epipolar_distances(xy: Floats, F: Floats) -> Floats:
    """(..., N) pixels, Sampson's distance of points (..., 2, N, 2) of two views: of both photos together."""
    one, other = np.moveaxis(np.concatenate((xy, np.ones_like(xy[..., :1])), -1), -3, 0)
    lines, back = one @ F.T, other @ F
    slope = np.hypot(np.hypot(lines[..., 0], lines[..., 1]), np.hypot(back[..., 0], back[..., 1]))
    return np.asarray(np.abs((other * lines).sum(-1)) / slope.clip(min=1e-300))


def _median_distances(pair: PhotoMatches, cameras: Cameras, factors: Floats) -> Floats:
    """(F,) units, median epipolar distance of the features that fit one fundamental matrix, with focal lengths so many
    times as long: as if the photos were as much smaller about their principal points."""
    centers = cameras.K[list(pair.views), None, :2, 2].numpy()
    xy = (pair.xy[:, pair.is_rigid] - centers) / factors[:, None, None, None] + centers
    distances = epipolar_distances(xy, fundamental(pair.views, cameras))
    return np.asarray(np.median(distances, -1) * factors / pair.unit_px)


def _median_px(matches: Sequence[PhotoMatches], cameras: Cameras, factor: float = 1) -> float:
    medians = [_median_distances(pair, cameras, np.array([factor])) * pair.unit_px for pair in matches]
    return float(np.median(medians))


def _pose_rules(significant: Sequence[PhotoMatches], cameras: Cameras, names: tuple[str, ...]) -> list[Rule]:
    """The pairs of views that contradict their cameras, as one rule; one pair among others may be a mistake."""
    shares = []  # of the features that fit one fundamental matrix: those that fit that of the cameras
    for pair in significant:
        fits = epipolar_distances(pair.xy, fundamental(pair.views, cameras)) < FEATURES.offset * pair.unit_px
        shares.append(float(fits.sum() / pair.is_rigid.sum()))
    wrong = [pair for pair, share in zip(significant, shares, strict=True) if share < FEATURES.contradicts]
    if not wrong or (len(wrong) == 1 and len(significant) > 1):
        return []
    agreeing = [pair.views for pair, share in zip(significant, shares, strict=True) if share > FEATURES.agrees]
    facts = f"in {len(wrong)} of {len(significant)} pairs of photos they miss by {_median_px(wrong, cameras):.0f} px"
    few, many = _sides(agreeing, [pair.views for pair in wrong], len(names))
    if not few:
        return [("error", None, f"features of the photos contradict the cameras ({facts}): {QUESTION}")]
    between = " and those of ".join(name_views(side, names, shown=AGREEMENT.named) for side in (few, many))
    step = ONE_STEP if len(few) == 1 else NEXT_STEP
    return [("error", few, f"features of the photos do not fit both the cameras of {between} ({facts}): {step}")]


def _sides(
    agreeing: Sequence[tuple[int, int]], wrong: Sequence[tuple[int, int]], num: int
) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Fewer and more views that contradict each other: of the groups of views that agree, the smallest one that is in
    all wrong pairs, and all others that are in some; empty where there is none."""
    if not agreeing:
        return (), ()
    first, second = np.array(agreeing).T
    group = connected_components(coo_array((np.ones(len(first)), (first, second)), (num, num)), directed=False)[1]
    pairs = [{int(group[i]), int(group[j])} for i, j in wrong]
    shared = sorted(set.intersection(*pairs), key=lambda each: int((group == each).sum()))
    others = set().union(*pairs) - set(shared[:1])
    if not shared or not others:
        return (), ()
    sides = [tuple(np.flatnonzero(np.isin(group, side)).tolist()) for side in (shared[:1], sorted(others))]
    few, many = sorted(sides, key=lambda side: (len(side), side))
    return few, many
