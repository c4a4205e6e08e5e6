"""How unlike two leaves of different dates are, once the dates are aligned: the cost of "the same leaf".

The cost of a pair is minus the logarithm of how much likelier its differences are between two sights of one leaf than
between a leaf and a stranger. Each difference has a scale of its own, widened by the standard deviations that the
surfaces carry and by the days in between, and heavy tails: one odd number does not outweigh the others.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np

from mvseg.tracking.dates import CLOUD, STATIONS, Floats, PlantOnDate, SeenLeaf

# Scales of the differences between two sights of one leaf: of places in median leaf lengths, of angles in radians, of
# sizes in natural logarithms.
ACROSS, ALONG, TURN, BEND, SIZE = 0.07, 0.10, 0.30, 0.10, 0.12
RISE = 0.02  # more of ALONG per day: internodes stretch
GROWTH = 0.25  # log length per day that a leaf much shorter than the others may gain
LOOSE = 0.35  # floor of SIZE and BEND for leaves that only voxels show
TAIL = 3.0  # degrees of freedom of the differences
FLIPPED = 0.5  # cost of a midrib that runs the other way on the other date
PARTING = 9.0  # log of how much rarer a stranger's differences are in each place, see `pair_costs`
CLOUDS = 0.04  # scale of the distance between the points of two sights, as ACROSS
APART = 3.0  # as PARTING, of `cloud_costs`
SPREAD = 0.6  # see `Pair.of`
MOST_SD = 0.5  # standard deviations of surfaces count up to this share of the median length


@dataclass(frozen=True, eq=False)
class Leaves:
    """N leaves with a shape, as arrays, in one frame.

    Attributes:
        index: (N,) their places in `PlantOnDate.leaves`.
        midribs: (N, STATIONS, 3) from base to tip.
        normals: (N, 3).
        points: (N, CLOUD, 3).
        lengths: (N,).
        base_sd, turn_sd: (N,) standard deviations of the base, in lengths, and of the azimuth, in radians.
        is_oriented, is_surface: (N,) bool.
    """

    index: np.ndarray
    midribs: Floats
    normals: Floats
    points: Floats
    lengths: Floats
    base_sd: Floats
    turn_sd: Floats
    is_oriented: np.ndarray
    is_surface: np.ndarray

    def __len__(self) -> int:
        return len(self.index)

    @property
    def bases(self) -> Floats:
        return self.midribs[:, 0]

    @property
    def chords(self) -> Floats:
        """(N, 3) unit directions from base to tip."""
        ahead = self.midribs[:, -1] - self.midribs[:, 0]
        return ahead / np.maximum(np.linalg.norm(ahead, axis=1, keepdims=True), 1e-12)

    def take(self, rows: np.ndarray) -> Leaves:
        """Some of the leaves."""
        return Leaves(**{field.name: getattr(self, field.name)[rows] for field in fields(self)})

    def moved(self, pose: Floats) -> Leaves:
        """In another frame, by its pose (4, 4)."""
        rotation, shift = pose[:3, :3], pose[:3, 3]
        return replace(
            self,
            midribs=self.midribs @ rotation.T + shift,
            normals=self.normals @ rotation.T,
            points=self.points @ rotation.T + shift,
        )

    def shifted(self, shifts: Floats) -> Leaves:
        """Each leaf by its own of the shifts (N, 3)."""
        return replace(self, midribs=self.midribs + shifts[:, None], points=self.points + shifts[:, None])


def leaves_of(date: PlantOnDate) -> Leaves:
    """The leaves of a date that have a shape."""
    shaped: Sequence[SeenLeaf] = [date.leaves[index] for index in date.shaped]

    def sd(leaf: SeenLeaf, trait: str) -> float:
        number = leaf.numbers.get(trait)
        return number.sd if number is not None and np.isfinite(number.sd) else 0.0

    return Leaves(
        index=np.array(date.shaped, int),
        midribs=np.array([leaf.midrib for leaf in shaped]).reshape(-1, STATIONS, 3),
        normals=np.array([leaf.normal for leaf in shaped]).reshape(-1, 3),
        points=np.array([leaf.points for leaf in shaped]).reshape(-1, CLOUD, 3),
        lengths=np.array([leaf.length for leaf in shaped]),
        base_sd=np.array([sd(leaf, "insertion_height") for leaf in shaped]),
        turn_sd=np.radians(np.array([sd(leaf, "azimuth") for leaf in shaped])),
        is_oriented=np.array([leaf.is_oriented for leaf in shaped], bool),
        is_surface=np.array(["length" in leaf.numbers for leaf in shaped], bool),
    )


@dataclass(frozen=True, eq=False)
class Pair:
    """N leaves of one date and M leaves of a later one, which are compared.

    Attributes:
        first, second: each in its date's frame, until `moved`.
        days: between the dates, > 0.
        knows_up: +z is up in both frames.
        scale: what places are measured in, see `Pair.of`.
    """

    first: Leaves
    second: Leaves
    days: float
    knows_up: bool
    scale: float

    @classmethod
    def of(cls, first: Leaves, second: Leaves, *, days: float, knows_up: bool) -> Pair:
        """A pair whose scale is the median length of the leaves of the date with the longest ones; for plants of many
        small leaflets, a share of how far their bases are spread."""
        found = [1e-9]
        for leaves in (first, second):
            if len(leaves):
                spread = np.linalg.norm(leaves.bases - np.median(leaves.bases, axis=0), axis=1)
                found += [float(np.median(leaves.lengths)), SPREAD * float(np.sqrt(np.mean(spread**2)))]
        return cls(first, second, days, knows_up, scale=max(found))

    @property
    def fewer(self) -> int:
        """Leaves of the date with fewer."""
        return min(len(self.first), len(self.second))

    def moved(self, pose: Floats) -> Pair:
        """The earlier date in the frame of the later one, by its pose (4, 4)."""
        return replace(self, first=self.first.moved(pose))

    def take(self, rows: np.ndarray, columns: np.ndarray) -> Pair:
        """Some leaves of either date, with a scale of their own."""
        return Pair.of(self.first.take(rows), self.second.take(columns), days=self.days, knows_up=self.knows_up)


def pair_costs(pair: Pair, *, spread: float = 1.0) -> Floats:
    """(N, M) costs of leaf i of the earlier and leaf j of the later date, in one frame, being the same; below 0: it is
    likelier than not. `spread` widens the scales of places and directions, for dates that differ more than usual."""
    turned = replace(pair, first=replace(pair.first, midribs=pair.first.midribs[:, ::-1]))
    return np.minimum(_directed_costs(pair, spread), _directed_costs(turned, spread) + FLIPPED)


def cloud_costs(pair: Pair, *, spread: float = 1.0) -> Floats:
    """(N, M) costs as `pair_costs`, from where the leaves are alone: how far the points of one are from the other.

    It needs neither base nor tip, and forgives a leaf that is seen in part: the nearer way counts.
    """
    apart = np.linalg.norm(pair.first.points[:, None, :, None] - pair.second.points[None, :, None], axis=-1)
    ways = apart.min(3).mean(2), apart.min(2).mean(2)
    near, far = np.minimum(*ways) / pair.scale, np.maximum(*ways) / pair.scale
    wide = CLOUDS * spread + RISE * pair.days
    return 0.5 * (student_tail(near / wide, 2) + student_tail(far / (3 * wide), 1)) - APART


def _directed_costs(pair: Pair, spread: float) -> Floats:
    first, second, scale, days = pair.first, pair.second, pair.scale, pair.days
    apart, carried = _base_offsets(first, second)
    noise = np.clip(np.hypot(first.base_sd[:, None], second.base_sd[None]) / scale, 0, MOST_SD)
    across = np.linalg.norm(apart[..., :2], axis=-1) / scale / np.hypot(ACROSS * spread, noise)
    along = apart[..., 2] / scale / np.hypot(ALONG * spread + RISE * days + 0.5 * carried / scale, noise)
    turn_noise = np.minimum(np.hypot(first.turn_sd[:, None], second.turn_sd[None]), 1.0)
    cosine = np.clip(first.chords @ second.chords.T, -1, 1)
    turn = np.arccos(cosine) / np.hypot(TURN * spread, turn_noise)
    loose = np.where(first.is_surface[:, None] & second.is_surface[None], 0.0, LOOSE)
    bend = _bends(first, second) / np.hypot(BEND, loose)
    return 0.5 * (
        student_tail(across, 2) + student_tail(along, 1) + student_tail(turn, 2) + student_tail(bend, 2)
        + student_tail(_growth(first, second, days=days, loose=loose), 1)
    ) - PARTING  # fmt: skip


def _base_offsets(first: Leaves, second: Leaves) -> tuple[Floats, Floats]:
    """(N, M, 3) from base to base, and (N, M) how far a growing petiole may have carried the base away from the stem.

    A petiole (or the rachis of a compound leaf) grows as its blade does, at most.
    """
    apart = second.bases[None] - first.bases[:, None]
    out = (first.bases - np.median(first.bases, axis=0))[:, None, :2]
    grown = np.clip(second.lengths[None] / first.lengths[:, None] - 1, 0, 2)[..., None]
    most = grown * out
    reach = (most * most).sum(-1, keepdims=True)
    share = np.clip((apart[..., :2] * most).sum(-1, keepdims=True) / np.maximum(reach, 1e-12), 0, 1)
    carried = share * most
    apart[..., :2] -= carried
    return apart, np.linalg.norm(carried, axis=-1)


def _bends(first: Leaves, second: Leaves) -> Floats:
    """(N, M) root mean square distance between the midribs in units of their length, base on base."""
    one = (first.midribs - first.midribs[:, :1]) / first.lengths[:, None, None]
    other = (second.midribs - second.midribs[:, :1]) / second.lengths[:, None, None]
    away: Floats = np.linalg.norm(one[:, None] - other[None], axis=-1)
    chord = np.linalg.norm(one[:, None, -1] - other[None, :, -1], axis=-1)[..., None] * np.linspace(0, 1, STATIONS)
    return np.sqrt(np.mean((away - 0.5 * chord) ** 2, axis=-1))  # half of the turn is counted as a turn already


def _growth(first: Leaves, second: Leaves, *, days: float, loose: Floats) -> Floats:
    """(N, M) change of log length in its scales: a short leaf may grow much, none may shrink much."""
    ratio = np.log(second.lengths[None] / first.lengths[:, None])
    room = np.clip(np.log(second.lengths.max(initial=1e-9) / first.lengths), 0, 2.5)[:, None]
    expected = np.minimum(GROWTH * days, 0.9) * np.minimum(room, 1.0)
    wide = np.hypot(SIZE, loose)
    return np.where(ratio < 0, ratio, np.maximum(ratio - expected, 0)) / wide


def student_tail(x: Floats, dimensions: int) -> Floats:
    """Minus twice the log of Student's density in units of its peak."""
    return (TAIL + dimensions) * np.log1p(np.square(x) / TAIL)
