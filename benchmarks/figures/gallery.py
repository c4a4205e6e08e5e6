"""Draws docs/gallery.jpg: results of the shipped plant and of one of each of three simulated families, masks given.

    python -m benchmarks.figures.gallery --folder DIR

Scenes and results that are in DIR are not made again: about six minutes on two cores at first.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2
import numpy as np

from benchmarks.figures.demo import HEIGHT, ROOT, draw_meshes, read_cropped
from mvseg.cli import main as run
from mvseg.demo import demo_scene
from mvseg.formats.label_png import read_labels
from mvseg.simulation.cameras import arc_cameras
from mvseg.simulation.growth import grow_plant
from mvseg.simulation.scene_writer import write_scene

FAMILIES = {"strap": 7, "lobed": 10, "lanceolate": 14}  # with a stem; and their numbers of leaves
SEED, NUM_VIEWS, VIEW = 5, 9, "004"
COLUMNS, GAP = 2, 12  # of the picture; pixels


def make_result(name: str, folder: Path) -> Path:
    """The result of one plant, "shipped" or a family; made where it is not there."""
    scene, result = demo_scene(), folder / f"{name}-result"
    if name != "shipped":
        scene = folder / name
        if not scene.exists():
            plant = grow_plant(name, FAMILIES[name], SEED)
            cameras = arc_cameras(NUM_VIEWS, plant, span_deg=360, elevations_deg=(20, 45), width=640, height=480)
            write_scene(scene, plant, cameras, seed=SEED)
    if not result.exists() and run(["infer", str(scene), "--masks", "masks", "--out", str(result), "--quiet"]) != 0:
        raise SystemExit(1)
    return result


def draw_tile(result: Path) -> np.ndarray:
    """(HEIGHT, W, 3) BGR: a photo with its leaves, and all of them in 3D."""
    labels = read_labels(result / "labels" / f"{VIEW}.png")
    photo = read_cropped(result / "overlay" / f"{VIEW}.png", labels)
    return np.concatenate([photo, draw_meshes(result / "scene.glb", 30)], 1)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--folder", type=Path, required=True)
    folder = parser.parse_args().folder
    folder.mkdir(parents=True, exist_ok=True)
    tiles = [draw_tile(make_result(name, folder)) for name in ("shipped", *FAMILIES)]
    padded = [np.pad(tile, ((GAP, GAP), (GAP, GAP), (0, 0)), constant_values=255) for tile in tiles]
    rows = [np.concatenate(padded[start : start + COLUMNS], 1) for start in range(0, len(padded), COLUMNS)]
    picture = cv2.resize(np.concatenate(rows), None, fx=0.75, fy=0.75, interpolation=cv2.INTER_AREA)
    cv2.imwrite(str(ROOT / "docs" / "gallery.jpg"), picture, [cv2.IMWRITE_JPEG_QUALITY, 85])
    print(f"{ROOT / 'docs' / 'gallery.jpg'}: {picture.shape[1]} x {picture.shape[0]}, {HEIGHT} pixels a row")


if __name__ == "__main__":
    main()
