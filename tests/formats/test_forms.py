"""Forms of masks and lenses that look like others: read right, or refused by one sentence at the door."""

from __future__ import annotations

import base64
import json
import math
import struct
from collections.abc import Callable
from io import BytesIO
from pathlib import Path
from typing import Any, get_type_hints

import numpy as np
import pytest
import torch
from PIL import Image

from mvseg.checks.poses import pairwise_agreement
from mvseg.checks.turned_masks import low_fit_findings, take_out_of_square, transpose
from mvseg.cli.options import CAN_BE_OFF, _with_words
from mvseg.config import RunConfig
from mvseg.demo import demo_scene
from mvseg.detection.config import DetectConfig
from mvseg.errors import InputError
from mvseg.formats.label_png import read_label_png
from mvseg.formats.opencv_yaml import read_calibration
from mvseg.formats.scene_folder import load_masks, load_scene
from mvseg.formats.transforms_json import read_transforms
from mvseg.regions import regions_from_label_maps
from mvseg.traits.config import TraitsConfig
from scene_folders import HEIGHT, WIDTH, write_scene
from warned import warns_of


@pytest.fixture
def plant(tmp_path: Path) -> Path:
    return write_scene(tmp_path / "plant")


def labels_of(plant: Path) -> list[np.ndarray]:
    return [read_label_png(plant / "masks" / f"{view:03d}.png", WIDTH, HEIGHT) for view in range(4)]


def write_each(plant: Path, write: Callable[[Path, np.ndarray], None]) -> Path:
    folder = plant / "other"
    folder.mkdir(exist_ok=True)
    for view, labels in enumerate(labels_of(plant)):
        write(folder / f"{view:03d}", labels)
    return folder


def same(plant: Path, masks: Path) -> bool:
    scene = load_scene(plant)
    one, other = load_masks(scene, masks), load_masks(scene, plant / "masks")
    return torch.equal(one.boxes, other.boxes) and torch.equal(one.crops, other.crops)


def masks_of(labels: np.ndarray) -> list[np.ndarray]:
    return [labels == number for number in np.unique(labels[labels > 0])]


def write_palette(path: Path, labels: np.ndarray) -> None:
    """The background has index 3 and is black; index 0 is a leaf's."""
    ranks = np.unique(labels, return_inverse=True)[1].reshape(labels.shape)
    image = Image.fromarray(((ranks + 3) % 4).astype(np.uint8)).convert("P")
    image.putpalette([10, 200, 30, 20, 90, 40, 30, 90, 200, 0, 0, 0])
    image.save(path.with_suffix(".png"))


def write_labelme(path: Path, labels: np.ndarray, *, group: int | None = 1) -> None:
    def png(mask: np.ndarray) -> str:
        buffer = BytesIO()
        Image.fromarray(mask).save(buffer, format="PNG")
        return base64.b64encode(buffer.getvalue()).decode()

    about = {"label": "leaf", "group_id": group, "shape_type": "mask", "points": [[0, 0], [WIDTH, HEIGHT]]}
    parts = [mask & side for mask in masks_of(labels) for side in SIDES]
    shapes = [about | {"mask": png(part)} for part in parts]
    path.with_suffix(".json").write_text(json.dumps({"shapes": shapes}))


SIDES = [np.arange(WIDTH) % 2 == side for side in (0, 1)]


def coco(plant: Path, segmentation_of: Callable[[np.ndarray], Any]) -> Path:
    images = [{"id": view, "file_name": f"{view:03d}.png", "width": WIDTH, "height": HEIGHT} for view in range(4)]
    masks = [(view, mask) for view, labels in enumerate(labels_of(plant)) for mask in masks_of(labels)]
    annotations = [{"id": number, "image_id": view, "segmentation": segmentation_of(mask)}
                   for number, (view, mask) in enumerate(masks)]  # fmt: skip
    path = plant / "coco.json"
    path.write_text(json.dumps({"images": images, "annotations": annotations}))
    return path


def runs(flat: np.ndarray) -> list[int]:
    ends = np.flatnonzero(np.diff(flat.astype(int))) + 1
    counts = np.diff([0, *ends, len(flat)]).tolist()
    return [0, *counts] if flat[0] else counts


def test_bitmaps_of_sam(plant: Path) -> None:
    masks = write_each(plant, lambda path, labels: path.with_suffix(".json").write_text(  # type: ignore[arg-type,return-value]
        json.dumps([{"segmentation": mask.tolist()} for mask in masks_of(labels)])))  # fmt: skip
    assert same(plant, masks)
    assert same(plant, coco(plant, lambda mask: mask.astype(int).tolist()))
    with pytest.raises(InputError, match=f"its bitmap is {HEIGHT} x {WIDTH}, expected {WIDTH} x {HEIGHT}"):
        list(load_masks(load_scene(plant), coco(plant, lambda mask: mask.T.tolist())).labels)


def test_run_lengths_along_the_rows(plant: Path) -> None:
    size = [HEIGHT, WIDTH]
    assert same(plant, coco(plant, lambda mask: {"size": size, "counts": runs(mask.T.ravel())}))
    with pytest.raises(InputError, match="its run lengths go along the rows, expected down the columns"):
        same(plant, coco(plant, lambda mask: {"size": size, "counts": runs(mask.ravel())}))


def test_corners_of_larger_photos_and_polygons_of_two_points(plant: Path) -> None:
    def square(mask: np.ndarray, factor: float = 1.0) -> list[list[float]]:
        (y1, y2), (x1, x2) = (np.flatnonzero(mask.any(axis))[[0, -1]] * factor for axis in (1, 0))
        return [[float(each) for each in (x1, y1, x2, y1, x2, y2, x1, y2)]]

    with pytest.raises(InputError, match=r"corners lie up to .* from the photo's corner: were they drawn on larger"):
        same(plant, coco(plant, lambda mask: square(mask, 2)))
    path = coco(plant, square)
    content = json.loads(path.read_text())
    content["annotations"].append(content["annotations"][0] | {"id": 99, "segmentation": [[1, 2, 3, 4]]})
    path.write_text(json.dumps(content))
    with warns_of("masks_without_pixels"):
        assert len(load_masks(load_scene(plant), path)) == 12
    content["annotations"] = [{"id": 1, "image_id": 0, "segments_info": [{"id": 7}]}]
    path.write_text(json.dumps(content))
    with pytest.raises(InputError, match="is COCO's panoptic JSON, expected the folder of its PNGs"):
        load_masks(load_scene(plant), path)


@pytest.mark.parametrize("is_palette", [False, True])
def test_255_as_the_background(plant: Path, is_palette: bool) -> None:
    def write(path: Path, numbers: np.ndarray) -> None:
        image = Image.fromarray(numbers.astype(np.uint8))
        if is_palette:
            image = image.convert("P")
            image.putpalette(np.arange(256).repeat(3).tolist())
        image.save(path.with_suffix(".png"))

    with pytest.raises(InputError, match="is 255 the background, and 0 a leaf"):
        same(plant, write_each(plant, lambda path, labels: write(path, labels.astype(int) - 1 & 255)))


def test_palettes_that_were_ordered_anew_and_255_around_leaves_from_1_on(plant: Path) -> None:
    assert same(plant, write_each(plant, write_palette))
    masks = write_each(plant, lambda path, labels: Image.fromarray(  # type: ignore[arg-type,return-value]
        np.where(labels == 0, 255, labels).astype(np.uint8)).save(path.with_suffix(".png")))  # fmt: skip
    assert same(plant, masks)


def test_the_number_of_the_plant_as_group(plant: Path) -> None:
    with pytest.raises(InputError, match="24 shapes are parts of 4 leaves by their group_id: is it the number of the"):
        same(plant, write_each(plant, write_labelme))


def test_other_programs_and_numbers_name_the_mend(plant: Path) -> None:
    (plant / "annotations.xml").write_text("<?xml version='1.0'?>\n<annotations></annotations>")
    with pytest.raises(InputError, match=r"annotations.xml: is XML, expected CVAT's export 'COCO 1.0'"):
        load_masks(load_scene(plant), plant / "annotations.xml")
    (plant / "cam.yaml").write_text(
        "cam0: {camera_model: pinhole, distortion_coeffs: [0, 0, 0, 0], intrinsics: [1, 1, 1, 1]}"
    )
    with pytest.raises(InputError, match="is Kalibr's, of cam0; expected one camera a file, in OpenCV's form: camera_"):
        read_calibration(plant, "cam.yaml")
    (plant / "four.yaml").write_text(
        "camera_matrix: [9, 0, 4, 0, 9, 3, 0, 0, 1]\ndistortion_coefficients: [0.1, 0, 0, 0]\n"
    )
    with pytest.raises(InputError, match="has 4 distortion coefficients without a model: k1, k2, p1, p2"):
        read_calibration(plant, "four.yaml")
    assert _with_words({"learn": False, "report": False, "traits": {"stems": False, "leaves_only": False}}) == {
        "learn": "off", "report": False, "traits": {"stems": "off", "leaves_only": False}
    }  # fmt: skip
    hints = [each for config in (RunConfig, DetectConfig, TraitsConfig) for each in get_type_hints(config).items()]
    assert {name for name, hint in hints if "'off'" in str(hint)} == set(CAN_BE_OFF)


def transforms(folder: Path, top: dict[str, Any], frame: dict[str, Any]) -> Path:
    (folder / "a.png").parent.mkdir(exist_ok=True)
    Image.new("RGB", (200, 120)).save(folder / "a.png")
    Image.new("RGB", (200, 120)).save(folder / "b.png")
    pose, other, path = np.eye(4), np.eye(4), folder / "transforms.json"
    other[0, 3] = 1.0
    frames = [{"file_path": "a.png", "transform_matrix": pose.tolist()} | frame,
              {"file_path": "b.png", "transform_matrix": other.tolist()}]  # fmt: skip
    path.write_text(json.dumps(top | {"frames": frames}))
    return path


INTRINSICS = {"w": 200, "h": 120, "fl_x": 150.0, "fl_y": 160.0, "cx": 101.0, "cy": 61.0}


def test_nerfstudios_list_of_coefficients_is_the_lens(tmp_path: Path) -> None:
    listed = {"distortion_params": [0.1, 0.02, 0.0, 0.0, 0.001, -0.002]}
    plain = {"k1": 0.1, "k2": 0.02, "p1": 0.001, "p2": -0.002}
    lenses = []
    for top, frame in ((INTRINSICS | listed, {}), (INTRINSICS, listed), (INTRINSICS | plain, {}),
                       (INTRINSICS | {"k1": 0.3}, listed)):  # fmt: skip
        view, _ = read_transforms(transforms(tmp_path, top, frame)).views
        assert view.lens is not None
        lenses.append(list(view.lens.params))
    assert lenses[1:] == lenses[:1] * 3
    for frame, message in (
        ({"distortion_params": [0.1]}, "distortion_params are 1 numbers, expected k1, k2, k3, k4, p1, p2"),
        (listed | {"k1": 0.3}, "k1 is 0.3, and 0.1 in distortion_params"),
        ({"k1": 0.1, "k2": 0.1, "k3": 0.01, "k4": 0.001}, "k3 or k4 without a camera_model: of a fisheye"),
        ({"xi": 1.2}, "'xi' of a.png is 1.2, which is not supported"),
    ):
        with pytest.raises(InputError, match=message):
            read_transforms(transforms(tmp_path, INTRINSICS, frame))
    with warns_of("unknown_key"):
        read_transforms(transforms(tmp_path, INTRINSICS, {"lens_tilt": 3}))


def test_the_angle_of_a_frame_goes_before_the_focal_length_of_the_file(tmp_path: Path) -> None:
    angle = 2 * math.atan(100 / 300.0)
    for frame in ({"camera_angle_x": angle}, {"camera_angle_y": 2 * math.atan(60 / 300.0)}):
        K = read_transforms(transforms(tmp_path, INTRINSICS, frame)).cameras.K[0]
        assert (float(K[0, 0]), float(K[1, 1])) == pytest.approx((300, 300))
    K = read_transforms(transforms(tmp_path, INTRINSICS | {"camera_angle_x": 1.0}, {})).cameras.K[0]
    assert float(K[0, 0]) == 150


def test_letterboxes_are_named_and_taken_out() -> None:
    scene = load_scene(demo_scene())
    truth = load_masks(scene, demo_scene() / "masks")
    height, width = 480, 640
    boxed = []
    for view in range(9):
        labels = truth.label_map(view, truth.labels, (width, height)).numpy().astype(np.uint16)
        square = np.zeros((width, width), np.uint16)
        square[(width - height) // 2 : (width + height) // 2] = labels
        boxed.append(np.asarray(Image.fromarray(square).resize((width, height), Image.Resampling.NEAREST)))
    regions = regions_from_label_maps(boxed)
    (finding,) = low_fit_findings(regions, scene.cameras, pairwise_agreement(regions, scene.cameras))
    assert finding.code == "letterboxed_masks"
    back = take_out_of_square(regions, scene.cameras)
    areas = {(int(v), int(n)): int(a) for v, n, a in zip(truth.view_index, truth.labels, truth.areas, strict=True)}
    again = [areas[int(v), int(n)] for v, n in zip(back.view_index, back.labels, strict=True)]
    assert np.median(np.abs(back.areas.numpy() / again - 1)) < 0.03
    assert not low_fit_findings(truth, scene.cameras, pairwise_agreement(truth, scene.cameras))
    twice = transpose(transpose(regions, scene.cameras), scene.cameras)
    assert torch.equal(twice.crops, regions.crops)


def test_tiffs_of_64_bits(plant: Path) -> None:
    masks = write_each(
        plant, lambda path, labels: Image.fromarray(labels.astype(np.uint16)).save(path.with_suffix(".tif"))
    )  # type: ignore[arg-type,return-value]
    for path in masks.iterdir():
        data = bytearray(path.read_bytes())
        start = struct.unpack_from("<I", data, 4)[0]
        for entry in range(struct.unpack_from("<H", data, start)[0]):
            place = start + 2 + 12 * entry
            if struct.unpack_from("<H", data, place)[0] == 258:  # bits per sample
                struct.pack_into("<H", data, place + 8, 64)
        path.write_bytes(data)
    with pytest.raises(InputError, match=r"it is a TIFF of numbers of 64 bits, .* labels.astype\('uint16'\)"):
        same(plant, masks)
