"""Nodes, the places where leaves join the stem, in their order, and the phyllotaxis that they suggest."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from mvseg.arrays import Floats, Ints
from mvseg.reconstruction.stem.leaf_bases import LeafBases, project_bases
from mvseg.reconstruction.stem.stem_axis import StemAxis
from mvseg.table import Table
from mvseg.traits.leaf import VAGUE_DEG, Measurement, missing, wrap_azimuth

ARCH_SD_DEG = 6.0  # fitted: python -m benchmarks.stems --cache DIR; of the angle by which petioles bend
BLADE_SD_DEG = 4.0  # fitted: the same; of the azimuth of a blade near its base against that of its petiole
MISS_SHARE = 0.7  # fitted: the same; deviation of the axis at a node, in the median miss of the rays
JITTER_DEG = 14.0  # fitted: the same; deviation of divergence angles of a plant from those of its phyllotaxis
GAP_SD = 0.6  # chosen: standard deviation of the logarithm of internodes
PAIR_GAP = 0.12  # chosen: deviation of the heights of two leaves at one node, in median internodes of pairs
START_DEG = np.arange(0.0, 360.0, 4.0)[:, None]  # limit: azimuths of the lowest leaf that are compared
SPIRAL_DEG = np.arange(100.0, 165.0, 2.5)  # definition: divergence angles that count as a spiral
LEAST_NODES = 4  # limit: leaves that suggest a phyllotaxis

NODE_NUMBERS = ("height", "internode", "divergence", "insertion_angle", "node_azimuth")
NODE_COLUMNS = (
    "plant", "stem", "node", "leaves_per_node", "rank", "leaf",
    *(name + end for name in NODE_NUMBERS for end in ("", "_sd")),
    "x", "y", "z", "base_x", "base_y", "base_z", "unit", "source", "stem_probability", "phyllotaxis",
    "phyllotaxis_angle", "phyllotaxis_probability",
)  # fmt: skip
VAGUE = missing("not measured: the leaf begins at the stem, and points along it")
FIRST_NODE = missing("not measured: the lowest node has none below")
BELOW = missing("not measured: it lies below the end of the stem")


@dataclass(frozen=True)
class Node:
    """One leaf at its node, the place where it joins a stem; `leaf` is an instance id.

    Attributes:
        number: of the node, 1 for the lowest one of its stem; several leaves may share it.
        leaves_per_node: how many.
        rank: 1 for the lowest leaf of the stem, counted upwards, also among the leaves of one node.
        place, base: (x, y, z) of the node on the axis, and of the blade.
        height: of the node along the axis, from the foot of the stem or, where that is not known, from the lowest node.
        internode: along the axis, from the node below.
        divergence: degrees between the azimuths of the leaf and of that of the rank below, in [0, 180].
        insertion_angle: degrees between the petiole, or the midrib at the base without one, and the axis there.
        node_azimuth: degrees of the leaf about the axis, counterclockwise seen from above, in [0, 360).
    """

    number: int
    leaves_per_node: int
    rank: int
    leaf: int
    place: tuple[float, float, float]
    base: tuple[float, float, float]
    height: Measurement
    internode: Measurement
    divergence: Measurement
    insertion_angle: Measurement
    node_azimuth: Measurement


@dataclass(frozen=True)
class Phyllotaxis:
    """How leaves follow each other around a stem: "distichous", "decussate", "spiral", or "unclear". `angle` is the
    divergence in degrees, 180, 90 from pair to pair, or that of the spiral, and NaN where it is unclear."""

    name: str
    angle: float
    probability: float


UNCLEAR = Phyllotaxis("unclear", float("nan"), float("nan"))


@dataclass(frozen=True, eq=False)
class Stem:
    """One stem with its leaves, and the phyllotaxis that these suggest; `number` 1, 2, ... of the plant.

    Attributes:
        axis: upwards.
        source: what showed it: "masks", "photos" or "leaf bases".
        nodes: a row per leaf, by rank.
        probability: that there is such a stem.
        tells_up: whether the direction in which it grows may be taken for up.
    """

    number: int
    axis: StemAxis
    source: str
    nodes: tuple[Node, ...]
    phyllotaxis: Phyllotaxis
    probability: float = 1.0
    tells_up: bool = False

    @property
    def num_nodes(self) -> int:
        return len({node.number for node in self.nodes})

    def __repr__(self) -> str:
        return f"Stem({self.number}: {self.num_nodes} nodes, from {self.source}, {self.phyllotaxis.name})"


@dataclass(frozen=True, eq=False)
class _Places(Table):
    """N leaves along a stem, upwards.

    Attributes:
        ids, along: (N,) their ids, and where they join the axis, extended at both ends.
        bases: (N, 3) of the blades.
        azimuth, rising: (N,) degrees about the axis, and of the midrib or petiole against it.
        along_sd, azimuth_sd, rising_sd: (N,) standard deviations.
    """

    ids: Ints
    along: Floats
    along_sd: Floats
    bases: Floats
    azimuth: Floats
    azimuth_sd: Floats
    rising: Floats
    rising_sd: Floats


def measure_stem(
    axis: StemAxis,
    bases: LeafBases,
    *,
    frame: Floats | None,
    source: str,
    number: int = 1,
    probability: float = 1.0,
    knows_foot: bool = False,
    tells_up: bool = False,
) -> Stem:
    """Order the leaves that sit on a stem along it, and measure their nodes. Leaves that would join it beyond its
    extended ends have no node. `frame` has the (3, 3) rows east, north, up (`level_frame`); None: azimuths start
    somewhere. With `knows_foot` heights start with the axis, not the lowest node."""
    leaves = _place_leaves(axis, bases, frame)
    bare = Stem(number, axis, source, (), UNCLEAR, probability, tells_up)
    if not len(leaves.ids):
        return bare
    phyllotaxis, node_of = suggest_phyllotaxis(leaves.azimuth, leaves.azimuth_sd, leaves.along, leaves.along_sd)
    counts, weights = np.bincount(node_of), 1 / leaves.along_sd**2
    total = np.bincount(node_of, weights)
    middle, sd = np.bincount(node_of, weights * leaves.along) / total, 1 / np.sqrt(total)
    foot = axis.extension if knows_foot else middle[0]
    # Where heights start from the lowest node, its error is in all of them.
    start_sd = 0.0 if knows_foot else float(sd[0])
    reach, curve = axis.extended_reach, axis.extend()
    nodes: list[Node] = []
    for rank, node in enumerate(node_of.tolist()):
        internode = divergence = FIRST_NODE
        if node:
            apart_sd = float(np.hypot(sd[node], sd[node - 1]))
            internode = Measurement(float(middle[node] - middle[node - 1]), apart_sd, source)
        if rank:
            apart = abs((float(leaves.azimuth[rank]) - float(leaves.azimuth[rank - 1]) + 180) % 360 - 180)
            turn_sd = float(np.hypot(leaves.azimuth_sd[rank], leaves.azimuth_sd[rank - 1]))
            divergence = Measurement(apart, turn_sd, source) if turn_sd <= VAGUE_DEG else VAGUE
        turned = Measurement(wrap_azimuth(float(leaves.azimuth[rank])), float(leaves.azimuth_sd[rank]), source)
        height = Measurement(float(middle[node] - foot), float(np.hypot(sd[node], start_sd)), source)
        x, y, z = (float(np.interp(middle[node], reach, each)) for each in curve.T)
        bx, by, bz = leaves.bases[rank].tolist()
        nodes.append(
            Node(
                number=node + 1,
                leaves_per_node=int(counts[node]),
                rank=rank + 1,
                leaf=int(leaves.ids[rank]),
                place=(x, y, z),
                base=(bx, by, bz),
                height=height if height.value >= 0 else BELOW,
                internode=internode,
                divergence=divergence,
                insertion_angle=Measurement(float(leaves.rising[rank]), float(leaves.rising_sd[rank]), source),
                node_azimuth=turned if turned.sd <= VAGUE_DEG else VAGUE,
            )
        )
    return replace(bare, nodes=tuple(nodes), phyllotaxis=phyllotaxis)


def _place_leaves(axis: StemAxis, bases: LeafBases, frame: Floats | None) -> _Places:
    curve, reach = axis.extend(), axis.extended_reach
    places, misses, along = project_bases(bases, curve)
    tangents = np.stack([np.interp(along, reach, each) for each in np.gradient(curve, reach, axis=0).T], 1)
    tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
    on_axis = np.stack([np.interp(along, reach, each) for each in curve.T], 1)
    petiole = np.linalg.norm(bases.points - places, axis=1)
    lever = bases.near - on_axis
    across = lever - (lever * tangents).sum(1, keepdims=True) * tangents
    east = _reference(tangents, frame)
    north = np.cross(tangents, east)
    axis_sd = MISS_SHARE * float(np.median(misses)) if len(misses) else 0.0
    sideways = np.hypot(axis_sd, bases.point_sd) / np.maximum(np.linalg.norm(across, axis=1), 1e-12)
    rising = np.degrees(np.arccos(np.clip((bases.ahead * tangents).sum(1), -1, 1)))
    slant = np.tan(np.radians(np.clip(rising, 5, 175)))
    turn_sd = np.hypot(np.radians(ARCH_SD_DEG), bases.angle_sd)
    along_sd = np.sqrt(
        bases.point_sd**2 + (petiole * turn_sd) ** 2 + np.minimum(axis_sd / np.abs(slant), petiole + axis_sd) ** 2
        + (MISS_SHARE * misses) ** 2
    )  # fmt: skip
    along_sd = np.maximum(along_sd, 1e-9 * axis.length)
    azimuth = np.degrees(np.arctan2((across * north).sum(1), (across * east).sum(1)))
    azimuth_sd = np.hypot(np.degrees(sideways), BLADE_SD_DEG)
    rising_sd = np.hypot(np.degrees(turn_sd), ARCH_SD_DEG)
    leaves = _Places(bases.ids, along, along_sd, bases.points, azimuth, azimuth_sd, rising, rising_sd)
    order = np.lexsort((bases.ids, along))
    order = order[(along[order] > 0) & (along[order] < reach[-1])]  # others would join it where the curve is cut
    return leaves.select(order)


def _reference(tangents: Floats, frame: Floats | None) -> Floats:
    """(N, 3) unit vectors across an axis with unit directions (N, 3): where azimuths start."""
    mean = tangents.mean(0) if len(tangents) else np.array([0.0, 0.0, 1.0])
    east = np.eye(3)[np.abs(mean).argmin()] if frame is None else frame[0]
    level = east - (tangents @ east)[:, None] * tangents
    return np.asarray(level / np.maximum(np.linalg.norm(level, axis=1, keepdims=True), 1e-12))


def suggest_phyllotaxis(azimuth: Floats, azimuth_sd: Floats, along: Floats, sd: Floats) -> tuple[Phyllotaxis, Ints]:
    """Compare how likely azimuths and heights of leaves (N,), upwards, are with each phyllotaxis. All four are equally
    likely beforehand: distichous, decussate (pairs at right angles), a spiral of any angle in `SPIRAL_DEG`, either way
    round, and none of these.

    Returns:
        The likeliest, and (N,) the node of each leaf, 0 for the lowest: each its own where leaves come one by one,
        pairs where they are decussate; else leaves less than their standard deviation apart share a node.
    """
    close = group_leaves(along, sd)
    if len(along) < LEAST_NODES:
        return UNCLEAR, close
    turn_sd = np.hypot(np.where(azimuth_sd <= VAGUE_DEG, azimuth_sd, 180.0), JITTER_DEG)
    single = _gap_evidence(np.diff(along))
    turns = np.arange(len(along))
    spirals = np.array([
        np.logaddexp.reduce([
            _log_mean(_log_normal(azimuth - START_DEG - way * angle * turns, turn_sd).sum(1)) for way in (-1, 1)
        ])
        for angle in SPIRAL_DEG
    ])  # fmt: skip
    gaps = [_pair_gaps(along, sd, first) for first in (0, 1)]
    pairs = [_pair_azimuths(azimuth, turn_sd, first) + gaps[first] for first in (0, 1)]
    evidence = {
        "distichous": _log_mean(_log_normal(azimuth - START_DEG - 180 * turns, turn_sd).sum(1)) + single,
        "spiral": _log_mean(spirals) - np.log(2) + single,
        "decussate": _log_mean(np.array(pairs)),
        "unclear": -len(along) * np.log(360.0) + max(single, *gaps),
    }
    total = np.logaddexp.reduce(list(evidence.values()))
    name = max(evidence, key=lambda each: evidence[each])
    angle = {"distichous": 180.0, "decussate": 90.0, "spiral": float(SPIRAL_DEG[spirals.argmax()])}.get(name, np.nan)
    node_of = {"unclear": close, "decussate": (turns + int(np.argmax(pairs))) // 2}.get(name, turns)
    return Phyllotaxis(name, float(angle), float(np.exp(evidence[name] - total))), node_of - node_of.min(initial=0)


def group_leaves(along: Floats, sd: Floats) -> Ints:
    """(N,) the node of each leaf, from 0, at places along (N,), upwards: a leaf joins the node below if it is less than
    its standard deviation (N,) away from the lowest leaf of that."""
    node_of, lowest = np.zeros(len(along), int), 0
    for leaf in range(1, len(along)):
        is_new = along[leaf] - along[lowest] >= np.hypot(sd[leaf], sd[lowest]) / np.sqrt(2)
        node_of[leaf] = node_of[leaf - 1] + is_new
        lowest = leaf if is_new else lowest
    return node_of


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
    gaps = np.diff(height)
    is_within = (np.arange(len(gaps)) + first) % 2 == 0
    between = gaps[~is_within]
    scale = max(float(np.median(between)) if len(between) else float(gaps.mean()), 1e-12)
    sd = np.hypot(PAIR_GAP * scale, np.hypot(height_sd[1:], height_sd[:-1]))[is_within]
    within = -0.5 * (gaps[is_within] / sd) ** 2 - np.log(sd * np.sqrt(np.pi / 2))
    return float(within.sum()) + (_gap_evidence(between) if len(between) else 0.0)
