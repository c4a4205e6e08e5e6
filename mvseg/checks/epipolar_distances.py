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

from mvseg.checks.numbers import FEATURES
from mvseg.checks.photo_matches import PhotoMatches
from mvseg.findings.finding import Finding, Rule, list_findings
from mvseg.scene import Cameras

Floats = NDArray[np.float64]

FACTORS = np.exp(np.linspace(-1, 1, 101))  # of the focal length, in steps of 2 %; the middle one is 1


def distance_findings(matches: Sequence[PhotoMatches], cameras: Cameras, names: tuple[str, ...]) -> list[Finding]:
    """How the features of the photos contradict the cameras.

    Nothing if too few features match (plain leaves before black cloth), or if most of them do not move between photos:
    on a turntable, what does not turn says nothing about the cameras.
    """
    significant = list_significant(matches)
    factor = focal_factor(significant, cameras)
    rules: list[Rule] = []
    if factor != 1:
        before, after = (_median_px(significant, cameras, each) for each in (1.0, factor))
        rules.append(("focal_lengths_wrong", "error", None, {"factor": factor, "before": before, "after": after}))
        cameras = scale_focal(cameras, factor)
    return list_findings([*rules, *_pose_rules(significant, cameras)], names)


def list_significant(matches: Sequence[PhotoMatches]) -> list[PhotoMatches]:
    """The pairs of photos that say something about their cameras; none if most features do not move."""
    num_still = sum(pair.num_still for pair in matches)
    is_still = num_still > sum(pair.xy.shape[1] for pair in matches)
    return [] if is_still else [pair for pair in matches if pair.is_significant]


def groups_that_fit(significant: Sequence[PhotoMatches], cameras: Cameras) -> NDArray[np.int64]:
    """(V,) number of the group of each view: pairs of photos whose features fit the cameras link them."""
    fitting = [pair.views for pair in significant if _fitting_share(pair, cameras) > FEATURES.agrees]
    first, second = np.array(fitting, int).reshape(-1, 2).T
    links = coo_array((np.ones(len(first)), (first, second)), (len(cameras), len(cameras)))
    return np.asarray(connected_components(links, directed=False)[1], np.int64)


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


def _fitting_share(pair: PhotoMatches, cameras: Cameras) -> float:
    fits = epipolar_distances(pair.xy, fundamental(pair.views, cameras)) < FEATURES.offset * pair.unit_px
    return float(fits.sum() / pair.is_rigid.sum())


def _pose_rules(significant: Sequence[PhotoMatches], cameras: Cameras) -> list[Rule]:
    """The rule about each group of views whose cameras contradict most of the pairs of photos with them, or the one
    about all cameras. A cause explains most of the wrong pairs: a few may come of leaves that moved."""
    wrong = [pair for pair in significant if _fitting_share(pair, cameras) < FEATURES.contradicts]
    if not wrong or (len(wrong) == 1 and len(significant) > 1):
        return []
    group = groups_that_fit(significant, cameras)
    sizes = np.bincount(group)
    largest = max(range(len(sizes)), key=lambda each: (sizes[each], np.flatnonzero(group == each)[0]))
    others = [np.flatnonzero(group == each).tolist() for each in range(len(sizes)) if each != largest]
    rules: list[Rule] = []
    explained: set[tuple[int, int]] = set()
    # the groups beside the largest one; where these are most views, the largest one beside them
    for views in others if 2 * sizes[largest] >= len(group) else [np.flatnonzero(group == largest).tolist()]:
        bad, with_it = (
            [pair for pair in pairs if (pair.views[0] in views) != (pair.views[1] in views)]
            for pairs in (wrong, significant)
        )
        if len(bad) > max(1, len(with_it) / 2):
            explained |= {pair.views for pair in bad}
            code = "features_off_one" if len(views) == 1 else "features_off_group"
            rules.append((code, "error", views, _count_wrong(bad, with_it, cameras)))
    if len(explained) > len(wrong) / 2 and sizes[largest] > 1:
        return rules
    if len(wrong) > len(significant) / 2:
        return [("features_contradict", "error", None, _count_wrong(wrong, significant, cameras))]
    return []


def _count_wrong(
    wrong: Sequence[PhotoMatches], compared: Sequence[PhotoMatches], cameras: Cameras
) -> dict[str, str | float | tuple[str, ...]]:
    return {"wrong": len(wrong), "compared": len(compared), "px": _median_px(wrong, cameras)}
