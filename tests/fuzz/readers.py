"""Every public reader: a whole file for it, and how it is read. What is accepted is used, too."""

from __future__ import annotations

import argparse
import base64
import dataclasses
import json
from collections.abc import Callable
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pycolmap
import torch
from PIL import Image
from safetensors.torch import save

from known_leaves import bent_blade
from mvseg.cli.command import _parse
from mvseg.cli.options import build_options
from mvseg.detection.config import DetectConfig
from mvseg.detectors.weights_file import read_weights
from mvseg.errors import InputError
from mvseg.formats.image_file import is_turned, read_rgb, sensor_bits
from mvseg.formats.label_png import read_label_png
from mvseg.formats.photos import check_photos, read_photo
from mvseg.formats.run_lengths import encode_mask
from mvseg.formats.scene_folder import load_masks, load_scene
from mvseg.matching.config import MatchConfig
from mvseg.reconstruction.config import ReconstructConfig
from mvseg.reconstruction.voxels import VoxelGrid
from mvseg.results.earlier import check_out
from mvseg.results.read import load_result, read_instances
from mvseg.results.shapes_file import write_surfaces, write_voxels
from mvseg.training.config import TrainConfig
from mvseg.training.data import list_samples, read_sample

WIDTH, HEIGHT, VIEWS = 16, 12, 2
NAMES = [f"{view:03d}" for view in range(VIEWS)]


@dataclass(frozen=True)
class Reader:
    """One format: {name: a JSON document or bytes} of files."""

    whole: dict[str, Any]  # of which one is broken
    read: Callable[[Path], object]  # of the folder that holds them
    others: dict[str, Any] = dataclasses.field(default_factory=dict)  # that stay whole


def write_files(folder: Path, files: dict[str, Any]) -> None:
    for name, content in files.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content if isinstance(content, bytes) else json.dumps(content).encode())


K = [[20.0, 0, 8], [0, 20.0, 6], [0, 0, 1]]
RIG = {
    "format": "mvseg-rig/1",
    "unit": "mm",
    "views": [
        {"file": f"images/{name}.png", "width": WIDTH, "height": HEIGHT, "K": K, "R": np.eye(3).tolist(),
         "t": [10.0 * view, 0, 50], "distortion": [0.1, 0, 0, 0, 0]}
        for view, name in enumerate(NAMES)
    ],
}  # fmt: skip
TRANSFORMS = {
    "w": WIDTH, "h": HEIGHT, "fl_x": 20.0, "fl_y": 20.0, "cx": 8.0, "cy": 6.0, "k1": 0.1, "camera_model": "OPENCV",
    "frames": [
        {"file_path": f"images/{name}.png", "transform_matrix": (np.eye(4) + view * np.eye(4, k=3)).tolist()}
        for view, name in enumerate(NAMES)
    ],
}  # fmt: skip


TURNTABLE = {
    "format": "mvseg-turntable/1",
    "unit": "mm",
    "axis": {"point": [0, 0, 0], "direction": [0, 0, 1]},
    "cameras": {"top": {"width": WIDTH, "height": HEIGHT, "K": K, "R": np.eye(3).tolist(), "t": [10.0, 0, 50],
                        "distortion": [0.1, 0, 0, 0, 0]}},
    "views": [{"file": f"images/{name}.png", "camera": "top", "angle": 30 * view} for view, name in enumerate(NAMES)],
}  # fmt: skip
BOP = {
    str(view): {
        "cam_K": np.ravel(K).tolist(),
        "cam_R_w2c": np.eye(3).ravel().tolist(),
        "cam_t_w2c": [10.0 * view, 0, 50],
    }
    for view in range(VIEWS)
}
CALIBRATION = b"""%YAML:1.0
---
image_width: 16
image_height: 12
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 20., 0., 7.5, 0., 20., 5.5, 0., 0., 1. ]
distortion_coefficients: !!opencv-matrix
   rows: 1
   cols: 5
   dt: d
   data: [ 1.0e-01, 0., 0., 0., 0. ]
"""
CALIBRATED = {
    "format": "mvseg-rig/1",
    "views": [
        {"file": f"images/{name}.png", "calibration": "camera.yaml", "R": np.eye(3).tolist(), "t": [10.0 * view, 0, 50]}
        for view, name in enumerate(NAMES)
    ],
}
METASHAPE = b"""<?xml version="1.0" encoding="UTF-8"?>
<document version="2.0.0">
  <chunk label="Chunk 1" enabled="true">
    <sensors next_id="1">
      <sensor id="0" label="lens" type="frame">
        <resolution width="16" height="12"/>
        <calibration type="frame" class="adjusted">
          <resolution width="16" height="12"/><f>20</f><cx>0.5</cx><k1>0.1</k1><p1>0.001</p1>
        </calibration>
      </sensor>
    </sensors>
    <components next_id="1" active_id="0"><component id="0"><transform>
      <rotation>1 0 0 0 1 0 0 0 1</rotation><translation>4 5 6</translation><scale>0.5</scale>
    </transform></component></components>
    <cameras next_id="2">
      <camera id="0" sensor_id="0" component_id="0" label="000">
        <transform>1 0 0 0 0 1 0 0 0 0 1 -50 0 0 0 1</transform></camera>
      <camera id="1" sensor_id="0" component_id="0" label="001">
        <transform>1 0 0 10 0 1 0 0 0 0 1 -50 0 0 0 1</transform></camera>
      <camera id="2" sensor_id="0" label="002"/>
    </cameras>
  </chunk>
</document>
"""


def draw(mode: str, kind: str, **options: Any) -> bytes:
    file = BytesIO()
    pixels = np.random.default_rng(0).integers(0, 255, (HEIGHT, WIDTH, 3), dtype=np.uint8)
    Image.fromarray(pixels).convert(mode).save(file, kind, **options)
    return file.getvalue()


def label_png() -> bytes:
    file = BytesIO()
    labels = np.zeros((HEIGHT, WIDTH), np.uint16)
    labels[2:6, 3:9] = 1
    labels[7:10, 3:9] = 65_535
    Image.fromarray(labels).save(file, "PNG")
    return file.getvalue()


def label_tiff() -> bytes:
    """Labels in floats of 32 bits, as ImageJ writes them."""
    file = BytesIO()
    Image.fromarray(np.arange(WIDTH * HEIGHT, dtype=np.float32).reshape(HEIGHT, WIDTH) // 40).save(file, "TIFF")
    return file.getvalue()


def deep_png() -> bytes:
    """A photo in colours of 16 bits, of which 12 are used; Pillow writes none."""
    pixels = np.random.default_rng(1).integers(0, 1 << 12, (HEIGHT, WIDTH, 3), dtype=np.uint16)
    return cv2.imencode(".png", pixels)[1].tobytes()


def npy(content: Any) -> bytes:
    file = BytesIO()
    np.save(file, content)
    return file.getvalue()


LABELS = label_png()
PHOTO = draw("RGB", "PNG")
MASK = np.zeros((HEIGHT, WIDTH), bool)
MASK[2:8, 3:9] = True
RUNS = {"size": [HEIGHT, WIDTH], "counts": [38, 6, 6, 6, WIDTH * HEIGHT - 56]}
SEGMENTATIONS = [[[1.0, 1, 9, 1, 9, 9]], encode_mask(MASK), RUNS]
IMAGES = [{"id": view, "file_name": f"{name}.png", "width": WIDTH, "height": HEIGHT} for view, name in enumerate(NAMES)]
COCO: dict[str, Any] = {
    "images": IMAGES,
    "categories": [{"id": 4, "name": "leaf"}],
    "annotations": [
        {"id": 9 + i, "image_id": i % VIEWS, "category_id": 4, "segmentation": segmentation, "iscrowd": i % 2}
        for i, segmentation in enumerate(SEGMENTATIONS)
    ],
}
COCO_RESULTS = [each | {"image_id": f"{NAMES[i % VIEWS]}.png"} for i, each in enumerate(COCO["annotations"])]
LABELME: dict[str, Any] = {
    "version": "5.4.1",
    "shapes": [
        {"label": "leaf", "points": [[1, 1], [9, 1], [9, 9]], "group_id": None, "shape_type": "polygon"},
        {"label": "leaf", "points": [[2, 2], [5, 6]], "group_id": 3, "shape_type": "rectangle"},
        {"label": "stem", "points": [[6, 6], [8, 8]], "group_id": 3, "shape_type": "circle"},
        {"label": "leaf", "points": [[0, 0], [WIDTH - 1, HEIGHT - 1]], "shape_type": "mask",
         "mask": base64.b64encode(draw("L", "PNG")).decode()},
        {"label": "tip", "points": [[3, 3]], "shape_type": "point"},
    ],
    "imageWidth": WIDTH,
    "imageHeight": HEIGHT,
}  # fmt: skip
SAM = [{"segmentation": encode_mask(MASK), "area": 36, "bbox": [3, 2, 6, 6]}, {"segmentation": RUNS, "area": 6}]
YOLO = b"0 0.1 0.1 0.6 0.1 0.6 0.8\n1 0.5 0.5 0.2 0.2\n1 0.2 0.2 0.9 0.2 0.9 0.9 0.2 0.9 0.87\n"
YOLO_NAMES = b"path: .\nnames:\n  0: leaf\n  1: stem\n"
CAMERA = {"K": K, "R": np.eye(3).tolist(), "t": [0, 0, 50]}
LENS = {"model": "OPENCV", "params": [20, 20, 8, 6, 0.1, 0, 0, 0]}
RESULT = {
    "images": [
        image | {"name": name, "camera": CAMERA | ({"lens": LENS} if name == NAMES[0] else {})}
        for image, name in zip(IMAGES, NAMES, strict=True)
    ],
    "annotations": [
        {"image_id": view, "instance_id": 1, "segmentation": encode_mask(MASK), "match_score": 0.9, "source_label": 3}
        for view in range(VIEWS)
    ],
}  # fmt: skip
RESULT_RUN = {
    "format": 2, "scene": "plant", "photos": "/plants/images", "matched_by": "nview", "residual_px": 1,
    "matching": {"has_probabilities": True, "explained": 0.9, "view_explained": [0.9, None]},
    "poses": {"refined": True, "residual_px": [1.0, None]}, "traits": {"unit": "mm", "up": [0, 0, 1]},
    "edits": [{"op": "reject", "view": "000", "at": [1, 2]}],
    "corrections": [{"edit": 1, "op": "reject", "fate": "applied", "problem": ""}],
    "counts": {"regions": 1}, "seconds": {"match": 0.5}, "config": {"scene": "/plants", "from_here": {"scene": ".."}},
}  # fmt: skip
RUN = {"files": {"labels/000.png": "0" * 64, "contact.png": "1" * 64}, "mvseg": "0.1.0"}
METADATA = {"arch": "resnet18_fpn", "categories": '["leaf"]', "image_size": "320"}
STATE = {"roi_heads.box_predictor.cls_score.bias": torch.zeros(2), "weight": torch.arange(6.0)}


def checkpoint() -> bytes:
    file = BytesIO()
    torch.save({"model": STATE, "ema": None, "step": 3}, file)
    return file.getvalue()


def colmap(folder: Path, *, is_binary: bool) -> dict[str, bytes]:
    """The files of a COLMAP model, written by pycolmap into an empty folder."""
    model = pycolmap.Reconstruction()
    camera = pycolmap.Camera(model="OPENCV", width=WIDTH, height=HEIGHT, params=[20, 20, 8, 6, 0.1, 0, 0, 0])
    camera.camera_id = 1
    model.add_camera_with_trivial_rig(camera)
    for view, name in enumerate(NAMES):
        image = pycolmap.Image(f"{name}.png", pycolmap.Point2DList(), 1, view + 1)
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(np.eye(3)), np.array([10.0 * view, 0, 50]))
        model.add_image_with_trivial_frame(image, pose)
    folder.mkdir()
    (model.write_binary if is_binary else model.write_text)(folder)
    return {f"sparse/{path.name}": path.read_bytes() for path in sorted(folder.iterdir())}


CONFIG = b"""masks: masks
out: results
quiet: true
match: {method: nview, num_points: 200, seed: 4, num_restarts: 3}
detect:
  min_score: 0.5
  image_size: 640
reconstruct:
  threshold: 0.5
  shape: voxels
"""
TRAIN_CONFIG = b"""photos: photos
labels: labels
output: out
scale_range: [0.6, 1.6]
weights: null
epochs: 3
lr: 1.0e-3
val_photos: a
val_labels: b
"""


def read_cameras(folder: Path) -> None:
    scene = load_scene(folder)
    check_photos(scene)
    assert bool(scene.cameras.world_from_px.isfinite().all())
    assert bool(scene.cameras.centers.isfinite().all())
    assert all(folder in view.path.resolve().parents for view in scene.views)


def read_masks(folder: Path) -> None:
    regions = load_masks(load_scene(folder), folder / "masks.json")
    assert int(regions.crops.sum()) == int(regions.areas.sum())


def read_mask_folder(folder: Path) -> None:
    regions = load_masks(load_scene(folder), folder / "masks")
    assert int(regions.crops.sum()) == int(regions.areas.sum())


def read_training(folder: Path) -> None:
    for sample in list_samples(folder, folder / "masks.json").samples:
        read_sample(sample)


def read_photos(folder: Path) -> None:
    for path in folder.iterdir():
        is_turned(path)
        assert read_rgb(path).shape[2] == 3
        assert 8 <= sensor_bits(path) <= 16


def read_photos_of_scene(folder: Path) -> None:
    scene = load_scene(folder)
    check_photos(scene)
    for view in range(VIEWS):
        assert read_photo(scene, view).shape == (HEIGHT, WIDTH, 3)


def read_labels(folder: Path) -> None:
    assert read_label_png(folder / "000.png", WIDTH, HEIGHT).shape == (HEIGHT, WIDTH)


def read_options(folder: Path) -> None:
    try:
        args = _parse(["infer", "plant", "--config", str(folder / "run.yaml")])["infer"]
    except argparse.ArgumentError as error:
        raise InputError(str(error)) from error
    build_options(DetectConfig, args.detect)
    build_options(MatchConfig, args.match)
    build_options(ReconstructConfig, args.reconstruct)


def read_training_options(folder: Path) -> None:
    try:
        args = _parse(["train", "--config", str(folder / "train.yaml")])["train"]
    except argparse.ArgumentError as error:
        raise InputError(str(error)) from error
    build_options(TrainConfig, args)


def read_result(folder: Path) -> None:
    result = load_result(folder)
    for surface in (result.surfaces or {}).values():
        surface.mesh()
    regions, truth = read_instances(folder, folder / "truth")
    assert regions.num_views == len(truth)


def result_files(folder: Path) -> dict[str, Any]:
    """Of a whole result with shapes and traits."""
    write_surfaces(folder / "surfaces.npz", {1: bent_blade(), 2: bent_blade()})
    votes = torch.rand(3, 4, 5, generator=torch.Generator().manual_seed(0))
    grid = VoxelGrid(origin=torch.zeros(3).double(), voxel_size=0.5, votes=votes, num_views=2, threshold=0.5)
    write_voxels(folder / "voxels.npz", {2: grid})
    tables = Path(__file__).parent  # of two leaves of the shipped plant
    files: dict[str, Any] = {name: (folder / name).read_bytes() for name in ("surfaces.npz", "voxels.npz")}
    files |= {name: (tables / name).read_bytes() for name in ("traits.csv", "traits_wide.csv")}
    return files | {"instances.json": RESULT, "run.json": RESULT_RUN}


def readers(folder: Path) -> dict[str, Reader]:
    """All of them; `folder` is a new one for what pycolmap writes."""
    folder.mkdir()
    rig_file, labels = {"cameras.json": RIG}, {f"truth/{name}.png": LABELS for name in NAMES}
    photos = {f"{name}.png": PHOTO for name in NAMES}
    exif = Image.Exif()
    exif[0x0112] = 6
    pictures = {
        "a.jpg": draw("RGB", "JPEG", exif=exif), "a.png": PHOTO, "b.png": draw("P", "PNG"), "c.png": draw("LA", "PNG"),
        "a.tif": draw("RGB", "TIFF"), "b.tif": draw("L", "TIFF", compression="tiff_lzw"), "a.bmp": draw("RGB", "BMP"),
        "a.webp": draw("RGB", "WEBP"), "b.jpg": draw("CMYK", "JPEG"), "d.png": deep_png(),
    }  # fmt: skip
    pngs = {"masks/000.png": LABELS, "masks/001.png": draw("1", "PNG")}
    tiffs = {"masks/000.tif": draw("I", "TIFF"), "masks/001.tif": label_tiff()}
    bop_photos = {f"rgb/{view:06d}.png": PHOTO for view in range(VIEWS)}
    images = {f"images/{name}.png": PHOTO for name in NAMES}
    per_mask = {f"masks/{name}/{number}.png": draw("L", "PNG") for name in NAMES for number in range(2)}
    labels_of = np.arange(WIDTH * HEIGHT, dtype=np.int32).reshape(HEIGHT, WIDTH) // 40
    arrays = {"masks/000.npy": npy(labels_of), "masks/001.npy": npy(np.stack([MASK, ~MASK]))}
    return {
        "rig": Reader(rig_file, read_cameras),
        "transforms": Reader({"transforms.json": TRANSFORMS}, read_cameras),
        "turntable": Reader({"turntable.json": TURNTABLE}, read_cameras),
        "bop": Reader({"scene_camera.json": BOP}, read_cameras, bop_photos),
        "metashape": Reader({"cameras.xml": METASHAPE}, read_cameras),
        "calibration": Reader({"camera.yaml": CALIBRATION, "cameras.json": CALIBRATED}, read_cameras),
        "colmap text": Reader(colmap(folder / "text", is_binary=False), read_cameras),
        "colmap binary": Reader(colmap(folder / "binary", is_binary=True), read_cameras),
        "label png": Reader({"000.png": LABELS}, read_labels),
        "photos": Reader(pictures, read_photos),
        "photos of a scene": Reader(images | {"images/001.png": deep_png()}, read_photos_of_scene, rig_file),
        "label images": Reader(pngs, read_mask_folder, rig_file),
        "label images in TIFF": Reader(tiffs, read_mask_folder, rig_file),
        "one image per mask": Reader(per_mask, read_mask_folder, rig_file),
        "arrays": Reader(arrays, read_mask_folder, rig_file),
        "labelme": Reader({f"masks/{name}.json": LABELME for name in NAMES}, read_mask_folder, rig_file),
        "sam": Reader({f"masks/{name}.json": SAM for name in NAMES}, read_mask_folder, rig_file),
        "yolo": Reader(
            {"masks/000.txt": YOLO, "masks/data.yaml": YOLO_NAMES}, read_mask_folder, rig_file | {"masks/001.txt": b""}
        ),
        "coco results": Reader({"masks.json": COCO_RESULTS}, read_masks, rig_file),
        "coco": Reader({"masks.json": COCO}, read_masks, rig_file),
        "coco for training": Reader({"masks.json": COCO}, read_training, photos),
        "config": Reader({"run.yaml": CONFIG}, read_options),
        "training config": Reader({"train.yaml": TRAIN_CONFIG}, read_training_options),
        "safetensors": Reader({"w.safetensors": save(STATE, METADATA)}, lambda f: read_weights(f / "w.safetensors")),
        "checkpoint": Reader({"w.pt": checkpoint()}, lambda f: read_weights(f / "w.pt")),
        "result": Reader(result_files(folder), read_result, labels),
        "run": Reader({"run.json": RUN}, check_out),
    }
