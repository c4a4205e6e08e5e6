from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from mvseg.errors import InputError
from mvseg.formats.find_views import natural_order
from mvseg.formats.image_file import read_rgb
from mvseg.poses.photo_files import PhotoFile, copy_photos, group_by_camera, list_photos

RAMP = np.linspace(0, 255, 60 * 40).reshape(40, 60).astype(np.uint8)


def save(folder: Path, *names: str) -> Path:
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        assert cv2.imwrite(str(folder / name), RAMP)
    return folder


def save_jpeg(path: Path, orientation: int = 1, **tags: float) -> Path:
    exif = Image.Exif()
    exif[0x0112] = orientation
    exif[0x0110] = "Phone 7"
    exif.get_ifd(0x8769)[0x920A] = tags.get("focal", 4.0)
    if "zoom" in tags:
        exif.get_ifd(0x8769)[0xA404] = tags["zoom"]
    Image.fromarray(RAMP).convert("RGB").save(path, format="JPEG", exif=exif, quality=95)
    return path


def test_photos_are_listed_as_people_count(tmp_path: Path) -> None:
    save(tmp_path, "10.JPG", "9.jpg", "img1.png", ".hidden.png")
    (tmp_path / "notes.txt").write_text("")
    assert list_photos(tmp_path) == (tmp_path, ["9.jpg", "10.JPG", "img1.png"])
    assert sorted(["b10", "b9", "a2b", "a2", "a10"], key=natural_order) == ["a2", "a2b", "a10", "b9", "b10"]
    save(tmp_path / "scene", "images/0.png", "images/1.png", "images/2.png", "masks/0.png")
    assert list_photos(tmp_path / "scene") == (tmp_path / "scene" / "images", ["0.png", "1.png", "2.png"])
    save(tmp_path / "rig", "top/0.png", "top/1.png", "side/0.png", "side/1.png")
    assert list_photos(tmp_path / "rig") == (tmp_path / "rig", ["side/0.png", "side/1.png", "top/0.png", "top/1.png"])


@pytest.mark.parametrize(
    ("names", "message"),
    [
        (("0.png", "1.png"), "found 2 photos"),
        ((), "found 0 photos"),
        (("0.png", "1.png", "2.png", "2.jpg"), "2.jpg and 2.png differ in their suffix only"),
    ],
)
def test_photos_that_cannot_be_used(tmp_path: Path, names: tuple[str, ...], message: str) -> None:
    with pytest.raises(InputError, match=message):
        list_photos(save(tmp_path, *names))


def test_missing_folders_are_named(tmp_path: Path) -> None:
    (tmp_path / "IMG_1.HEIC").write_bytes(b"")
    with pytest.raises(InputError, match="no such folder"):
        list_photos(tmp_path / "nowhere")
    with pytest.raises(InputError, match="is a file, expected a folder"):
        list_photos(tmp_path / "IMG_1.HEIC")


@pytest.mark.parametrize("orientation", range(1, 9))
def test_photos_are_copied_upright(tmp_path: Path, orientation: int) -> None:
    path = save_jpeg(tmp_path / "a.jpg", orientation)
    (photo,) = copy_photos(tmp_path, ["a.jpg"], tmp_path / "images")
    copy = read_rgb(tmp_path / "images" / "a.jpg")
    shown = cv2.imread(str(path), cv2.IMREAD_COLOR_RGB)  # turned as EXIF says
    assert copy.shape == shown.shape
    assert np.abs(copy.astype(int) - shown).max() <= 8
    assert (photo.width, photo.height) == copy.shape[1::-1]
    assert photo.is_turned == (orientation != 1)
    assert ((tmp_path / "images" / "a.jpg").read_bytes() == path.read_bytes()) == (orientation == 1)
    with Image.open(tmp_path / "images" / "a.jpg") as image:
        exif = image.getexif()
    assert (exif[0x0112], exif.get_ifd(0x8769)[0x920A]) == (1, 4.0)  # the focal length stays


@pytest.mark.parametrize("suffix", ["png", "tif"])
def test_other_photos_that_are_turned_become_upright_png(tmp_path: Path, suffix: str) -> None:
    exif = Image.Exif()
    exif[0x0112] = 6
    pixels = np.random.default_rng(0).integers(0, 255, (30, 50, 3), dtype=np.uint8)
    Image.fromarray(pixels).save(tmp_path / f"a.{suffix}", exif=exif)
    (photo,) = copy_photos(tmp_path, [f"a.{suffix}"], tmp_path / "images")
    assert (photo.name, photo.size, photo.is_turned) == ("a.png", (30, 50), True)
    np.testing.assert_array_equal(read_rgb(tmp_path / "images" / "a.png"), np.rot90(pixels, -1))


def test_what_colmap_cannot_read_becomes_png(tmp_path: Path) -> None:
    save(tmp_path, "a.webp")
    cv2.imwrite(str(tmp_path / "b.png"), RAMP.astype(np.uint16) * 4)  # 10 bits in 16
    found = copy_photos(tmp_path, ["a.webp", "b.png"], tmp_path / "images")
    assert [photo.name for photo in found] == ["a.png", "b.png"]
    for photo in found:
        assert cv2.imread(str(tmp_path / "images" / photo.name), cv2.IMREAD_UNCHANGED).dtype == np.uint8
        np.testing.assert_allclose(read_rgb(tmp_path / "images" / photo.name)[..., 0], RAMP, atol=3)


def test_one_range_for_all_photos_of_12_bits(tmp_path: Path) -> None:
    for name, most in (("a.png", 4095), ("b.png", 1000)):  # 1000 would fit into 10 bits
        cv2.imwrite(str(tmp_path / name), np.full(RAMP.shape, most, np.uint16))
    copy_photos(tmp_path, ["a.png", "b.png"], tmp_path / "images")
    assert [int(read_rgb(tmp_path / "images" / name).max()) for name in ("a.png", "b.png")] == [255, 1000 >> 4]


def test_a_digital_zoom_that_jitters_is_one(tmp_path: Path) -> None:
    zooms = {"a.jpg": 1.0, "b.jpg": 1.001, "c.jpg": 0.9995, "d.jpg": 1.3, "e.jpg": 0.0, "f.jpg": 1.301}
    for name, zoom in zooms.items():
        save_jpeg(tmp_path / name, zoom=zoom)
    groups = group_by_camera(copy_photos(tmp_path, [*zooms], tmp_path / "images"))
    assert [[photo.name[0] for photo in group] for group in groups] == [["a", "b", "c", "e"], ["d", "f"]]


def test_photos_of_one_folder_size_and_focal_length_share_a_camera(tmp_path: Path) -> None:
    for name, focal in (("a.jpg", 4.0), ("b.jpg", 4.0), ("c.jpg", 7.0)):
        save_jpeg(tmp_path / name, focal=focal)
    a, b, c = copy_photos(tmp_path, ["a.jpg", "b.jpg", "c.jpg"], tmp_path / "images")
    small, other = PhotoFile("d.jpg", 30, 20, a.optics), PhotoFile("top/e.jpg", a.width, a.height, a.optics)
    photos = [a, b, c, small, other]
    assert group_by_camera(photos) == [[a, b], [c], [small], [other]]
    assert group_by_camera(photos, shared=False) == [[photo] for photo in photos]
    assert group_by_camera([a, b, c, other], shared=True) == [[a, b, c, other]]
    with pytest.raises(InputError, match=r"a.jpg has 60 x 40 pixels, d.jpg 30 x 20: they cannot share one camera"):
        group_by_camera(photos, shared=True)
