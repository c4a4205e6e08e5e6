"""COCO masks against pycocotools, there and back, and every way to get them wrong."""

from __future__ import annotations

import json
import tracemalloc
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from pycocotools import mask as coco_mask
from pycocotools.coco import COCO

from mvseg.errors import InputError
from mvseg.formats.coco import read_coco, write_coco
from mvseg.formats.masks.view_regions import stack_views
from mvseg.formats.run_lengths import decode_rle, encode_mask
from mvseg.formats.scene_folder import load_masks
from mvseg.scene import Cameras, Scene, View
from warned import warns_of

pytestmark = pytest.mark.filterwarnings("ignore:__array__ implementation:DeprecationWarning")  # in pycocotools
WIDTH, HEIGHT = 60, 40
POLYGON = [5.0, 5.0, 50.0, 8.0, 40.0, 35.0, 12.0, 30.0]
OTHER = [2.0, 30.0, 10.0, 30.0, 10.0, 38.0]


def make_scene(*files: str) -> Scene:
    eye = torch.eye(3).expand(len(files), 3, 3)
    sizes = torch.tensor([[WIDTH, HEIGHT]] * len(files))
    cameras = Cameras(K=eye, R=eye, t=torch.zeros(len(files), 3), sizes=sizes)
    names = [file.removeprefix("images/").rsplit(".", 1)[0] for file in files]
    return Scene("plant", tuple(map(View, names, [Path("plant") / file for file in files])), cameras)


@pytest.fixture
def scene() -> Scene:
    return make_scene("images/a.jpg", "images/b.jpg")


def random_mask(seed: int, height: int = HEIGHT, width: int = WIDTH) -> np.ndarray:
    noise = np.random.default_rng(seed).normal(size=(height, width))
    return cv2.GaussianBlur(noise, (0, 0), 2) > 0.05


def uncompressed(mask: np.ndarray) -> dict[str, Any]:
    """COCO's uncompressed RLE, counted here pixel by pixel down the columns."""
    counts, value = [0], False
    for pixel in mask.T.ravel().tolist():
        if pixel != value:
            counts.append(0)
            value = pixel
        counts[-1] += 1
    return {"size": list(mask.shape), "counts": counts}


def write(folder: Path, annotations: list[dict[str, Any]], files: tuple[str, ...] = ("a.jpg", "b.jpg")) -> Path:
    images = [
        {"id": 10 + index, "file_name": file, "width": WIDTH, "height": HEIGHT} for index, file in enumerate(files)
    ]
    whole = [{"id": 1 + index, "image_id": 10, "category_id": 1} | one for index, one in enumerate(annotations)]
    path = folder / "masks.json"
    path.write_text(json.dumps({"images": images, "annotations": whole, "categories": []}))
    return path


def read_all(path: Path, scene: Scene, **options: Any) -> list[list[tuple[int, np.ndarray]]]:
    return [list(view) for view in read_coco(path, scene, **options)]


def read_one(folder: Path, scene: Scene, segmentation: Any) -> np.ndarray:
    ((_, mask),), _ = read_all(write(folder, [{"segmentation": segmentation}]), scene)
    return mask


@pytest.mark.parametrize(
    "mask", [random_mask(0), random_mask(1, 1, 300), np.zeros((5, 7), bool), np.ones((5, 7), bool)]
)
def test_run_lengths_decode_as_in_pycocotools(mask: np.ndarray) -> None:
    height, width = mask.shape
    rle = encode_mask(mask)
    np.testing.assert_array_equal(coco_mask.decode(rle), mask)
    np.testing.assert_array_equal(decode_rle(rle["counts"], width, height), mask)
    np.testing.assert_array_equal(decode_rle(uncompressed(mask)["counts"], width, height), mask)
    oracle = coco_mask.decode(coco_mask.frPyObjects(uncompressed(mask), height, width))
    np.testing.assert_array_equal(oracle, mask)


def test_all_three_encodings_give_one_mask(scene: Scene, tmp_path: Path) -> None:
    polygons = [POLYGON, OTHER]
    expected = coco_mask.decode(coco_mask.merge(coco_mask.frPyObjects(polygons, HEIGHT, WIDTH))).astype(bool)
    assert expected.sum() > 500
    for segmentation in (polygons, encode_mask(expected), uncompressed(expected)):
        mask = read_one(tmp_path, scene, segmentation)
        assert mask.dtype == bool
        np.testing.assert_array_equal(mask, expected)


def test_files_of_via(scene: Scene, tmp_path: Path) -> None:
    """VIA writes so, with the image's id as text."""
    expected = read_one(tmp_path, scene, [POLYGON])
    np.testing.assert_array_equal(read_one(tmp_path, scene, POLYGON), expected)
    path = write(tmp_path, [{"segmentation": POLYGON, "image_id": "10"}])
    np.testing.assert_array_equal(read_all(path, scene)[0][0][1], expected)
    assert not read_one(tmp_path, scene, POLYGON[:4]).any()  # a line
    (tmp_path / "via.json").write_text(json.dumps({"a.jpg9": {"filename": "a.jpg", "size": 9, "regions": []}}))
    with pytest.raises(InputError, match=r"via.json: images: Field required, expected COCO"):
        read_coco(tmp_path / "via.json", scene)


def test_annotations_go_to_their_views(scene: Scene, tmp_path: Path) -> None:
    rles = [encode_mask(random_mask(seed)) for seed in range(4)]
    annotations: list[dict[str, Any]] = [
        {"segmentation": rles[0], "image_id": 11},
        {"segmentation": rles[1], "image_id": 10},
        {"segmentation": rles[2], "image_id": 11},
        {"segmentation": rles[3], "image_id": 12},
    ]
    first, second = read_all(write(tmp_path, annotations, ("a.jpg", "b.jpg", "elsewhere.jpg")), scene)
    assert [number for number, _ in first] == [2]
    assert [number for number, _ in second] == [1, 3]
    np.testing.assert_array_equal(second[0][1], random_mask(0))


def test_crowds_are_masks_unless_told_otherwise(scene: Scene, tmp_path: Path) -> None:
    """supervision and datumaro mark masks with holes, or all of them, as crowds."""
    annotations = [{"segmentation": encode_mask(random_mask(seed)), "iscrowd": seed % 2} for seed in range(3)]
    path = write(tmp_path, annotations)
    with warns_of("crowds_taken"):
        assert [number for number, _ in read_all(path, scene)[0]] == [1, 2, 3]
    with warns_of("crowds_ignored"):
        assert [number for number, _ in read_all(path, scene, crowd="ignore")[0]] == [1, 3]


def test_masks_of_many_photos_are_never_in_memory_together(tmp_path: Path) -> None:
    scene = make_scene(*[f"images/{view}.jpg" for view in range(8)])
    side, per_view = 1000, 6
    scene = Scene("plant", scene.views, replace(scene.cameras, sizes=torch.tensor([[side, side]] * len(scene.views))))
    masks = np.zeros((per_view, side, side), bool)
    for number, mask in enumerate(masks):
        mask[400 + 60 * number : 450 + 60 * number, 300:350] = True
    images = [{"id": view, "file_name": f"{view}.jpg", "width": side, "height": side} for view in range(8)]
    rles = [encode_mask(mask) for mask in masks]
    annotations = [{"image_id": view, "segmentation": rle} for view in range(8) for rle in rles]
    path = tmp_path / "masks.json"
    path.write_text(json.dumps({"images": images, "annotations": annotations}))
    tracemalloc.start()
    regions = stack_views(read_coco(path, scene), scene, source=path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert regions.num_per_view.tolist() == [per_view] * 8
    assert regions.areas.tolist() == [2500] * 8 * per_view
    assert peak < per_view * side**2  # bytes: less than the masks of one photo


NEITHER = "its segmentation is neither polygons of finite numbers nor run lengths"
BAD: list[tuple[Any, str]] = [
    ({"size": [HEIGHT, WIDTH], "counts": encode_mask(random_mask(0))["counts"][:-9]}, "do not add up to 60 x 40"),
    ({"size": [HEIGHT, WIDTH], "counts": ""}, "do not add up to 60 x 40"),
    ({"size": [HEIGHT, WIDTH], "counts": "ü~"}, "do not add up to 60 x 40"),
    ({"size": [HEIGHT, WIDTH], "counts": [100, 100]}, "do not add up to 60 x 40"),
    ({"size": [WIDTH, HEIGHT], "counts": [0, WIDTH * HEIGHT]}, "its mask is 40 x 60, expected 60 x 40"),
    ({"size": [10**9, 10**9], "counts": "PPYo1"}, "its mask is 1000000000 x 1000000000"),
    ([[*POLYGON, 3.0]], "expected polygons"),
    ([[1.0, 2.0, 1e12, 4.0, 5.0, 6.0]], "reaches far out of the image"),
    ([[-500.0, 0.0, 560.0, 40.0] * 3000], "polygons are 6[0-9]* pixels long, more than any outline in the image"),
    ({"size": [HEIGHT, WIDTH], "counts": "o" * 100_000 + "1"}, "are not a string that COCO writes"),
    ({"size": [HEIGHT, WIDTH], "counts": [-5, WIDTH * HEIGHT + 5]}, NEITHER),
    ({"counts": [WIDTH * HEIGHT]}, NEITHER),
    ([[1.0, 2.0, float("nan"), 4.0, 5.0, 6.0]], NEITHER),
    ([[1.0, 2.0, 10**400, 4.0, 5.0, 6.0]], NEITHER),
    ("circle", NEITHER),
]


@pytest.mark.parametrize(("segmentation", "message"), BAD)
def test_broken_masks_are_named(segmentation: Any, message: str, scene: Scene, tmp_path: Path) -> None:
    path = write(tmp_path, [{"segmentation": [POLYGON]}, {"segmentation": segmentation}])
    with pytest.raises(InputError, match=rf"masks.json: annotation 2: .*{message}"):
        read_all(path, scene)


def test_views_that_the_file_does_not_list_are_empty_and_named(scene: Scene, tmp_path: Path) -> None:
    with warns_of("images_missing"):
        masks = read_all(write(tmp_path, [{"segmentation": [POLYGON]}], ("a.jpg", "c.jpg")), scene)
    assert [len(view) for view in masks] == [1, 0]
    files = ("c.jpg", "d.jpg", "e.jpg", "f.jpg", "g.jpg")
    message = r"none of its images is a photo of the scene, expected a.jpg, b.jpg, found c.jpg, d.jpg, e.jpg and 2 more"
    with pytest.raises(InputError, match=message):
        read_all(write(tmp_path, [], files), scene)


def test_boxes_without_masks_are_counted(scene: Scene, tmp_path: Path) -> None:
    box = {"bbox": [1, 2, 3, 4]}
    annotations = [box, {"segmentation": [POLYGON]}, box | {"segmentation": []}, box | {"segmentation": [[]]}]
    with warns_of("annotations_without_mask"):
        assert [number for number, _ in read_all(write(tmp_path, annotations), scene)[0]] == [2]


def test_ids_may_be_text_or_missing(scene: Scene, tmp_path: Path) -> None:
    path = write(tmp_path, [{"segmentation": [POLYGON], "id": "x"}, {"segmentation": [OTHER]}])
    assert [number for number, _ in read_all(path, scene)[0]] == [1, 2]
    content = json.loads(path.read_text())
    content["images"][0]["id"] = "10"  # and its annotations say 10
    for annotation in content["annotations"]:
        del annotation["id"]
    path.write_text(json.dumps(content))
    assert [number for number, _ in read_all(path, scene)[0]] == [1, 2]
    content["annotations"][1]["segmentation"] = [[1.0]]
    path.write_text(json.dumps(content))
    with pytest.raises(InputError, match="annotation 2: its segmentation is not"):
        read_all(path, scene)
    content["images"][1]["id"] = 10
    path.write_text(json.dumps(content))
    with pytest.raises(InputError, match="2 images have 1 ids, expected one each"):
        read_all(path, scene)


def test_lists_of_results(tmp_path: Path) -> None:
    scene = make_scene("images/000.jpg", "images/017.jpg")
    rles = [encode_mask(random_mask(seed)) for seed in range(2)]
    path = tmp_path / "results.json"

    def write_results(*ids: int | str) -> None:
        pairs = zip(ids, rles, strict=True)
        path.write_text(json.dumps([{"image_id": each, "category_id": 1, "segmentation": rle} for each, rle in pairs]))

    for ids in ((17, 0), ("017", "000"), ("017.jpg", "000.jpg")):
        write_results(*ids)
        with warns_of(*(["ids_taken_for_numbers"] if ids[0] == 17 else [])):
            first, second = read_all(path, scene)
        assert [number for number, _ in [*first, *second]] == [2, 1]
        np.testing.assert_array_equal(second[0][1], random_mask(0))
    with pytest.raises(InputError, match=r"none of its images .*, expected a.jpg, b.jpg, found 017.jpg, 000.jpg"):
        read_all(path, make_scene("images/a.jpg", "images/b.jpg"))
    write_results(17, 3)  # of a data set that counts its images
    with pytest.raises(InputError, match=r"image_id 17 is the number of a photo, 3 is none: .* put the JSON of its"):
        read_all(path, scene)
    images = [{"id": 3, "file_name": "017.jpg", "width": 60, "height": 40}]
    images += [{"id": 17, "file_name": "000.jpg", "width": 60, "height": 40}]
    listed = {"images": images, "annotations": [], "categories": [{"id": 1, "name": "leaf"}]}
    (tmp_path / "instances.json").write_text(json.dumps(listed))
    (first,), (second,) = read_all(path, scene, categories=["leaf"])
    np.testing.assert_array_equal(first[1], random_mask(0))
    np.testing.assert_array_equal(second[1], random_mask(1))


def test_what_stands_twice(scene: Scene, tmp_path: Path) -> None:
    path = write(tmp_path, [{"segmentation": each} for each in ([POLYGON], [OTHER], [POLYGON])])
    with warns_of("copies"):
        assert load_masks(scene, path).labels.tolist() == [1, 2]
    write(tmp_path, [{"segmentation": [POLYGON], "image_id": each} for each in (10, 12)], ("a.jpg", "b.jpg", "a.jpg"))
    with pytest.raises(InputError, match=r"images 10 \(a.jpg\) and 12 \(a.jpg\) are of one photo, and both have annot"):
        read_all(path, scene)


def test_what_nearly_stands_twice_and_what_stands_in_each_other(scene: Scene, tmp_path: Path) -> None:
    moved = [[x + 0.4 for x in POLYGON]]
    path = write(tmp_path, [{"segmentation": each} for each in ([POLYGON], [OTHER], moved)])
    with warns_of("copies") as noticed:
        regions = load_masks(scene, path)
    assert regions.labels.tolist() == [1, 2]
    assert "masks_inside_masks" not in [each.code for each in noticed]
    part = [10.0, 10.0, 14.0, 10.0, 14.0, 14.0]
    whole = [1.0, 1.0, 40.0, 1.0, 40.0, 39.0, 1.0, 39.0]
    path = write(tmp_path, [{"segmentation": [each]} for each in (whole, part)])
    with warns_of("masks_inside_masks") as noticed:
        assert load_masks(scene, path).labels.tolist() == [1, 2]
    (inside,) = [each for each in noticed if each.code == "masks_inside_masks"]
    assert (inside.views, inside.values["count"]) == ((0,), 1)


def test_masks_that_read_as_nothing_are_refused(scene: Scene, tmp_path: Path) -> None:
    """Some of them are shares of the size that happen to fill a pixel."""
    shares = [[[0.1, 0.2, 0.9, 0.2, 0.5, 0.9]], [[0.0, 0.0, 1.0, 0.0, 1.0, 1.0]]]
    with pytest.raises(InputError, match=r"masks.json: all corners lie between 0 and 1: are they shares"):
        read_all(write(tmp_path, [{"segmentation": each} for each in shares]), scene)
    assert len(read_all(write(tmp_path, [{"segmentation": each} for each in (shares[1], [POLYGON])]), scene)[0]) == 2
    with pytest.raises(InputError, match=r"masks.json: 2 annotations have no mask \(a box at most\), and no others"):
        read_all(write(tmp_path, [{"bbox": [1, 2, 3, 4]}] * 2), scene)
    far = [[100.0, 100, 120, 100, 110, 120]]  # outside of the photo
    with pytest.raises(InputError, match=r"masks.json: 1 masks show no pixel .*, and no others are there"):
        load_masks(scene, write(tmp_path, [{"segmentation": far}]))


def test_categories_are_selected_or_named(scene: Scene, tmp_path: Path) -> None:
    path = write(tmp_path, [{"segmentation": [POLYGON], "category_id": number} for number in (1, 2, 1, 9)])
    content = json.loads(path.read_text())
    content["categories"] = [{"id": 1, "name": "leaf"}, {"id": 2, "name": "pot"}, {"id": 3, "name": "stem"}]
    path.write_text(json.dumps(content))
    with warns_of("several_categories"):
        assert len(read_all(path, scene)[0]) == 4
    for wanted, numbers in ((["leaf"], [1, 3]), (["pot", "9"], [2, 4])):
        assert [number for number, _ in read_all(path, scene, categories=wanted)[0]] == numbers
    with warns_of("no_mask_of_category"):
        assert read_all(path, scene, categories=["stem"]) == [[], []]
    with pytest.raises(InputError, match=r"there is no category 'leaves', expected of these: leaf, pot, stem, 9"):
        read_all(path, scene, categories=["leaves"])


def test_other_image_size(scene: Scene, tmp_path: Path) -> None:
    path = write(tmp_path, [])
    path.write_text(path.read_text().replace(f'"width": {WIDTH}', '"width": 61'))
    with pytest.raises(InputError, match=r"masks.json: image a.jpg is 61 x 40, its camera says 60 x 40"):
        read_all(path, scene)
    unknown = path.read_text().replace('"width": 61', '"width": 0').replace(f'"height": {HEIGHT}', '"height": 0')
    path.write_text(unknown)
    assert read_all(path, scene) == [[], []]


def test_written_file_reads_back_here_and_in_pycocotools(
    scene: Scene, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    masks, size = [random_mask(seed) for seed in range(3)], {"width": WIDTH, "height": HEIGHT}
    images = [{"id": number, "file_name": f"{name}.jpg"} | size for number, name in ((1, "a"), (2, "b"))]
    annotations = [
        {"image_id": 1 + number % 2, "instance_id": number, "segmentation": encode_mask(mask)}
        for number, mask in enumerate(masks)
    ]
    write_coco(tmp_path / "out.json", images, annotations)
    first, second = read_all(tmp_path / "out.json", scene)
    np.testing.assert_array_equal([mask for _, mask in first], [masks[0], masks[2]])
    np.testing.assert_array_equal(second[0][1], masks[1])
    coco = COCO(tmp_path / "out.json")
    capsys.readouterr()  # pycocotools prints its progress
    for number, one in enumerate(coco.loadAnns(coco.getAnnIds())):
        np.testing.assert_array_equal(coco.annToMask(one), masks[number])
        rows, columns = masks[number].nonzero()
        assert one["area"] == masks[number].sum()
        left, top, width, height = one["bbox"]
        assert [left, left + width, top, top + height] == [min(columns), max(columns) + 1, min(rows), max(rows) + 1]
        assert (one["instance_id"], one["category_id"], one["iscrowd"]) == (number, 1, 0)


def test_annotations_of_no_image_are_counted(scene: Scene, tmp_path: Path) -> None:
    segmentation = uncompressed(random_mask(0))
    path = write(tmp_path, [{"segmentation": segmentation}, {"segmentation": segmentation, "image_id": 99}])
    with warns_of("orphans"):
        masks = read_all(path, scene)
    assert [len(view) for view in masks] == [1, 0]
