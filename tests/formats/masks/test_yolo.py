"""YOLO's text files, as ultralytics reads and writes them (its source is not used: the form is four lines long)."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from mvseg.errors import InputError
from mvseg.formats.coco import decode_segmentation
from mvseg.formats.masks.yolo import has_tracks, read_class_names, read_yolo

TRIANGLE = "0.1 0.1 0.9 0.2 0.5 0.8"


def write(folder: Path, *lines: str) -> Path:
    folder.mkdir(exist_ok=True)
    path = folder / "000.txt"
    path.write_text("\n".join(lines))
    return path


def test_polygons_boxes_and_confidences(tmp_path: Path) -> None:
    path = write(tmp_path, f"1 {TRIANGLE}", "", "0 0.5 0.5 0.2 0.2", f"0 {TRIANGLE} 0.87", "0 0.5 0.5 0.2 0.2 0.9")
    found = read_yolo(path, 80, 60, names={0: "leaf"})
    assert [(each.label, each.category, each.mask is None) for each in found] == [
        (1, "1", False), (3, "leaf", True), (4, "leaf", False), (5, "leaf", True)
    ]  # fmt: skip
    expected = decode_segmentation([[8.0, 6, 72, 12, 40, 48]], 80, 60)
    np.testing.assert_array_equal(found[0].mask, expected)
    np.testing.assert_array_equal(found[2].mask, expected)


def test_tracks_are_no_corners(tmp_path: Path) -> None:
    """Of `track` with `save_conf`; the line of a track 1 could be a polygon down to the edge, but all lines end so."""
    path = write(tmp_path, f"0 {TRIANGLE} 0.62 1", f"0 {TRIANGLE} 0.4 12", "0 0.5 0.5 0.2 0.2 1 3")
    assert has_tracks([path])
    found = read_yolo(path, 80, 60, names={}, tracks=True)
    expected = decode_segmentation([[8.0, 6, 72, 12, 40, 48]], 80, 60)
    np.testing.assert_array_equal(found[0].mask, expected)
    assert [each.mask is None for each in found] == [False, False, True]
    other_ends = ("0.62 1", "0.5 1.0", "0.7", "7 2", "")  # the first is that of two lines
    for line in (*(f"0 {TRIANGLE} {end}" for end in other_ends), "0 0.1 0.1 0.9 0.2"):
        assert not has_tracks([path, write(tmp_path / "more", f"0 {TRIANGLE} 0.62 1", line)])
    assert not has_tracks([])


def test_a_rectangle_has_exact_pixels(tmp_path: Path) -> None:
    """Shares of the photo count from the corner of its top-left pixel."""
    path = write(tmp_path, "0 0.1 0.2 0.5 0.2 0.5 0.7 0.1 0.7")
    mask = np.zeros((10, 10), bool)
    mask[2:7, 1:5] = True
    np.testing.assert_array_equal(read_yolo(path, 10, 10, names={})[0].mask, mask)


def test_contours_of_pixel_centres_lose_half_a_pixel_all_round(tmp_path: Path) -> None:
    """As docs/own-masks.md says of masks that tools make polygons of: the file does not tell."""
    mask = np.zeros((40, 40), np.uint8)
    mask[5:15, 8:28] = 1
    ((contour,), _) = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    path = write(tmp_path, " ".join(["0", *(f"{share:.6f}" for share in (contour / 40).ravel())]))
    found = read_yolo(path, 40, 40, names={})[0].mask
    assert found is not None
    mask[14] = mask[:, 27] = 0
    np.testing.assert_array_equal(found, mask.astype(bool))


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("leaf 0.1 0.1 0.2 0.2 0.3 0.3", "line 2: holds something that is not a number, expected: class x1 y1"),
        ("0 0.1 0.1", "line 2: has 2 numbers after the class, expected three corners or more"),
        ("0 10 10 20 10 20 20", "line 2: its corners are not between 0 and 1"),
        ("0 nan 0.1 0.2 0.2 0.3 0.3", "line 2: its corners are not between 0 and 1"),
        ("1e999 0.1 0.1 0.2 0.2 0.3 0.3", "line 2: holds something that is not a number"),
    ],
)
def test_bad_lines_are_named(line: str, message: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=rf"000.txt: {message}"):
        read_yolo(write(tmp_path, f"0 {TRIANGLE}", line), 80, 60, names={})


def test_files_that_cannot_be_read(tmp_path: Path) -> None:
    (tmp_path / "000.txt").write_bytes(b"\xff\xfe\x00")
    for name in ("000.txt", "absent.txt"):
        with pytest.raises(InputError, match=f"{name}: (cannot be read|byte 0 is not UTF-8)"):
            read_yolo(tmp_path / name, 80, 60, names={})


@pytest.mark.parametrize(
    ("file", "text"),
    [
        ("classes.txt", "leaf\npot\n"),
        ("obj.names", "leaf\npot\n"),
        ("data.yaml", "train: x\nnames: [leaf, pot]\n"),
        ("data.yaml", "nc: 2\nnames:\n  0: leaf\n  1: pot\n"),
    ],
)
def test_names_of_classes(file: str, text: str, tmp_path: Path) -> None:
    (tmp_path / "train" / "labels").mkdir(parents=True)
    assert read_class_names(tmp_path / "train" / "labels") == {}
    (tmp_path / file).write_text(text)
    for folder in ("", "train", "train/labels"):
        assert read_class_names(tmp_path / folder) == {0: "leaf", 1: "pot"}


@pytest.mark.parametrize("text", ["names: [", "[1, 2]", "names: {a: b}", "names: !!python/object/apply:os.getcwd []"])
def test_bad_names_of_classes(text: str, tmp_path: Path) -> None:
    (tmp_path / "data.yaml").write_text(text)
    with pytest.raises(InputError, match=r"data.yaml: .*names of classes"):
        read_class_names(tmp_path)
