"""Plants over days for the tests of tracking: leaves on a stem as arcs, with known ids, seen in any pot."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from known_leaves import make_surface
from mvseg.arrays import Floats
from mvseg.masks import Masks
from mvseg.matching.result import Matching, MatchReport
from mvseg.reconstruction.surface.leaf_patch import patch_grid
from mvseg.reconstruction.surface.leaf_surface import MESH_SHAPE
from mvseg.regions import regions_from_label_maps
from mvseg.results.folder import save_result
from mvseg.results.result import Instances, Result
from mvseg.scene import Cameras, Scene, View
from mvseg.tracking.dates import Number, PlantOnDate, SeenLeaf, resample
from mvseg.tracking.numbers import OBSERVATIONS
from mvseg.tracking.track import Tracks
from mvseg.traits.filters import Kind
from mvseg.traits.leaf import Measurement, missing
from mvseg.traits.measure import LeafTraits, Traits
from mvseg.traits.ontology import LEAF_TRAITS

Blades = dict[int, Floats]  # {true id: (rows, 3, 3) edge, midrib, edge from base to tip}


def grow_blades(count: int, seed: int) -> Blades:
    """Leaves with golden-angle azimuths up a stem; lengths and slopes by chance."""
    rng, blades = np.random.default_rng(seed), {}
    for leaf in range(1, count + 1):
        azimuth = 2.4 * leaf + rng.normal(0, 0.3)
        out = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
        side = np.array([-out[1], out[0], 0.0])
        along = np.linspace(0, 1, OBSERVATIONS.rows)[:, None] * rng.uniform(50, 110)
        rise, droop = rng.uniform(0.2, 0.9), rng.uniform(0.002, 0.008)
        line = (0.0, 0.0, 22.0 * leaf) + 6 * out + along * out + (rise * along - droop * along**2) * (0, 0, 1)
        half = 14 * np.sin(np.pi * np.linspace(0.02, 0.98, OBSERVATIONS.rows))[:, None]
        blades[leaf] = np.stack([line - half * side, line, line + half * side], 1)
    return blades


def grown(blades: Blades, factor: float) -> Blades:
    """Each leaf larger about its base."""
    return {leaf: blade[0, 1] + factor * (blade - blade[0, 1]) for leaf, blade in blades.items()}


def turned(blades: Blades, degrees: float) -> Blades:
    """The whole plant about the stem."""
    pot = Rotation.from_euler("z", degrees, degrees=True)
    return {leaf: pot.apply(blade.reshape(-1, 3)).reshape(blade.shape) for leaf, blade in blades.items()}


def opposite_leaves(count: int) -> Blades:
    """Pairs of leaves that stand opposite each other: the plant looks the same from behind."""
    blades = grow_blades(count, 5)
    return blades | {leaf + count: blade for leaf, blade in turned(blades, 180).items()}


def see(
    blades: Mapping[int, Floats],
    time: float,
    *,
    turn: float = 0.0,
    lean: float = 0.0,
    shift: Sequence[float] = (0, 0, 0),
    scene: str = "",
    unit: str = "mm",
) -> tuple[PlantOnDate, list[int]]:
    """A date, its leaves numbered in an order that means nothing, and their true ids."""
    pot = Rotation.from_euler("zx", [turn, lean], degrees=True)
    order = np.random.default_rng(int(10 * time) + 1).permutation(sorted(blades)).tolist()
    leaves = []
    for number, leaf in enumerate(order, start=1):
        points = pot.apply(blades[leaf].reshape(-1, 3)) + shift
        grid = points.reshape(OBSERVATIONS.rows, 3, 3)
        line = resample(grid[:, 1])
        normal = np.cross(grid[1:, :-1] - grid[:-1, 1:], grid[1:, 1:] - grid[:-1, :-1]).sum((0, 1))
        length = float(np.linalg.norm(np.diff(line, axis=0), axis=1).sum())
        numbers = {"length": Number(length, 0.01 * length, unit), "area": Number(length**2, length, f"{unit}^2")}
        leaves.append(SeenLeaf(number, line, normal / np.linalg.norm(normal), points, True, numbers))
    name = scene or f"day-{time:g}"
    return PlantOnDate(name, time, f"{time:g}", unit, knows_up=True, leaves=tuple(leaves), whole={}), order


def true_tracks(tracks: Tracks, truths: Sequence[Sequence[int]]) -> dict[int, set[int]]:
    """{track: true ids of its leaves}."""
    found: dict[int, set[int]] = {}
    for row in tracks.rows:
        if row.leaf is not None:
            found.setdefault(row.track, set()).add(truths[row.date][row.leaf - 1])
    return found


def write_result(
    folder: Path,
    blades: Mapping[int, Floats],
    *,
    unit: str = "mm",
    view: str = "000",
    shapeless: Collection[int] = (),
    rejected: Mapping[int, Kind] = MappingProxyType({}),
) -> None:
    """A result folder of one view, with leaves numbered as they are; some have no shape, some are rejected."""
    labels, surfaces, leaves = np.zeros((40, 20 * len(blades)), np.int64), {}, []
    for number, blade in blades.items():
        labels[10:30, 20 * number - 18 : 20 * number - 2] = number
        if number not in shapeless:
            surfaces[number] = make_surface(fit_blade(blade), num_views=1)
        length = float(np.linalg.norm(np.diff(blade[:, 1], axis=0), axis=1).sum())
        measured = {"length": length, "area": 20 * length, "azimuth": 10.0} if number not in rejected else {}
        reason = f"rejected: {rejected[number]}" if number in rejected else ""
        numbers = {trait.name: missing(reason or "not measured") for trait in LEAF_TRAITS}
        numbers |= {name: Measurement(value, 0.02 * value, "surface") for name, value in measured.items()}
        leaves.append(LeafTraits(
            leaf=number, numbers=numbers, method="none" if number in shapeless else "surface",
            reasons={"test": reason} if reason else {}, rejection=rejected.get(number),
        ))  # fmt: skip
    regions = regions_from_label_maps([labels])
    whole = {"total_leaf_area": Measurement(5000.0, 50.0, "surface")}
    traits = Traits(plant="p", unit=unit, leaves=tuple(leaves), whole=whole, up=(0.0, 0.0, 1.0), up_from="scene")
    height, width = labels.shape
    K = torch.tensor([[[100.0, 0, width / 2], [0, 100, height / 2], [0, 0, 1]]])
    sizes = torch.tensor([[width, height]])
    cameras = Cameras(K=K, R=torch.eye(3)[None], t=torch.zeros(1, 3), sizes=sizes)
    scene = Scene("p", (View(view, folder.parent / f"{view}.png"),), cameras, unit=unit, up=(0.0, 0.0, 1.0))
    matching = Matching(Masks.of(regions, regions.labels), MatchReport("truth"))
    instances = Instances(surfaces=surfaces, voxels={}, traits=traits)
    save_result(Result(scene=scene, matching=matching, instances=instances), folder, report=False)


def fit_blade(blade: Floats) -> Floats:
    """(26, 3) of the patch nearest to the edges and the midrib (rows, 3, 3) of a leaf."""
    rows, places = np.linspace(0, 1, MESH_SHAPE[0]), np.linspace(0, 1, len(blade))
    left, middle, right = (
        np.stack([np.interp(rows, places, blade[:, column, axis]) for axis in range(3)], 1) for column in range(3)
    )
    across = np.linspace(-1, 1, MESH_SHAPE[1])[:, None, None]
    grid = middle + np.where(across < 0, -across * (left - middle), across * (right - middle))
    points = grid.swapaxes(0, 1).reshape(-1, 3)
    return np.linalg.lstsq(patch_grid(*MESH_SHAPE).basis, points, rcond=None)[0]
