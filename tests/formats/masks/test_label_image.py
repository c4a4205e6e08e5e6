"""Label images in numbers, palettes and colours."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from mvseg.errors import InputError
from mvseg.formats.label_png import ignore_border, read_label_image, read_label_png, read_mask_images
from mvseg.regions import IGNORE_LABEL


def voc_colours() -> np.ndarray:
    """(256, 3): the map of PASCAL VOC's development kit: bits of the index, spread over the channels."""
    colours = np.zeros((256, 3), np.uint8)
    for index in range(256):
        for bit in range(8):
            colours[index, bit % 3] |= ((index >> bit) & 1) << (7 - bit // 3)
    return colours


@pytest.fixture
def labels() -> np.ndarray:
    labels = np.zeros((20, 30), np.uint8)
    labels[2:9, 3:12], labels[10:18, 5:20], labels[10:18, 21:28] = 1, 2, 7
    labels[1, 3:12] = 255
    return labels


def test_the_border_of_voc_is_ignored(labels: np.ndarray, tmp_path: Path) -> None:
    image = Image.fromarray(labels)
    image.putpalette(voc_colours().ravel().tolist())
    image.save(tmp_path / "palette.png")
    expected = np.where(labels == 255, IGNORE_LABEL, labels.astype(np.int64))
    np.testing.assert_array_equal(read_label_image(tmp_path / "palette.png", 30, 20), expected)
    np.testing.assert_array_equal(read_label_png(tmp_path / "palette.png", 30, 20), expected)


def test_colours_of_voc(labels: np.ndarray, tmp_path: Path) -> None:
    """As datumaro (CVAT) writes SegmentationObject: the colours, without a palette."""
    assert voc_colours()[[1, 2, 255]].tolist() == [[128, 0, 0], [0, 128, 0], [224, 224, 192]]
    Image.fromarray(voc_colours()[labels]).save(tmp_path / "colours.png")
    found = read_label_image(tmp_path / "colours.png", 30, 20)
    assert sorted(np.unique(found).tolist()) == [0, 1, 2, 3, IGNORE_LABEL]
    for number in (1, 2, 7, 255):
        assert len(np.unique(found[labels == number])) == 1
    np.testing.assert_array_equal(found == 0, labels == 0)
    np.testing.assert_array_equal(found == IGNORE_LABEL, labels == 255)


def test_a_palette_of_0_and_255_only_is_kept(tmp_path: Path) -> None:
    image = Image.fromarray(np.array([[0, 255], [255, 0]], np.uint8))
    image.putpalette(voc_colours().ravel().tolist())
    image.save(tmp_path / "two.png")
    assert read_label_png(tmp_path / "two.png", 2, 2).tolist() == [[0, 255], [255, 0]]


@pytest.mark.parametrize("is_border", [True, False])
def test_255_is_a_border_where_it_surrounds_the_others(is_border: bool) -> None:
    """VOC's, in a grey PNG; and a leaf that happens to have this number and touches another one."""
    labels = np.zeros((40, 60), np.uint16)
    if is_border:
        labels[3:27, 3:37] = 255
    else:
        labels[20:30, 10:20] = 255
    labels[8:22, 8:20], labels[8:22, 20:32] = 4, 7
    before = labels.copy()
    assert ignore_border(labels) == is_border
    np.testing.assert_array_equal(labels, np.where(before == 255, 65535, before) if is_border else before)


def test_what_is_transparent_is_nothing_and_large_numbers_are_renumbered(tmp_path: Path) -> None:
    pixels = np.zeros((2, 3, 4), np.uint8)
    pixels[..., 0], pixels[:, 1:, 3] = 200, 255
    Image.fromarray(pixels).save(tmp_path / "cut.png")
    assert read_label_image(tmp_path / "cut.png", 3, 2).tolist() == [[0, 1, 1]] * 2
    assert read_mask_images([tmp_path / "cut.png"], 3, 2)[0].mask.tolist() == [[False, True, True]] * 2
    Image.fromarray(np.array([[0, 70000], [70000, 2**31 - 1]], np.int32)).save(tmp_path / "ids.tif")
    assert read_label_image(tmp_path / "ids.tif", 2, 2).tolist() == [[0, 1], [1, 2]]


def test_no_labels(tmp_path: Path) -> None:
    noise = np.random.default_rng(0).integers(0, 255, (60, 80, 3), dtype=np.uint8)
    Image.fromarray(noise).save(tmp_path / "photo.png")
    with pytest.raises(InputError, match=r"photo.png: holds \d+ colours, expected one per mask and at most 1000"):
        read_label_image(tmp_path / "photo.png", 80, 60)
    Image.fromarray(np.array([[0.5]], np.float32)).save(tmp_path / "half.tif")
    Image.fromarray(np.array([[-1]], np.int32)).save(tmp_path / "minus.tif")
    Image.fromarray(np.array([[np.nan]], np.float32)).save(tmp_path / "nan.tif")
    for name in ("half", "minus", "nan"):
        with pytest.raises(InputError, match=rf"{name}.tif: holds numbers that are no labels, expected whole numbers"):
            read_label_image(tmp_path / f"{name}.tif", 1, 1)
    pages = [Image.new("L", (3, 3)) for _ in range(4)]
    pages[0].save(tmp_path / "pages.tif", save_all=True, append_images=pages[1:])
    with pytest.raises(InputError, match=r"pages.tif: holds 4 pages, expected one label image: number its masks"):
        read_label_image(tmp_path / "pages.tif", 3, 3)
    first = bytearray((tmp_path / "half.tif").read_bytes())
    at = int.from_bytes(first[4:8], "little")
    at += 2 + 12 * int.from_bytes(first[at : at + 2], "little")  # where the place of the second page stands
    first[at : at + 4] = len(first).to_bytes(4, "little")
    (tmp_path / "next.tif").write_bytes(first + b"\1\0" + bytes(16))  # a page without a size
    with pytest.raises(InputError, match=r"next.tif: cannot be read, .* its list of pages is damaged"):
        read_label_image(tmp_path / "next.tif", 1, 1)
    with pytest.raises(InputError, match=r"half.tif: the mask is 1 x 1, its camera says 2 x 1"):
        read_label_image(tmp_path / "half.tif", 2, 1)
    with pytest.raises(InputError, match=r"absent.png: the mask file is missing"):
        read_label_image(tmp_path / "absent.png", 2, 1)
    with pytest.raises(InputError, match=r"half.tif: the mask is 1 x 1, its camera says 2 x 1"):
        read_mask_images([tmp_path / "half.tif"], 2, 1)
