"""Plants over days for the tests of tracking: leaves on a stem as arcs, with known ids, seen in any pot."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from mvseg.reconstruction.surface.leaf_patch import grid_triangles, grid_vertices
from mvseg.reconstruction.surface.leaf_surface import MESH_SHAPE
from mvseg.tracking.dates import ROWS, Floats, Number, PlantOnDate, SeenLeaf, resample
from mvseg.tracking.track import Tracks

Blades = dict[int, Floats]  # {true id: (rows, 3, 3) edge, midrib, edge from base to tip}


def grow_blades(count: int, seed: int) -> Blades:
    """Leaves with golden-angle azimuths up a stem; lengths and slopes by chance."""
    rng, blades = np.random.default_rng(seed), {}
    for leaf in range(1, count + 1):
        azimuth = 2.4 * leaf + rng.normal(0, 0.3)
        out = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
        side = np.array([-out[1], out[0], 0.0])
        along = np.linspace(0, 1, ROWS)[:, None] * rng.uniform(50, 110)
        rise, droop = rng.uniform(0.2, 0.9), rng.uniform(0.002, 0.008)
        line = (0.0, 0.0, 22.0 * leaf) + 6 * out + along * out + (rise * along - droop * along**2) * (0, 0, 1)
        half = 14 * np.sin(np.pi * np.linspace(0.02, 0.98, ROWS))[:, None]
        blades[leaf] = np.stack([line - half * side, line, line + half * side], 1)
    return blades


def grown(blades: Blades, factor: float) -> Blades:
    """Each leaf larger about its base."""
    return {leaf: blade[0, 1] + factor * (blade - blade[0, 1]) for leaf, blade in blades.items()}


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
        grid = points.reshape(ROWS, 3, 3)
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


def write_result(folder: Path, blades: Mapping[int, Floats], *, unit: str = "mm", view: str = "000") -> None:
    """What tracking reads of a result folder, with leaves numbered as they are."""
    from mvseg.formats.label_png import write_label_png
    from mvseg.formats.mesh import write_ply

    (folder / "leaves").mkdir(parents=True)
    rows = ["plant,leaf,trait,value,sd,unit,method,ontology", f"p,,total_leaf_area,5000,50,{unit}^2,surface,"]
    labels = np.zeros((40, 20 * len(blades)), np.uint16)
    for number, blade in blades.items():
        fine = np.stack([np.interp(np.linspace(0, 1, MESH_SHAPE[0]), np.linspace(0, 1, ROWS), blade[:, c, axis])
                         for c in range(3) for axis in range(3)], 1).reshape(MESH_SHAPE[0], 3, 3)  # fmt: skip
        across = np.linspace(-1, 1, MESH_SHAPE[1])[None, :, None]
        grid = fine[:, 1:2] + np.where(
            across < 0, -across * (fine[:, :1] - fine[:, 1:2]), across * (fine[:, 2:] - fine[:, 1:2])
        )
        mesh = trimesh.Trimesh(grid_vertices(grid), grid_triangles(*MESH_SHAPE), process=False)
        write_ply(folder / "leaves" / f"leaf_{number:03d}.ply", mesh, (0, 255, 0), instance_id=number)
        length = float(np.linalg.norm(np.diff(blade[:, 1], axis=0), axis=1).sum())
        for trait, value, of in (
            ("length", length, unit),
            ("area", 20 * length, f"{unit}^2"),
            ("azimuth", 10, "degree"),
        ):
            rows.append(f"p,{number},{trait},{value:.6g},{0.02 * value:.6g},{of},surface,")
        labels[10:30, 20 * number - 18 : 20 * number - 2] = number
    (folder / "traits.csv").write_text("\n".join(rows) + "\n", encoding="utf-8")
    (folder / "run.json").write_text(
        f'{{"scene": "p", "inputs": {{}}, "traits": {{"unit": "{unit}", "up": [0, 0, 1]}}, "files": {{}}}}',
        encoding="utf-8",
    )
    write_label_png(folder / "labels" / f"{view}.png", labels)
    height, width = labels.shape
    image = f'{{"id": 1, "file_name": "{view}.png", "name": "{view}", "width": {width}, "height": {height}}}'
    (folder / "instances.json").write_text(f'{{"images": [{image}], "annotations": []}}', encoding="utf-8")
