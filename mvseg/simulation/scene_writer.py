"""One simulated scene on disk, as mvseg reads it. A scene folder holds

    cameras.json              rig: poses cam_from_world, pixel centres at half integers
    images/000.jpg            photos
    masks/000.png             uint16 labels, 0 = not a leaf; shuffled numbers, which mean nothing across views
    truth/000.png             the same pixels with the true leaf ids
    truth/leaves/leaf_001.ply one mesh per leaf
    truth/traits.csv          leaf_id, length, width, area in the scene's unit

and appears whole or not at all.
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import trimesh
from numpy.typing import NDArray

from mvseg.errors import InputError
from mvseg.formats.label_png import write_label_png
from mvseg.formats.rig import write_rig
from mvseg.formats.text_file import write_table
from mvseg.scene import Cameras, Scene, View
from mvseg.simulation.growth import SimulatedPlant
from mvseg.simulation.ray_cast import build_stage, render_stage
from mvseg.system.atomic import folder_whole

JPEG_QUALITY = 90  # chosen: of photos
MIN_PIXELS = 30  # limit: a leaf with fewer visible pixels in a view is left out of that view's masks and truth


def write_scene(folder: Path | str, plant: SimulatedPlant, cameras: Cameras, *, seed: int) -> None:
    """Photograph a plant and write the scene folder described above. A failure leaves nothing behind. `seed` is that of
    light, materials, noise and of the numbers in `masks/`; the truth does not depend on it. Raises InputError: the
    folder exists."""
    folder = Path(folder)
    if folder.exists():
        raise InputError(f"{folder} exists already, expected a new folder for the scene")
    with folder_whole(folder) as partial:
        write_views(partial, plant, cameras, seed=seed)
        write_truth(partial / "truth", plant)


def write_views(folder: Path, plant: SimulatedPlant, cameras: Cameras, *, seed: int) -> None:
    """Write rig file, photos, masks and true label images."""
    (folder / "images").mkdir()
    stage = build_stage(plant, seed=seed)
    views = tuple(View(f"{view:03d}", folder / f"images/{view:03d}.jpg") for view in range(len(cameras)))
    for view, each in enumerate(views):
        shot = render_stage(stage, cameras, view)
        truth, shuffle = drop_small(shot.ids, MIN_PIXELS), np.random.default_rng([seed, view])
        write_jpeg(each.path, shot.rgb)
        write_label_png(folder / "truth" / f"{each.name}.png", truth)
        write_label_png(folder / "masks" / f"{each.name}.png", shuffle_labels(truth, shuffle))
    scene = Scene(name=folder.name, views=views, cameras=cameras, unit="mm", up=(0.0, 0.0, 1.0))
    write_rig(folder / "cameras.json", scene, [f"images/{each.path.name}" for each in views])


def write_truth(folder: Path, plant: SimulatedPlant) -> None:
    """Write the leaf meshes and the table of traits."""
    (folder / "leaves").mkdir()
    sizes = [(f"{leaf.length:.6f}", f"{leaf.width:.6f}", f"{leaf.area:.6f}") for leaf in plant.leaves]
    rows = [(leaf.leaf_id, *size) for leaf, size in zip(plant.leaves, sizes, strict=True)]
    write_table(folder / "traits.csv", ["leaf_id", "length", "width", "area"], rows)
    for leaf in plant.leaves:
        mesh = trimesh.Trimesh(leaf.vertices, leaf.faces, process=False)
        mesh.export(folder / "leaves" / f"leaf_{leaf.leaf_id:03d}.ply")


def drop_small(labels: NDArray[np.uint16], min_pixels: int) -> NDArray[np.uint16]:
    """(H, W) labels without those that cover fewer than `min_pixels` pixels."""
    return np.where(np.bincount(labels.ravel())[labels] >= min_pixels, labels, 0).astype(np.uint16)


def shuffle_labels(labels: NDArray[np.uint16], rng: np.random.Generator) -> NDArray[np.uint16]:
    """(H, W) the same regions, numbered from 1 in random order."""
    numbers, dense = np.unique(labels, return_inverse=True)
    shuffled = np.zeros(len(numbers), np.uint16)
    shuffled[numbers > 0] = rng.permutation(np.count_nonzero(numbers)) + 1
    return shuffled[dense.reshape(labels.shape)]


def write_jpeg(path: Path, rgb: NDArray[np.uint8]) -> None:
    """Write a photo (H, W, 3); OpenCV's own writer does not report a full disk."""
    options = [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY]
    path.write_bytes(cv2.imencode(".jpg", cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR), options)[1].tobytes())
