"""Scale, rotation and translation that structure from motion leaves undetermined, from points known in both frames.

Closed form: Umeyama, Least-squares estimation of transformation parameters between two point patterns (PAMI 1991).
`similarity * points` are (P, 3) points of the scene in the known world. pycolmap's own `estimate_sim3d` refuses
coplanar points, such as those of a board, and its robust version finds fewer inliers among them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pycolmap
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from mvseg.arrays import Floats
from mvseg.errors import InputError
from mvseg.poses.numbers import WORLD

MIRROR = np.array([1.0, 1.0, -1.0])


@dataclass(frozen=True, eq=False)
class SimilarityFit:
    """A similarity that most of the points agree on.

    Attributes:
        similarity: world_from_scene, fitted to the inliers by least squares.
        residuals: (P,) distances between targets and mapped sources, target units.
        is_inlier: (P,) bool, the points that were used.
    """

    similarity: pycolmap.Sim3d
    residuals: Floats
    is_inlier: NDArray[np.bool_]

    @property
    def rms(self) -> float:
        """Root mean square residual of the inliers, target units."""
        return float(np.sqrt((self.residuals[self.is_inlier] ** 2).mean()))


def scale_by(factor: float) -> pycolmap.Sim3d:
    """The similarity that only multiplies lengths."""
    return pycolmap.Sim3d(factor, pycolmap.Rotation3d(), np.zeros(3))


def spreads(points: Floats) -> Floats:
    """(3,) standard deviations of P points along their principal axes, the largest first."""
    return np.linalg.svd(points - points.mean(0), compute_uv=False, full_matrices=False)[:3] / np.sqrt(len(points))


def is_one_line(points: Floats) -> bool:
    """Whether points coincide or are collinear, as two always are: the rotation about the line is undetermined."""
    if len(points) < 3:
        return True
    along, across = spreads(points)[:2]
    return bool(across <= WORLD.flat * along)


def fit_similarity(source: Floats, target: Floats) -> pycolmap.Sim3d:
    """The similarity with the least squared distances between mapped sources (P, 3) and their targets (P, 3) (Umeyama).
    Raises InputError for fewer than three points, points on one line, or targets that are the mirror image of the
    sources (left-handed axes), which cannot be detected for coplanar points."""
    if len(source) < 3:
        raise InputError(f"{len(source)} known points, expected at least three that are not on one line")
    if is_one_line(source) or is_one_line(target):
        raise InputError("the known points lie on one line, expected some off it: the rotation about it is free")
    fits = [(_fit(each, target), each) for each in (source, source * MIRROR)]
    residuals = [float(np.linalg.norm(_residuals(fit, each, target))) / np.sqrt(len(source)) for fit, each in fits]
    _refuse_mirror(source, target, residuals)
    return fits[0][0]


def _fit(source: Floats, target: Floats) -> pycolmap.Sim3d:
    from_source, from_target = source - source.mean(0), target - target.mean(0)
    turn, _ = Rotation.align_vectors(from_target, from_source)
    scale = float((from_target * turn.apply(from_source)).sum() / (from_source**2).sum())
    shift = target.mean(0) - scale * turn.apply(source.mean(0))
    return pycolmap.Sim3d(scale, pycolmap.Rotation3d(turn.as_matrix()), shift)


def _refuse_mirror(source: Floats, target: Floats, residuals: list[float]) -> None:
    """Raise InputError if mirrored sources fit far better; `residuals` are of both. In one plane both are as good."""
    is_flat = any(off <= WORLD.flat * across for _, across, off in (spreads(source), spreads(target)))
    if not is_flat and residuals[1] < WORLD.mirrored * residuals[0] and residuals[0] > WORLD.flat * spreads(target)[0]:
        raise InputError("the known points are mirrored, expected right-handed axes: reverse one axis")


def align(source: Floats, target: Floats) -> SimilarityFit:
    """A similarity that ignores the targets (P, 3) that contradict most others (least median of squares, then least
    squares). Of P targets, (P - 4) / 2 rounded up may be wrong: none of three or four, one of five, 28 of 60.
    Deterministic. Raises InputError, see `fit_similarity`."""
    is_inlier = np.ones(len(source), bool)
    if len(source) < 5 or is_one_line(source) or is_one_line(target):
        best = fit_similarity(source, target)
    else:
        found, mirrored = (_most_agreed(each, target) for each in (source, source * MIRROR))
        _refuse_mirror(source, target, [found[1], mirrored[1]])
        best = found[0]
        for _ in range(3):
            residuals = _residuals(best, source, target)
            limit = WORLD.outlier * (1 + 5 / (len(source) - 3)) * _agreement(residuals)
            is_inlier = residuals <= max(limit, WORLD.rounding * spreads(target)[0])
            if is_one_line(source[is_inlier]) or is_one_line(target[is_inlier]):
                is_inlier[:] = True
            best = fit_similarity(source[is_inlier], target[is_inlier])
    return SimilarityFit(similarity=best, residuals=_residuals(best, source, target), is_inlier=is_inlier)


def _residuals(similarity: pycolmap.Sim3d, source: Floats, target: Floats) -> Floats:
    return np.linalg.norm(similarity * source - target, axis=1)


def _agreement(residuals: Floats) -> float:
    """The residual that just over half of the points do not exceed, the three that always fit not counted."""
    return float(np.sort(residuals)[(len(residuals) + 4) // 2 - 1])


def _most_agreed(source: Floats, target: Floats) -> tuple[pycolmap.Sim3d, float]:
    rng = np.random.default_rng(0)
    triples = [rng.choice(len(source), 3, replace=False) for _ in range(WORLD.trials)]
    triples = [three for three in triples if not (is_one_line(source[three]) or is_one_line(target[three]))]
    fits = [_fit(source[three], target[three]) for three in triples] or [_fit(source, target)]
    agreements = [_agreement(_residuals(fit, source, target)) for fit in fits]
    best = int(np.argmin(agreements))
    return fits[best], agreements[best]
