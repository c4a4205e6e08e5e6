"""The base of a leaf among its ends, and the upper one of its sides.

Bases sit on the stem: the ends of a plant's leaves that lie along one line; of the two or three leaves of a seedling,
those that are nearest to each other. The upper side is the one that the cameras look at.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise, product

import numpy as np
import torch

from mvseg.arrays import Floats
from mvseg.reconstruction.numbers import RAYS, STEM
from mvseg.reconstruction.surface.leaf_patch import COUNTS, NUM_COEFFICIENTS, SIDE
from mvseg.reconstruction.surface.leaf_surface import LeafSurface
from mvseg.scene import Cameras


def mirror_matrix() -> Floats:
    """(26, 26): of coefficients to those of the same surface with its edges exchanged (v -> -v). Normals turn over."""
    matrix = np.eye(NUM_COEFFICIENTS)
    matrix[SIDE] *= -1
    return matrix


def reversal_matrix() -> Floats:
    """(26, 26): of coefficients to those of the same surface from its other end (u -> 1 - u, v -> -v). Normals stay."""
    starts = np.cumsum((0, *COUNTS))
    return mirror_matrix()[np.concatenate([np.arange(first, last)[::-1] for first, last in pairwise(starts)])]


def orient_surfaces(surfaces: dict[int, LeafSurface], cameras: Cameras) -> dict[int, LeafSurface]:
    """The same surfaces, from base to tip where the stem's side can be told, with normals towards the cameras."""
    there = {instance: surface for instance, surface in surfaces.items() if surface.exists}
    oriented = dict(surfaces)
    ends = np.array([surface.midrib[[0, -1]].numpy() for surface in there.values()]).reshape(-1, 2, 3)
    has_stem = len(there) >= STEM.least_leaves
    distances = stem_distances(ends) if has_stem else base_distances(ends)
    for (instance, surface), (first, last) in zip(there.items(), distances, strict=True):
        is_clear = has_stem and abs(first - last) > STEM.clear * surface.length
        if last < first:
            surface = _transform(surface, reversal_matrix(), 0, 1)
        surface = replace(surface, is_oriented=bool(is_clear))
        towards = cameras.centers[surface.views].mean(0).cpu() - surface.midrib.mean(0)
        oriented[instance] = _transform(surface, mirror_matrix(), 1) if towards @ surface.normal < 0 else surface
    return oriented


def stem_distances(ends: Floats) -> Floats:
    """(N, 2) distances of both `ends` (N, 2, 3) of N >= 4 leaves from the stem: the line near one end of each leaf."""
    point = np.median(ends.reshape(-1, 3), axis=0)
    distances = np.linalg.norm(ends - point, axis=2)
    for _ in range(STEM.rounds):
        bases = ends[np.arange(len(ends)), distances.argmin(1)]
        point = np.median(bases, axis=0)
        weight = 1 / (1 + (distances.min(1) / np.median(distances.min(1)).clip(1e-12)) ** 2)
        direction = np.linalg.svd((bases - point) * weight[:, None])[2][0]
        away = ends - point
        away = away - (away @ direction)[..., None] * direction
        distances = np.linalg.norm(away, axis=2)
    return distances


def base_distances(ends: Floats) -> Floats:
    """(N, 2) sums of the distances of both `ends` (N, 2, 3) of N leaves from the bases of the others: the ends, one of
    each leaf, that are nearest to each other. All choices are compared, so it is for few leaves; 0 for a single one."""
    own = np.arange(len(ends))
    apart = np.linalg.norm(ends[:, :, None, None] - ends, axis=-1)  # (N, 2, N, 2) between all ends
    choices = [np.array(each, int) for each in product((0, 1), repeat=len(ends))]
    sums = np.array([apart[own[:, None], chosen[:, None], own, chosen].sum() for chosen in choices])
    bases = choices[int((sums <= sums.min() * (1 + RAYS.tie)).argmax())]
    to_bases = apart[:, :, own, bases]
    to_bases[own, :, own] = 0
    return to_bases.sum(2)


def _transform(surface: LeafSurface, matrix: Floats, *axes: int) -> LeafSurface:
    full = torch.from_numpy(np.kron(matrix, np.eye(3)))
    return replace(
        surface,
        coefficients=torch.from_numpy(matrix) @ surface.coefficients,
        covariance=full @ surface.covariance @ full.T,
        occupancy=None if surface.occupancy is None else surface.occupancy.flip(*axes),
    )
