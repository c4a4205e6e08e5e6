"""Masks of every kind, written from the same labels, give the same regions; and the kind is told by the files."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from PIL import Image

from mvseg.errors import InputError, InputWarning
from mvseg.formats.label_png import read_label_png
from mvseg.formats.masks.recognise import recognise_masks
from mvseg.formats.run_lengths import encode_mask
from mvseg.formats.scene_folder import load_masks, load_scene
from mvseg.regions import Regions
from mvseg.scene import Scene
from scene_folders import HEIGHT, WIDTH, edit_rig, write_image, write_scene
from warned import warns_of

Write = Callable[[Path, np.ndarray], None]  # the path without suffix, the labels
PALETTE = [value for color in range(256) for value in (color * 37 % 256, color * 91 % 256, color)]


def outlines(mask: np.ndarray) -> list[list[float]]:
    """Polygons around the pixels of a mask: the outline of a mask twelve times as large lies on its border."""
    large = np.kron(mask.astype(np.uint8), np.ones((12, 12), np.uint8))
    found, _ = cv2.findContours(large, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    return [((each[:, 0] + 0.5) / 12).ravel().tolist() for each in found]


def masks_of(labels: np.ndarray) -> list[np.ndarray]:
    return [labels == number for number in np.unique(labels)[1:]]


def palette_png(path: Path, labels: np.ndarray) -> None:
    image = Image.fromarray(labels.astype(np.uint8))
    image.putpalette(PALETTE)
    image.save(f"{path}.png")


def colour_png(path: Path, labels: np.ndarray) -> None:
    colours = np.array(PALETTE, np.uint8).reshape(256, 3)
    colours[0] = 0
    write_image(Path(f"{path}.png"), colours[labels])


def deep_colour_png(path: Path, labels: np.ndarray) -> None:
    """Numbers in the lower half of each channel, which 8 bits do not show."""
    write_image(Path(f"{path}.png"), np.dstack((labels * 3, labels + 1, labels * 2)) * (labels > 0)[..., None])


def labelme(path: Path, labels: np.ndarray) -> None:
    shapes = [
        {"label": "leaf", "points": np.reshape(outlines(mask)[0], (-1, 2)).tolist(), "shape_type": "polygon"}
        for mask in masks_of(labels)
    ]
    content = {"version": "5.5.0", "flags": {}, "shapes": shapes, "imageHeight": HEIGHT, "imageWidth": WIDTH}
    Path(f"{path}.json").write_text(json.dumps(content))


def yolo(path: Path, labels: np.ndarray) -> None:
    lines = []
    for mask in masks_of(labels):
        corners = np.reshape(outlines(mask)[0], (-1, 2)) / (WIDTH, HEIGHT)
        lines.append(" ".join(["0", *map("{:.6f}".format, corners.ravel())]))
    Path(f"{path}.txt").write_text("\n".join(lines) + "\n")


def sam(path: Path, labels: np.ndarray) -> None:
    Path(f"{path}.json").write_text(json.dumps([{"segmentation": encode_mask(mask)} for mask in masks_of(labels)]))


def sa_1b(path: Path, labels: np.ndarray) -> None:
    entries = [{"segmentation": encode_mask(mask), "id": 5} for mask in masks_of(labels)]
    image = {"image_id": 1, "width": WIDTH, "height": HEIGHT, "file_name": f"{path.name}.jpg"}
    Path(f"{path}.json").write_text(json.dumps({"image": image, "annotations": entries}))


def one_image_each(path: Path, labels: np.ndarray) -> None:
    for number, mask in enumerate(masks_of(labels)):
        write_image(path / f"{number}.png", mask.astype(np.uint8) * 255)
    (path / "metadata.csv").write_text("id,area\n")  # SAM's script writes one


def bop(path: Path, labels: np.ndarray) -> None:
    for number, mask in enumerate(masks_of(labels)):
        write_image(path.with_name(f"{path.name}_{number:06d}.png"), mask.astype(np.uint8) * 255)


KINDS: dict[str, tuple[Write, str]] = {
    "palette": (palette_png, "label images"),
    "colours": (colour_png, "label images"),
    "colours of 16 bits": (deep_colour_png, "label images"),
    "grey in colours": (lambda p, a: write_image(Path(f"{p}.png"), np.dstack([a] * 3).astype("u1")), "label images"),
    "TIFF": (lambda p, a: Image.fromarray(a).save(f"{p}.tif"), "label images"),
    "TIFF of 32 bits": (lambda p, a: Image.fromarray(a.astype(np.int32)).save(f"{p}.tiff"), "label images"),
    "TIFF of floats": (lambda p, a: Image.fromarray(a.astype(np.float32)).save(f"{p}.TIF"), "label images"),
    "cellpose PNG": (lambda p, a: write_image(Path(f"{p}_cp_masks.png"), a), "label images"),
    "npy": (lambda p, a: np.save(f"{p}.npy", a.astype(np.int32)), "NumPy arrays"),
    "npy stack": (lambda p, a: np.save(f"{p}.npy", np.stack(masks_of(a))), "NumPy arrays"),
    "labelme": (labelme, "labelme"),
    "YOLO": (yolo, "YOLO"),
    "SAM": (sam, "SAM"),
    "SA-1B": (sa_1b, "SAM"),
    "one image each": (one_image_each, "one image per mask"),
    "BOP": (bop, "one image per mask"),
}  # fmt: skip


def write_masks(folder: Path, write: Write) -> Path:
    (folder / "other").mkdir()
    for view in range(4):
        write(folder / "other" / f"{view:03d}", read_label_png(folder / "masks" / f"{view:03d}.png", WIDTH, HEIGHT))
    return folder / "other"


def assert_same_masks(first: Regions, second: Regions) -> None:
    assert torch.equal(first.view_index, second.view_index)
    assert torch.equal(first.boxes, second.boxes)
    assert torch.equal(first.crops, second.crops)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return write_scene(tmp_path / "plant")


@pytest.mark.parametrize("name", KINDS)
def test_every_kind_gives_the_same_regions(name: str, folder: Path) -> None:
    write, kind = KINDS[name]
    scene = load_scene(folder)
    masks = write_masks(folder, write)
    assert recognise_masks(scene, masks).kind == kind
    assert_same_masks(load_masks(scene, masks), load_masks(scene, folder / "masks"))


@pytest.mark.parametrize("name", ["npy stack", "colours", "labelme", "TIFF"])
def test_every_kind_is_undistorted(name: str, folder: Path) -> None:
    masks = write_masks(folder, KINDS[name][0])
    straight = load_masks(load_scene(folder), masks)
    for view in range(4):
        edit_rig(folder, view, distortion=[-0.8, 0.3, 0.01, -0.01, 0.0])
    bent = load_masks(load_scene(folder), masks)
    assert not torch.equal(bent.boxes, straight.boxes)
    assert_same_masks(bent, load_masks(load_scene(folder), folder / "masks"))


def test_labels_are_the_numbers_of_the_files(folder: Path) -> None:
    scene = load_scene(folder)
    expected = load_masks(scene, folder / "masks").labels
    assert torch.equal(load_masks(scene, write_masks(folder, KINDS["TIFF of 32 bits"][0])).labels, expected)


def test_photos_are_no_masks_where_both_lie_together(folder: Path) -> None:
    scene = load_scene(folder)
    with pytest.raises(InputError, match=r"images: fits no photo of the scene, expected masks named 000.png"):
        load_masks(scene, folder / "images")
    for view in range(4):
        labelme(folder / "images" / f"{view:03d}", read_label_png(folder / "masks" / f"{view:03d}.png", WIDTH, HEIGHT))
    assert_same_masks(load_masks(scene, folder / "images"), load_masks(scene, folder / "masks"))


def test_the_kind_of_most_photos_is_taken_and_others_are_named(folder: Path) -> None:
    scene = load_scene(folder)
    labelme(folder / "masks" / "000", read_label_png(folder / "masks" / "000.png", WIDTH, HEIGHT))
    with warns_of("other_kinds"):
        assert recognise_masks(scene, folder / "masks").kind == "label images"


@pytest.mark.parametrize("place", ["VOC/SegmentationObject", "labels/train"])
def test_masks_in_folders_of_exports(place: str, folder: Path) -> None:
    scene = load_scene(folder)
    (folder / place).parent.mkdir(parents=True)
    (folder / "masks").rename(folder / place)
    if place.startswith("VOC"):
        write_image(folder / "VOC" / "SegmentationClass" / "000.png", np.zeros((HEIGHT, WIDTH), np.uint8))
        assert len(load_masks(scene, folder / "VOC")) == 12
    else:
        with warns_of("base_names"):
            assert len(load_masks(scene, folder / "labels")) == 12


def test_a_folder_with_one_coco_file(folder: Path) -> None:
    scene = load_scene(folder)
    images = [{"id": v, "file_name": f"{v:03d}.png", "width": WIDTH, "height": HEIGHT} for v in range(4)]
    (folder / "export" / "annotations").mkdir(parents=True)
    path = folder / "export" / "annotations" / "instances_default.json"
    path.write_text(json.dumps({"images": images, "annotations": []}))
    assert recognise_masks(scene, folder / "export").files == ((path,),) * 4


def test_photos_without_a_file(folder: Path) -> None:
    scene = load_scene(folder)
    masks = write_masks(folder, yolo)
    (masks / "001.txt").unlink()
    with warns_of("files_missing"):
        assert load_masks(scene, masks).num_per_view.tolist() == [3, 0, 3, 3]
    (folder / "more").mkdir()
    for ending in (".npy", "_seg.npy"):
        np.save(folder / "more" / f"000{ending}", np.zeros((HEIGHT, WIDTH), np.uint8))
    with (
        pytest.warns(InputWarning, match=r"NumPy arrays for 1 photos are taken, and not cellpose for 1"),
        pytest.raises(InputError, match=r"001.npy: the mask file is missing"),
    ):
        load_masks(scene, folder / "more")


def test_jpegs_are_refused_by_name(folder: Path) -> None:
    scene: Scene = load_scene(folder)
    (folder / "other").mkdir()
    Image.new("L", (WIDTH, HEIGHT)).save(folder / "other" / "000.jpg")
    with pytest.raises(InputError, match=r"000.jpg: is a JPEG, which blurs the numbers of masks: export PNG instead"):
        load_masks(scene, folder / "other")
    (folder / "other" / "000.jpg").rename(folder / "other" / "000.png")
    with pytest.raises(InputError, match=r"000.png: is a JPEG, which blurs the numbers of masks: export PNG instead"):
        load_masks(scene, folder / "other")


def test_what_is_there_is_said(folder: Path) -> None:
    scene = load_scene(folder)
    (folder / "other").mkdir()
    with pytest.raises(InputError, match=r"other: fits no photo of the scene, expected .* found nothing"):
        load_masks(scene, folder / "other")
    for name in ("a.png", "b.png", "c.md", "d.md"):
        (folder / "other" / name).touch()
    with pytest.raises(InputError, match=r"found a.png, b.png, c.md and 1 more"):
        load_masks(scene, folder / "other")
    with pytest.raises(InputError, match=r"000.png: not a known kind of masks, expected a folder"):
        load_masks(scene, folder / "masks" / "000.png")


def test_a_photo_that_exif_turns_is_named_where_sizes_differ(folder: Path) -> None:
    edit_rig(folder, 1, file="images/001.jpg")
    exif = Image.Exif()
    exif[0x0112] = 6
    Image.new("RGB", (WIDTH, HEIGHT)).save(folder / "images" / "001.jpg", exif=exif)
    write_image(folder / "masks" / "001.png", np.zeros((WIDTH, HEIGHT), np.uint8))
    with pytest.raises(InputError, match=r"is 96 x 128, its camera says 128 x 96 \(view 1; EXIF turns 001.jpg"):
        load_masks(load_scene(folder), folder / "masks")


def test_masks_without_pixels_are_counted(folder: Path) -> None:
    scene = load_scene(folder)
    masks = write_masks(folder, KINDS["npy stack"][0])
    np.save(masks / "002.npy", np.zeros((5, HEIGHT, WIDTH), bool))
    with warns_of("masks_without_pixels"):
        assert load_masks(scene, masks).num_per_view.tolist() == [3, 3, 0, 3]


OTHER_PROGRAMS = {
    "Darwin (V7)": {"version": "2.0", "item": {"slots": []}, "annotations": [{"slot_names": ["0"], "polygon": {}}]},
    "Segments.ai": {"annotations": [{"id": 1, "category_id": 1}], "segmentation_bitmap": {"url": "x"}},
    "ISAT": {"info": {"description": "ISAT"}, "objects": [{"segmentation": [[1, 2]]}]},
    "Supervisely": {"size": {}, "objects": [{"classTitle": "leaf", "geometryType": "polygon"}]},
}


@pytest.mark.parametrize("program", OTHER_PROGRAMS)
def test_json_of_other_programs_is_refused(program: str, folder: Path) -> None:
    scene = load_scene(folder)
    (folder / "other").mkdir()
    for view in range(4):
        (folder / "other" / f"{view:03d}.png.json").write_text(json.dumps(OTHER_PROGRAMS[program]))
    for masks in (folder / "other", folder / "other" / "000.png.json"):
        with pytest.raises(InputError, match=r"images: .*expected COCO|JSON of another form|4 entries are boxes"):
            load_masks(scene, masks)


def test_entries_that_are_all_boxes_are_no_masks(folder: Path) -> None:
    scene = load_scene(folder)
    masks = write_masks(folder, lambda path, _: Path(f"{path}.json").write_text('[{"bbox": [1, 2, 3, 4]}]'))
    with pytest.raises(InputError, match=r"other: 4 entries are boxes, lines, .*, and none is a mask"):
        load_masks(scene, masks)


def test_the_background_as_a_leaf_is_said_and_label_images_have_no_categories(folder: Path) -> None:
    """`mvseg check` calls it an error."""
    masks = write_masks(folder, lambda path, labels: write_image(Path(f"{path}.png"), labels + 1))
    with warns_of("background_mask"):
        assert len(load_masks(load_scene(folder), masks)) == 16
    with pytest.raises(InputError, match=r"masks: holds label images, which have no categories to select from"):
        load_masks(load_scene(folder), folder / "masks", categories=["leaf"])
