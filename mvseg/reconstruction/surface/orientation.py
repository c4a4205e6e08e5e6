"""Which end of a leaf is its base, and which of its sides is up.

Bases sit on the stem: over the leaves of a plant, the ends that lie along one line. The upper side is the one that the
cameras look at.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import torch

from mvseg.reconstruction.numbers import STEM
from mvseg.reconstruction.surface.leaf_patch import COUNTS, NUM_COEFFICIENTS, SIDE, Floats
from mvseg.reconstruction.surface.leaf_surface import LeafSurface
from mvseg.scene import Cameras


def turn_matrix() -> Floats:
    """(26, 26): of coefficients to those of the same surface from its other end (u -> 1 - u, v -> -v). Normals stay."""
    starts = np.cumsum((0, *COUNTS))
    order = np.concatenate([np.arange(first, last)[::-1] for first, last in pairwise(starts)])
    matrix = np.eye(NUM_COEFFICIENTS)[order]
    matrix[SIDE] *= -1
    return matrix


def mirror_matrix() -> Floats:
    """(26, 26): of coefficients to those of the same surface with its edges exchanged (v -> -v). Normals turn over."""
    matrix = np.eye(NUM_COEFFICIENTS)
    matrix[SIDE] *= -1
    return matrix


def orient_surfaces(surfaces: dict[int, LeafSurface], cameras: Cameras) -> dict[int, LeafSurface]:
    """The same surfaces, from base to tip where the stem's side can be told, with normals towards the cameras."""
    there = {instance: surface for instance, surface in surfaces.items() if surface.exists}
    oriented = dict(surfaces)
    ends = np.array([surface.midrib[[0, -1]].numpy() for surface in there.values()]).reshape(-1, 2, 3)
    to_stem = stem_distances(ends) if len(there) >= STEM.least_leaves else None
    for index, (instance, surface) in enumerate(there.items()):
        if to_stem is not None:
            first, last = to_stem[index]
            if last < first:
                surface = _transform(surface, turn_matrix())
            surface = replace(surface, is_oriented=bool(abs(first - last) > STEM.clear * surface.length))
        towards = cameras.centers[surface.views].mean(0).cpu() - surface.midrib.mean(0)
        oriented[instance] = _transform(surface, mirror_matrix()) if towards @ surface.normal < 0 else surface
    return oriented


def stem_distances(ends: Floats) -> Floats:
    """(N, 2) distances of both ends of N leaves from the stem: the line near which each leaf has one end.

    Args:
        ends: (N, 2, 3), N >= 4.
    """
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


def _transform(surface: LeafSurface, matrix: Floats) -> LeafSurface:
    full = torch.from_numpy(np.kron(matrix, np.eye(3)))
    return replace(
        surface,
        coefficients=torch.from_numpy(matrix) @ surface.coefficients,
        covariance=full @ surface.covariance @ full.T,
    )
