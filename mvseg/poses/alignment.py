"""Similarities: the scale, turn and shift that structure from motion leaves open, from points known in both worlds.

Closed form: Umeyama, Least-squares estimation of transformation parameters between two point patterns (PAMI 1991).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mvseg.errors import InputError

Floats = NDArray[np.float64]

FLAT = 0.02  # spread across over spread along, below which points count as one line (or one plane)
MIRRORED = 0.5  # residual of the best reflection over that of the best similarity, below which axes are left-handed
TRIALS = 300  # random triples of points
OUTLIER = 3.0  # residuals that over half of the points keep to, times this, are still theirs
ROUNDING = 1e-9  # of the spread of the points: residuals below it are none


@dataclass(frozen=True, eq=False)
class Similarity:
    """target = scale * R @ source + t.

    Attributes:
        scale: > 0, target units per source unit.
        R: (3, 3) float64 rotation.
        t: (3,) float64, target units.
    """

    scale: float
    R: Floats
    t: Floats

    def apply(self, points: Floats) -> Floats:
        """(P, 3) source points in the target frame."""
        return self.scale * points @ self.R.T + self.t

    @property
    def matrix(self) -> Floats:
        """(3, 4): `matrix @ (x, y, z, 1)`."""
        return np.column_stack([self.scale * self.R, self.t])


@dataclass(frozen=True, eq=False)
class Alignment:
    """A similarity that most of the points agree on.

    Attributes:
        similarity: fitted to the inliers by least squares.
        residuals: (P,) distances between targets and mapped sources, target units.
        is_inlier: (P,) bool, the points that were used.
    """

    similarity: Similarity
    residuals: Floats
    is_inlier: NDArray[np.bool_]

    @property
    def rms(self) -> float:
        """Root mean square residual of the inliers, target units."""
        return float(np.sqrt((self.residuals[self.is_inlier] ** 2).mean()))


def scale_by(factor: float) -> Similarity:
    """The similarity that only multiplies lengths."""
    return Similarity(scale=factor, R=np.eye(3), t=np.zeros(3))


def spreads(points: Floats) -> Floats:
    """(3,) standard deviations of P points along their principal axes, the largest first."""
    return np.linalg.svd(points - points.mean(0), compute_uv=False, full_matrices=False)[:3] / np.sqrt(len(points))


def is_one_line(points: Floats) -> bool:
    """Whether points lie on one line (or at one place), so that the turn about it stays open; two always do."""
    if len(points) < 3:
        return True
    along, across = spreads(points)[:2]
    return bool(across <= FLAT * along)


def fit_similarity(source: Floats, target: Floats) -> Similarity:
    """The similarity with the least squared distances between P mapped sources and their targets (Umeyama).

    Args:
        source: (P, 3), P >= 3, not on one line.
        target: (P, 3), the same points in the other world, not on one line.

    Raises:
        InputError: fewer than three points, points on one line, or targets that are the mirror image of the sources
            (left-handed axes). Of points in one plane no one can tell.
    """
    if len(source) < 3:
        raise InputError(f"{len(source)} known points, expected at least three that are not on one line")
    if is_one_line(source) or is_one_line(target):
        raise InputError("the known points lie on one line, expected some beside it: the turn about it stays open")
    proper, mirrored = (_fit(source, target, mirror=mirror) for mirror in (False, True))
    if not _is_flat(source) and not _is_flat(target):
        fits, size = (proper, mirrored), np.sqrt(len(source))
        misses = [float(np.linalg.norm(fit.apply(source) - target)) / size for fit in fits]
        if misses[1] < MIRRORED * misses[0]:
            _refuse_mirror(misses[0], target)
    return proper


def _is_flat(points: Floats) -> bool:
    """Whether points lie in one plane; a mirror image is then as good as a turn."""
    _, across, off = spreads(points)
    return bool(off <= FLAT * across)


def _refuse_mirror(miss: float, target: Floats) -> None:
    if miss > FLAT * spreads(target)[0]:  # below, the two differ by noise
        raise InputError("the known points fit as in a mirror only, expected right-handed axes: turn one round")


def _fit(source: Floats, target: Floats, *, mirror: bool) -> Similarity:
    """Umeyama's equations (40) to (42); `mirror` asks for a reflection, whose R has determinant -1."""
    from_source, from_target = source - source.mean(0), target - target.mean(0)
    left, sizes, right = np.linalg.svd(from_target.T @ from_source)
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(left) * np.linalg.det(right))])
    if mirror:
        signs[2] = -signs[2]
    R = (left * signs) @ right
    scale = float((sizes * signs).sum() / (from_source**2).sum())
    return Similarity(scale=scale, R=R, t=target.mean(0) - scale * R @ source.mean(0))


def align(source: Floats, target: Floats) -> Alignment:
    """A similarity that ignores the targets that contradict most others (least median of squares, then least squares).

    Of P targets, (P - 4) / 2 rounded up may be wrong: none of three or four, one of five, 28 of 60. Deterministic.

    Args:
        source: (P, 3).
        target: (P, 3).

    Raises:
        InputError: see `fit_similarity`.
    """
    if len(source) < 5 or is_one_line(source) or is_one_line(target):
        best, is_inlier = fit_similarity(source, target), np.ones(len(source), bool)
    else:
        best = _most_agreed(source, target)
        for _ in range(3):
            residuals = np.linalg.norm(best.apply(source) - target, axis=1)
            limit = OUTLIER * (1 + 5 / (len(source) - 3)) * _agreement(residuals)
            is_inlier = residuals <= max(limit, ROUNDING * spreads(target)[0])
            if is_one_line(source[is_inlier]) or is_one_line(target[is_inlier]):
                is_inlier[:] = True
            best = fit_similarity(source[is_inlier], target[is_inlier])
    residuals = np.linalg.norm(best.apply(source) - target, axis=1)
    return Alignment(similarity=best, residuals=residuals, is_inlier=is_inlier)


def _agreement(residuals: Floats) -> float:
    """The residual that just over half of the points do not exceed, the three that always fit not counted."""
    return float(np.sort(residuals)[(len(residuals) + 4) // 2 - 1])


def _most_agreed(source: Floats, target: Floats) -> Similarity:
    """The similarity of three points on which just over half of all points agree best."""
    rng, best, agreed = np.random.default_rng(0), None, {False: np.inf, True: np.inf}
    for _ in range(TRIALS):
        triple = rng.choice(len(source), 3, replace=False)
        if is_one_line(source[triple]) or is_one_line(target[triple]):
            continue
        for mirror in (False, True):
            fit = _fit(source[triple], target[triple], mirror=mirror)
            agreement = _agreement(np.linalg.norm(fit.apply(source) - target, axis=1))
            if agreement < agreed[mirror]:
                agreed[mirror] = agreement
                best = best if mirror else fit
    if best is None:
        return fit_similarity(source, target)
    if not _is_flat(source) and not _is_flat(target) and agreed[True] < MIRRORED * agreed[False]:
        _refuse_mirror(agreed[False], target)
    return best
