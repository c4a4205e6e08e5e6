"""The small example files of docs/recipes.md, in the forms that other programs write: the shipped plant's masks in
three photos, and its cameras. `python tests/recipe_files.py` writes them anew."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from pycocotools import mask as run_lengths
from scipy.spatial.transform import Rotation

from mvseg.demo import demo_scene
from mvseg.formats.label_png import read_label_png
from mvseg.formats.scene_folder import load_scene
from mvseg.scene import Scene

FOLDER = Path(__file__).parent.parent / "docs" / "recipes"
VIEWS = (0, 3, 6)


def write_all(folder: Path) -> None:
    """All files, below `folder`."""
    scene = load_scene(demo_scene())
    masks = {view: _masks(scene, view) for view in VIEWS}
    for view, of_view in masks.items():
        entries = [_sam_entry(mask) for mask in of_view]
        _write(folder / "sam" / f"{scene.views[view].name}.json", _json(entries))
    _write(folder / "cvat" / "instances_default.json", _json(_coco(scene, masks, "{name}.jpg")))
    roboflow = _roboflow(_coco(scene, masks, "{name}_jpg.rf.0123456789abcdef.jpg"))
    _write(folder / "roboflow" / "_annotations.coco.json", _json(roboflow))
    cameras, images = _colmap(scene)
    _write(folder / "colmap" / "sparse" / "0" / "cameras.txt", cameras)
    _write(folder / "colmap" / "sparse" / "0" / "images.txt", images)
    _write(folder / "colmap" / "sparse" / "0" / "points3D.txt", "")
    _write(folder / "metashape" / "cameras.xml", _metashape(scene))


def _write(path: Path, text: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8", newline="\n")


def _json(content: Any) -> str:
    return json.dumps(content, separators=(",", ":")) + "\n"


def _masks(scene: Scene, view: int) -> list[np.ndarray]:
    width, height = scene.cameras.sizes[view].tolist()
    labels = read_label_png(demo_scene() / "masks" / f"{scene.views[view].name}.png", width, height)
    return [(labels == number).astype(np.uint8) for number in np.unique(labels[labels > 0])]


def _sam_entry(mask: np.ndarray) -> dict[str, Any]:
    """One mask of SAM2AutomaticMaskGenerator(output_mode="coco_rle")."""
    encoded = run_lengths.encode(np.asfortranarray(mask))
    entry = {"segmentation": {"size": encoded["size"], "counts": encoded["counts"].decode()}, "area": int(mask.sum())}
    height, width = mask.shape
    row, column = np.argwhere(mask)[0].tolist()
    entry |= {"bbox": run_lengths.toBbox(encoded).tolist(), "predicted_iou": 0.95, "point_coords": [[column, row]]}
    return entry | {"stability_score": 0.97, "crop_box": [0, 0, width, height]}


def sam_entries(labels: np.ndarray) -> list[dict[str, Any]]:
    """What SAM 2 finds in a photo with these leaves (H, W): background, the whole plant, leaves and halves of them."""
    masks = [labels == 0, labels > 0]
    for number in np.unique(labels[labels > 0]):
        leaf = labels == number
        masks += [leaf, leaf & (np.arange(leaf.shape[1]) < np.argwhere(leaf)[:, 1].mean())]
    return [_sam_entry(mask.astype(np.uint8)) for mask in masks]


def write_cellpose(folder: Path) -> None:
    """What `cellpose --save_png --save_outlines` leaves beside the photos of the shipped plant, pickles included."""
    for path in sorted((demo_scene() / "masks").glob("*.png")):
        labels = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        labels = np.unique(labels, return_inverse=True)[1].reshape(labels.shape).astype(np.uint16)
        cv2.imwrite(str(folder / f"{path.stem}_cp_masks.png"), labels)
        (folder / f"{path.stem}_cp_outlines.txt").write_text("12,40,13,40,13,41\n")
        about: Any = {"filename": f"images/{path.stem}.jpg", "masks": labels, "flows": [], "diameter": 30.0}
        np.save(folder / f"{path.stem}_seg.npy", about)


def _coco(scene: Scene, masks: dict[int, list[np.ndarray]], file_name: str) -> dict[str, Any]:
    images, annotations = [], []
    for number, (view, of_view) in enumerate(masks.items(), start=1):
        width, height = scene.cameras.sizes[view].tolist()
        name = file_name.format(name=scene.views[view].name)
        images.append({"id": number, "file_name": name, "width": width, "height": height})
        for mask in of_view:
            outlines, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
            parts = [cv2.approxPolyDP(outline, 0.7, True) for outline in outlines]
            polygons = [(part.reshape(-1) + 0.5).tolist() for part in parts if len(part) > 2]
            entry = {"id": len(annotations) + 1, "image_id": number, "category_id": 1, "iscrowd": 0}
            annotations.append(entry | {"segmentation": polygons, "area": int(mask.sum())})
    return {"images": images, "annotations": annotations, "categories": [{"id": 1, "name": "leaf"}]}


def _roboflow(coco: dict[str, Any]) -> dict[str, Any]:
    """The same as Roboflow writes it: all numbers from 0 on, the first category is the project's."""
    images = [
        each
        | {
            "id": each["id"] - 1,
            "license": 1,
            "extra": {"name": each["file_name"].replace("_", ".", 1).partition(".rf")[0]},
        }
        for each in coco["images"]
    ]
    annotations = [each | {"id": each["id"] - 1, "image_id": each["image_id"] - 1} for each in coco["annotations"]]
    categories = [
        {"id": 0, "name": "leaves", "supercategory": "none"},
        {"id": 1, "name": "leaf", "supercategory": "leaves"},
    ]
    about = {"info": {"year": "2026", "version": "1"}, "licenses": [{"id": 1, "name": "CC BY 4.0"}]}
    return about | {"categories": categories, "images": images, "annotations": annotations}


def _colmap(scene: Scene) -> tuple[str, str]:
    """cameras.txt and images.txt, without points."""
    cameras, images = "", ""
    for index, view in enumerate(scene.views):
        K, (width, height) = scene.cameras.K[index].numpy(), scene.cameras.sizes[index].tolist()
        x, y, z, w = Rotation.from_matrix(scene.cameras.R[index].numpy()).as_quat(canonical=True).round(9)
        pose = " ".join(f"{number:.9g}" for number in (w, x, y, z, *scene.cameras.t[index].tolist()))
        cameras += f"{index + 1} PINHOLE {width} {height} {K[0, 0]:g} {K[1, 1]:g} {K[0, 2]:g} {K[1, 2]:g}\n"
        images += f"{index + 1} {pose} {index + 1} {view.path.name}\n\n"
    return cameras, images


def _metashape(scene: Scene) -> str:
    """The XML of "Export Cameras", cut to what tells cameras."""
    K, (width, height) = scene.cameras.K[0].numpy(), scene.cameras.sizes[0].tolist()
    size = f'<resolution width="{width}" height="{height}"/>'
    inner = f"{size}<f>{K[0, 0]:g}</f><cx>{K[0, 2] - width / 2:g}</cx><cy>{K[1, 2] - height / 2:g}</cy>"
    lines = ['<?xml version="1.0" encoding="UTF-8"?>']
    lines.append('<document version="2.0.0"><chunk label="Chunk 1" enabled="true">')
    lines.append(f'<sensors><sensor id="0" label="camera" type="frame">{size}')
    lines.append(f'<calibration type="frame" class="adjusted">{inner}</calibration></sensor></sensors><cameras>')
    for index, view in enumerate(scene.views):
        R, t = scene.cameras.R[index].numpy(), scene.cameras.t[index].numpy()
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = R.T, -R.T @ t
        numbers = " ".join(f"{number:.9g}" for number in pose.round(9).ravel() + 0.0)
        camera = f'<camera id="{index}" sensor_id="0" label="{view.name}">'
        lines.append(f"{camera}<transform>{numbers}</transform></camera>")
    return "\n".join([*lines, "</cameras></chunk></document>"]) + "\n"


if __name__ == "__main__":
    write_all(FOLDER)
