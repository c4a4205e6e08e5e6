"""The leaves of a date as arrays, and those of two dates that are compared."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from mvseg.arrays import Floats
from mvseg.table import Table
from mvseg.tracking.dates import PlantOnDate, SeenLeaf
from mvseg.tracking.numbers import ALIGN, COSTS, OBSERVATIONS


@dataclass(frozen=True, eq=False)
class DateLeaves(Table):
    """N leaves with a shape, as arrays, in one frame.

    Attributes:
        index: (N,) their places in `PlantOnDate.leaves`.
        midribs: (N, `OBSERVATIONS.stations`, 3) from base to tip.
        normals: (N, 3).
        points: (N, `OBSERVATIONS.cloud`, 3).
        lengths: (N,).
        areas: (N,) one-sided; NaN where none is measured.
        base_sd, turn_sd: (N,) standard deviations of the base, in lengths, and of the azimuth, in radians.
        is_oriented, is_surface, is_doubted: (N,) bool; see `SeenLeaf`.
    """

    index: np.ndarray
    midribs: Floats
    normals: Floats
    points: Floats
    lengths: Floats
    areas: Floats
    base_sd: Floats
    turn_sd: Floats
    is_oriented: np.ndarray
    is_surface: np.ndarray
    is_doubted: np.ndarray

    @property
    def bases(self) -> Floats:
        return self.midribs[:, 0]

    @property
    def chords(self) -> Floats:
        """(N, 3) unit directions from base to tip."""
        ahead = self.midribs[:, -1] - self.midribs[:, 0]
        return ahead / np.maximum(np.linalg.norm(ahead, axis=1, keepdims=True), 1e-12)

    def moved(self, pose: Floats) -> DateLeaves:
        """In another frame, by its pose (4, 4)."""
        rotation, shift = pose[:3, :3], pose[:3, 3]
        midribs, points = (each @ rotation.T + shift for each in (self.midribs, self.points))
        return replace(self, midribs=midribs, normals=self.normals @ rotation.T, points=points)


def leaves_of(date: PlantOnDate) -> DateLeaves:
    shaped: Sequence[SeenLeaf] = [date.leaves[index] for index in date.shaped]

    def sd(leaf: SeenLeaf, trait: str) -> float:
        number = leaf.numbers.get(trait)
        return number.sd if number is not None and np.isfinite(number.sd) else 0.0

    return DateLeaves(
        index=np.array(date.shaped, int),
        midribs=np.array([leaf.midrib for leaf in shaped]).reshape(-1, OBSERVATIONS.stations, 3),
        normals=np.array([leaf.normal for leaf in shaped]).reshape(-1, 3),
        points=np.array([leaf.points for leaf in shaped]).reshape(-1, OBSERVATIONS.cloud, 3),
        lengths=np.array([leaf.length for leaf in shaped]),
        areas=np.array([leaf.numbers["area"].value if "length" in leaf.numbers else np.nan for leaf in shaped], float),
        base_sd=np.array([sd(leaf, "insertion_height") for leaf in shaped]),
        turn_sd=np.radians(np.array([sd(leaf, "azimuth") for leaf in shaped])),
        is_oriented=np.array([leaf.is_oriented for leaf in shaped], bool),
        is_surface=np.array(["length" in leaf.numbers for leaf in shaped], bool),
        is_doubted=np.array([leaf.is_doubted for leaf in shaped], bool),
    )


@dataclass(frozen=True, eq=False)
class Pair:
    """N leaves of one date and M leaves of a later one, which are compared.

    Attributes:
        first, second: each in its date's frame, until `moved`.
        days: between the dates, > 0.
        knows_up: +z is up in both frames.
        scale: unit of places, see `Pair.of`.
        link_costs: (N, M) links of the user, as a cost: below 0 they are one, above 0 they are not.
        still: prior log odds that the pot stands as it stood, over any single turn.
    """

    first: DateLeaves
    second: DateLeaves
    days: float
    knows_up: bool
    scale: float
    link_costs: Floats
    still: float

    @classmethod
    def of(
        cls, first: DateLeaves, second: DateLeaves, *, days: float, knows_up: bool, still: float = ALIGN.still
    ) -> Pair:
        """A pair whose scale is the median length of the leaves of the date with the longest ones; for plants of many
        small leaflets, a share of how far their bases are spread."""
        sizes = [1e-9]
        for leaves in (first, second):
            if len(leaves):
                spread = np.linalg.norm(leaves.bases - np.median(leaves.bases, axis=0), axis=1)
                sizes += [float(np.median(leaves.lengths)), COSTS.spread * float(np.sqrt(np.mean(spread**2)))]
        no_links = np.zeros((len(first), len(second)))
        return cls(first, second, days, knows_up, scale=max(sizes), link_costs=no_links, still=still)

    @property
    def fewer(self) -> int:
        return min(len(self.first), len(self.second))

    def moved(self, pose: Floats) -> Pair:
        """The earlier date in the frame of the later one, by its pose (4, 4)."""
        return replace(self, first=self.first.moved(pose))
