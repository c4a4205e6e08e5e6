"""Results of format 1, which had no number yet: what they lack is rebuilt from the scene folder and the meshes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from mvseg.errors import InputError, warn
from mvseg.formats.rig import read_rig
from mvseg.formats.scene_folder import load_scene
from mvseg.masks import Masks
from mvseg.reconstruction.surface.leaf_patch import NUM_COEFFICIENTS, grid_vertices, patch_grid
from mvseg.reconstruction.surface.leaf_surface import MESH_SHAPE, LeafSurface, Quality
from mvseg.results.run_record import RunRecord, find_place
from mvseg.scene import Cameras, Scene, View
from mvseg.traits.leaf import BASE_UNKNOWN
from mvseg.traits.measure import LeafTraits


def rebuild_scene(folder: Path, run: RunRecord, images: Sequence[tuple[str, str, int, int]]) -> Scene:
    """The scene of a result, from the folder that its run read; `images` are the name, the file name, the width and the
    height of each view.

    Where that folder is gone, or has other photos, an InputWarning says so, and the cameras stand at the origin.
    """
    world = run.traits
    unit, up = (None, None) if world is None else (world.unit, world.up)
    place = find_place(folder, run, Path(str(run.config.get("scene"))))
    sizes = [[width, height] for *_, width, height in images]
    if place.is_dir():
        scene = load_scene(place)
        refined = folder / "cameras.json"
        if run.poses is not None and run.poses.refined and refined.is_file():
            scene = replace(scene, cameras=read_rig(refined).cameras)
        elif isinstance(scale := run.config.get("scale"), int | float):
            scene = replace(scene, cameras=scene.cameras.scale(scale))
        names = [view.name for view in scene.views]
        if names == [name for name, *_ in images] and scene.cameras.sizes.tolist() == sizes:
            return replace(scene, name=run.scene or scene.name, unit=unit or scene.unit, up=up or scene.up)
    warn(f"{folder}: holds no cameras, and its scene {place} is gone or another: they are not known")
    K = [[[max(size), 0, size[0] / 2], [0, max(size), size[1] / 2], [0, 0, 1]] for size in sizes]
    cameras = Cameras(
        K=torch.tensor(K, dtype=torch.float64).reshape(-1, 3, 3),
        R=torch.eye(3).repeat(len(sizes), 1, 1),
        t=torch.zeros(len(sizes), 3),
        sizes=torch.tensor(sizes, dtype=torch.int64).reshape(-1, 2),
    )
    views = tuple(View(name, place / file_name) for name, file_name, *_ in images)
    return Scene(name=run.scene or folder.name, views=views, cameras=cameras, unit=unit or "", up=up)


def rebuild_surfaces(folder: Path, leaves: Sequence[LeafTraits], masks: Masks) -> dict[int, LeafSurface]:
    """{instance id: surface} of the leaves that have one: the patch whose grid is the mesh in leaves/.

    Covariance and residuals are NaN; every view has the median IoU.

    Raises:
        InputError: a mesh is missing or broken.
    """
    basis = patch_grid(*MESH_SHAPE).basis.reshape(*MESH_SHAPE, NUM_COEFFICIENTS)
    from_vertices = np.linalg.pinv(grid_vertices(basis))
    surfaces = {}
    for each in leaves:
        path = folder / "leaves" / f"leaf_{each.leaf:03d}.ply"
        if each.method != "surface":
            continue
        vertices = _read_vertices(path)
        if len(vertices) != from_vertices.shape[1]:
            raise InputError(f"{path}: has {len(vertices)} vertices, expected {from_vertices.shape[1]}")
        views = masks.view_index[masks.instance_ids == each.leaf].unique()
        unknown = torch.full((len(views),), torch.nan, dtype=torch.float64)
        surfaces[each.leaf] = LeafSurface(
            coefficients=torch.from_numpy(from_vertices @ vertices),
            covariance=torch.full((3 * NUM_COEFFICIENTS,) * 2, torch.nan, dtype=torch.float64),
            views=views,
            residual_px=unknown,
            iou=torch.full_like(unknown, each.numbers["quality"].value),
            is_oriented=each.numbers["azimuth"].method != BASE_UNKNOWN.method,
            quality=Quality(each.reasons),
        )
    return surfaces


def _read_vertices(path: Path) -> np.ndarray:
    """(P, 3) float64 vertices of a mesh."""
    import trimesh  # slow to load

    if not path.is_file():
        raise InputError(f"{path}: is missing, expected the whole result that mvseg wrote")
    try:
        mesh: Any = trimesh.load(path, process=False, force="mesh")
        return np.asarray(mesh.vertices, dtype=np.float64)
    except Exception as error:  # trimesh raises anything at broken files
        raise InputError(f"{path}: is no mesh that mvseg wrote ({error})") from None
