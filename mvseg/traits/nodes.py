"""Nodes, the places where leaves join the stem, in their order, and the phyllotaxis that they suggest."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mvseg.arrays import Floats
from mvseg.reconstruction.stem.leaf_bases import LeafBases, curve_of, project_bases
from mvseg.reconstruction.stem.tube import Tube
from mvseg.traits.leaf import VAGUE_DEG, Measurement, missing, wrap_azimuth

ARCH_SD_DEG = 6.0  # fitted: python benchmarks/stems.py --cache DIR; of the angle by which petioles bend
BLADE_SD_DEG = 4.0  # fitted: the same; of the azimuth of a blade near its base against that of its petiole
MISS_SHARE = 0.7  # fitted: the same; deviation of the axis at a node, in the median miss of the rays
JITTER_DEG = 14.0  # fitted: the same; deviation of divergence angles of a plant from those of its phyllotaxis
GAP_SD = 0.6  # chosen: standard deviation of the logarithm of internodes
PAIR_GAP = 0.12  # chosen: deviation of the heights of two leaves at one node, in median internodes of pairs
START_DEG = np.arange(0.0, 360.0, 4.0)[:, None]  # limit: azimuths of the lowest leaf that are compared
SPIRAL_DEG = np.arange(100.0, 165.0, 2.5)  # definition: divergence angles that count as a spiral
LEAST_NODES = 4  # limit: leaves that suggest a phyllotaxis

VAGUE = missing("not measured: the leaf begins at the stem, and points along it")
FIRST_NODE = missing("not measured: the lowest node has none below")


@dataclass(frozen=True)
class Node:
    """Place where one leaf joins a stem; `leaf` is an instance id.

    Attributes:
        number: 1 for the lowest one of its stem.
        place, base: (x, y, z) on the axis, and of the blade.
        height: along the axis, from the foot of the stem or, where that is not known, from the lowest node.
        internode: along the axis, from the node below.
        divergence: degrees between its azimuth and that of the node below, in [0, 180].
        insertion_angle: degrees between the petiole, or the midrib at the base without one, and the axis there.
        azimuth: degrees about the axis, counterclockwise seen from above, in [0, 360).
    """

    number: int
    leaf: int
    place: tuple[float, float, float]
    base: tuple[float, float, float]
    height: Measurement
    internode: Measurement
    divergence: Measurement
    insertion_angle: Measurement
    azimuth: Measurement


@dataclass(frozen=True)
class Phyllotaxis:
    """How leaves follow each other around a stem.

    Attributes:
        name: "distichous", "decussate", "spiral", or "unclear".
        angle: divergence in degrees: 180, 90 from pair to pair, or that of the spiral; NaN where it is unclear.
        probability: of this one among all of them.
    """

    name: str
    angle: float
    probability: float


UNCLEAR = Phyllotaxis("unclear", float("nan"), float("nan"))


@dataclass(frozen=True, eq=False)
class Stem:
    """One stem with its nodes, and the phyllotaxis that these suggest; `number` 1, 2, ... of the plant.

    Attributes:
        tube: upwards; of no radius where no view shows how thick it is.
        source: what showed it: "masks", "photos" or "leaf bases".
        nodes: from the lowest to the highest one.
        tells_up: whether the direction in which it grows may be taken for up.
    """

    number: int
    tube: Tube
    source: str
    nodes: tuple[Node, ...]
    phyllotaxis: Phyllotaxis
    tells_up: bool = False

    def __repr__(self) -> str:
        return f"Stem({self.number}: {len(self.nodes)} nodes, from {self.source}, {self.phyllotaxis.name})"


def measure_stem(
    tube: Tube,
    bases: LeafBases,
    *,
    frame: Floats | None,
    source: str,
    number: int = 1,
    knows_foot: bool = False,
    tells_up: bool = False,
) -> Stem:
    """Order the leaves that sit on a stem along it, and measure their nodes. `frame` has the (3, 3) rows east, north,
    up (`level_frame`); None: azimuths start somewhere. With `knows_foot` heights start with the tube, not the lowest
    node."""
    curve = curve_of(tube)
    places, misses, along = project_bases(bases, curve)
    steps = np.linalg.norm(np.diff(curve, axis=0), axis=1)
    reach = np.append(0, steps.cumsum())
    foot = reach[1] if knows_foot else float(along.min(initial=np.inf))
    tangents = np.stack([np.interp(along, reach, axis) for axis in np.gradient(curve, reach, axis=0).T], 1)
    tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
    on_axis = np.stack([np.interp(along, reach, axis) for axis in curve.T], 1)
    petiole = np.linalg.norm(bases.points - places, axis=1)
    lever = bases.near - on_axis
    across = lever - (lever * tangents).sum(1, keepdims=True) * tangents
    east = _reference(tangents, frame)
    north = np.cross(tangents, east)
    azimuth = np.degrees(np.arctan2((across * north).sum(1), (across * east).sum(1)))
    axis_sd = MISS_SHARE * float(np.median(misses)) if len(misses) else 0.0
    sideways = np.hypot(axis_sd, bases.point_sd) / np.maximum(np.linalg.norm(across, axis=1), 1e-12)
    azimuth_sd = np.hypot(np.degrees(sideways), BLADE_SD_DEG)
    rising = np.degrees(np.arccos(np.clip((bases.ahead * tangents).sum(1), -1, 1)))
    slant = np.tan(np.radians(np.clip(rising, 5, 175)))
    turn_sd = np.hypot(np.radians(ARCH_SD_DEG), bases.angle_sd)
    height_sd = np.sqrt(
        bases.point_sd**2 + (petiole * turn_sd) ** 2 + np.minimum(axis_sd / np.abs(slant), petiole + axis_sd) ** 2
        + (MISS_SHARE * misses) ** 2
    )  # fmt: skip
    angle_sd = np.hypot(np.degrees(turn_sd), ARCH_SD_DEG)
    order = np.lexsort((bases.ids, along))
    # Where heights start from the lowest node, its error is in all of them.
    start_sd = float(height_sd[order[0]]) if len(order) and not knows_foot else 0.0
    nodes: list[Node] = []
    for rank, leaf in enumerate(order.tolist()):
        below = order[rank - 1] if rank else None
        internode = divergence = FIRST_NODE
        if below is not None:
            sd = float(np.hypot(height_sd[leaf], height_sd[below]))
            internode = Measurement(float(along[leaf] - along[below]), sd, source)
            sd = float(np.hypot(azimuth_sd[leaf], azimuth_sd[below]))
            apart = abs((float(azimuth[leaf]) - float(azimuth[below]) + 180) % 360 - 180)
            divergence = Measurement(apart, sd, source) if sd <= VAGUE_DEG else VAGUE
        turned = Measurement(wrap_azimuth(float(azimuth[leaf])), float(azimuth_sd[leaf]), source)
        x, y, z = on_axis[leaf].tolist()
        bx, by, bz = bases.points[leaf].tolist()
        nodes.append(
            Node(
                number=rank + 1,
                leaf=int(bases.ids[leaf]),
                place=(x, y, z),
                base=(bx, by, bz),
                height=Measurement(float(along[leaf]) - foot, float(np.hypot(height_sd[leaf], start_sd)), source),
                internode=internode,
                divergence=divergence,
                insertion_angle=Measurement(float(rising[leaf]), float(angle_sd[leaf]), source),
                azimuth=turned if turned.sd <= VAGUE_DEG else VAGUE,
            )
        )
    return Stem(
        number=number,
        tube=tube,
        source=source,
        nodes=tuple(nodes),
        phyllotaxis=suggest_phyllotaxis(nodes),
        tells_up=tells_up,
    )


def _reference(tangents: Floats, frame: Floats | None) -> Floats:
    """(N, 3) unit vectors across an axis with unit directions (N, 3): where azimuths start."""
    mean = tangents.mean(0) if len(tangents) else np.array([0.0, 0.0, 1.0])
    east = np.eye(3)[np.abs(mean).argmin()] if frame is None else frame[0]
    level = east - (tangents @ east)[:, None] * tangents
    return np.asarray(level / np.maximum(np.linalg.norm(level, axis=1, keepdims=True), 1e-12))


def suggest_phyllotaxis(nodes: Sequence[Node]) -> Phyllotaxis:
    """Compare how likely the azimuths and heights of nodes, upwards, are with each phyllotaxis. All four are equally
    likely beforehand: distichous, decussate (pairs at right angles), a spiral of any angle in `SPIRAL_DEG`, either way
    round, and none of these."""
    if len(nodes) < LEAST_NODES:
        return UNCLEAR
    azimuth = np.array([node.azimuth.value if node.azimuth.exists else 0.0 for node in nodes])
    sd = np.hypot([node.azimuth.sd if node.azimuth.exists else 180.0 for node in nodes], JITTER_DEG)
    height = np.array([node.height.value for node in nodes])
    height_sd = np.array([node.height.sd for node in nodes])
    single = _gap_evidence(np.diff(height))
    turns = np.arange(len(nodes))
    spirals = np.array([
        np.logaddexp.reduce([
            _log_mean(_log_normal(azimuth - START_DEG - way * angle * turns, sd).sum(1)) for way in (-1, 1)
        ])
        for angle in SPIRAL_DEG
    ])  # fmt: skip
    pairs = [_pair_azimuths(azimuth, sd, first) + _pair_gaps(height, height_sd, first) for first in (0, 1)]
    evidence = {
        "distichous": _log_mean(_log_normal(azimuth - START_DEG - 180 * turns, sd).sum(1)) + single,
        "spiral": _log_mean(spirals) - np.log(2) + single,
        "decussate": _log_mean(np.array(pairs)),
        "unclear": -len(nodes) * np.log(360.0) + max(single, *(_pair_gaps(height, height_sd, each) for each in (0, 1))),
    }
    total = np.logaddexp.reduce(list(evidence.values()))
    name = max(evidence, key=lambda each: evidence[each])
    angle = {"distichous": 180.0, "decussate": 90.0, "spiral": float(SPIRAL_DEG[spirals.argmax()])}.get(name, np.nan)
    return Phyllotaxis(name, float(angle), float(np.exp(evidence[name] - total)))


def _log_normal(degrees: Floats, sd: Floats) -> Floats:
    apart = (degrees + 180) % 360 - 180
    return np.asarray(-0.5 * (apart / sd) ** 2 - np.log(sd * np.sqrt(2 * np.pi)))


def _log_mean(logs: Floats) -> float:
    return float(np.logaddexp.reduce(logs) - np.log(len(logs)))


def _pair_azimuths(azimuth: Floats, sd: Floats, first: int) -> float:
    """Log density of azimuths (N,) of opposite leaves, pairs at right angles; the lowest is alone if `first` is 1."""
    pair = (np.arange(len(azimuth)) + first) // 2
    total = np.zeros(len(START_DEG))
    for number in np.unique(pair):
        members = np.flatnonzero(pair == number)
        start = START_DEG[:, 0] + 90 * number
        sides = 180 * np.arange(len(members))
        orders = [_log_normal(azimuth[members] - start[:, None] - sides - swap, sd[members]) for swap in (0, 180)]
        total += np.logaddexp(*(each.sum(1) for each in orders)) - np.log(2)
    return _log_mean(total)


def _gap_evidence(gaps: Floats) -> float:
    """Logarithm of the density of internodes (N,) of leaves that come one by one, relative to their median."""
    scale = max(float(np.median(gaps)), 1e-12)
    logs = np.log(np.maximum(gaps / scale, 1e-2))
    return float((-0.5 * (logs / GAP_SD) ** 2 - np.log(GAP_SD * np.sqrt(2 * np.pi)) - np.log(scale) - logs).sum())


def _pair_gaps(height: Floats, height_sd: Floats, first: int) -> float:
    """Gaps of leaves in pairs; where `first` is 1, the lowest leaf is alone."""
    gaps = np.diff(height)
    is_within = (np.arange(len(gaps)) + first) % 2 == 0
    between = gaps[~is_within]
    scale = max(float(np.median(between)) if len(between) else float(gaps.mean()), 1e-12)
    sd = np.hypot(PAIR_GAP * scale, np.hypot(height_sd[1:], height_sd[:-1]))[is_within]
    within = -0.5 * (gaps[is_within] / sd) ** 2 - np.log(sd * np.sqrt(np.pi / 2))
    logs = np.log(np.maximum(between / scale, 1e-2))
    rest = -0.5 * (logs / GAP_SD) ** 2 - np.log(GAP_SD * np.sqrt(2 * np.pi)) - np.log(scale) - logs
    return float(within.sum() + rest.sum())
