"""From photos and cameras to a scene, and the reading of photos."""

from __future__ import annotations

import ntpath
import os
import sys
from pathlib import Path

import numpy as np
import pycolmap
import pytest
import tifffile
import torch
from PIL import Image

from mvseg.errors import InputError
from mvseg.formats import photos as photos_module
from mvseg.formats.image_file import read_image_size, read_rgb
from mvseg.formats.photos import (
    Photo,
    Photos,
    build_scene,
    check_photos,
    load_photos,
    measure_content,
    read_photo,
    view_names,
)  # fmt: skip
from mvseg.formats.scene_folder import load_scene
from mvseg.scene import Scene
from mvseg.system.file_hash import hash_files
from scene_folders import HEIGHT, WIDTH, K, arc_pose, edit_rig, write_image, write_scene
from warned import warns_of


def make_photo(file: str, view: int = 0, **changes: object) -> Photo:
    R, t = arc_pose(view, 4)
    return Photo(**({"file": file, "width": WIDTH, "height": HEIGHT, "K": K, "R": R, "t": t} | changes))


def scene_of(*photos: Photo) -> Scene:
    return build_scene(Path("plant"), photos, unit="mm", source=Path("plant/cameras.json"))


@pytest.mark.parametrize(
    ("files", "names"),
    [
        (["images/000.jpg", "images/001.jpg"], ["000", "001"]),
        (["a.jpg", "b.jpg"], ["a", "b"]),
        (["images/left/1.jpg", "images/right/1.jpg"], ["left/1", "right/1"]),
        (["./images/1.jpg", "images/../images/2.jpg"], ["1", "2"]),
        (["1.jpg", "more/2.jpg"], ["1", "more/2"]),
        (["images/day.1.plant.jpg", "images/day.2.plant.jpg"], ["day.1.plant", "day.2.plant"]),
        (["images/blatt grün.JPG", "images/2"], ["blatt grün", "2"]),
    ],
)
def test_view_names_are_paths_below_the_shared_folder(files: list[str], names: list[str]) -> None:
    assert view_names(files) == names


def make_lens(k1: float) -> pycolmap.Camera:
    return pycolmap.Camera(model="SIMPLE_RADIAL", width=WIDTH, height=HEIGHT, params=[150, 64, 48, k1])


def test_views_have_the_same_names_on_windows(monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(os, "path", ntpath)
        assert view_names(["images/left/1.jpg", "images/right/1.jpg"]) == ["left/1", "right/1"]


def test_scene_keeps_order_names_paths_and_cameras() -> None:
    scene = scene_of(make_photo("images/b.jpg", 0), make_photo("images/a.jpg", 1))
    assert [view.name for view in scene.views] == ["b", "a"]
    assert [view.path for view in scene.views] == [Path("plant/images/b.jpg"), Path("plant/images/a.jpg")]
    assert (scene.name, scene.unit, scene.source) == ("plant", "mm", Path("plant/cameras.json"))
    np.testing.assert_array_equal(scene.cameras.R[1], arc_pose(1, 4)[0])
    np.testing.assert_array_equal(scene.cameras.t[1], arc_pose(1, 4)[1])
    assert scene.cameras.sizes.tolist() == [[WIDTH, HEIGHT]] * 2


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"file": "../b.jpg"}, "leads out of the scene"),
        ({"file": "images/../../b.jpg"}, "leads out of the scene"),
        ({"file": "/b.jpg"}, "leads out of the scene"),
        ({"file": ""}, "not the name of a file"),
        ({"file": "images/.."}, "not the name of a file"),
        ({"file": "b\0.jpg"}, "not the name of a file"),
        ({"width": 2**40}, "image size is 1099511627776 x 96"),
        ({"K": np.diag([0.0, 100.0, 1.0])}, "focal length is 0, 100"),
        ({"t": np.array([0, np.nan, 0])}, "t holds a number that is not finite"),
        ({"R": np.diag([1.0, 1.0, -1.0])}, "reflection"),
        ({"lens": make_lens(np.nan)}, "its lens has the parameters 150, 64, 48, nan, expected finite numbers"),
        ({"lens": make_lens(np.inf)}, "its lens has the parameters"),
    ],
)
def test_a_bad_photo_is_named(change: dict[str, object], message: str) -> None:
    with pytest.raises(InputError, match=message) as caught:
        scene_of(make_photo("images/a.jpg"), make_photo(**({"file": "images/b.jpg", "view": 1} | change)))
    assert str(caught.value).startswith("plant/cameras.json: view 1 (")


@pytest.mark.parametrize(("count", "message"), [(0, "there are no views"), (1, "there is a single view")])
def test_too_few_views(count: int, message: str) -> None:
    with pytest.raises(InputError, match=rf"plant/cameras.json: {message}, expected at least two"):
        scene_of(*[make_photo("images/a.jpg")] * count)


def test_photos_that_do_not_fit_their_cameras(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"plant/cameras.json: views 0 and 2 have the same name 'a'"):
        scene_of(make_photo("images/a.jpg"), make_photo("images/b.jpg", 1), make_photo("images/a.png", 2))
    folder = write_scene(tmp_path / "plant", 2)
    write_image(folder / "images" / "001.png", np.zeros((HEIGHT, WIDTH + 1, 3), np.uint8))
    with pytest.raises(InputError, match=r"001\.png: the image of view 1 is 129 x 96, its camera says 128 x 96"):
        read_photo(load_scene(folder), 1)


class TestPhotos:
    """Two of four photos fit into the cache."""

    @pytest.fixture
    def scene(self, tmp_path: Path) -> Scene:
        folder = write_scene(tmp_path / "plant")
        edit_rig(folder, 2, distortion=[-0.3, 0, 0, 0, 0])
        return load_scene(folder)

    @pytest.fixture
    def decoded(self, monkeypatch: pytest.MonkeyPatch) -> list[str]:
        names, read = list[str](), photos_module.read_rgb

        def read_rgb(path: Path, *size: tuple[int, int], bits: int = 8) -> np.ndarray:
            names.append(path.stem)
            return read(path, *size, bits=bits)

        monkeypatch.setattr(photos_module, "read_rgb", read_rgb)
        monkeypatch.setattr(photos_module, "CACHED_BYTES", 2 * HEIGHT * WIDTH * 3)
        return names

    def test_what_does_not_fit_is_decoded_once_by_each_stage(self, scene: Scene, decoded: list[str]) -> None:
        photos, expected = Photos(scene), [read_photo(scene, view) for view in range(4)]
        decoded.clear()
        for _ in range(2):
            for view in (0, 1, 1, 2, 2, 3):
                np.testing.assert_array_equal(photos(view), expected[view])
        assert decoded == ["000", "001", "002", "003", "001", "002", "003"]  # the first one is kept, and one at work

    def test_content_and_hash_are_known_from_then_on(self, scene: Scene, decoded: list[str]) -> None:
        """Content is that of the stored photo: it has no black corners."""
        photos = Photos(scene)
        known = [photos.content(view) for view in range(4)]
        assert known == [measure_content(read_rgb(view.path)) for view in scene.views]
        assert [photos.content(view) for view in range(4)] == known
        assert len(decoded) == 4
        few = photos.select(scene.select(torch.tensor([2, 0])), [2, 0])
        assert [few.content(view) for view in range(2)] == [known[2], known[0]]
        assert len(decoded) == 4
        np.testing.assert_array_equal(few(0), read_photo(scene, 2))
        assert few.sha256(0) == photos.sha256(2) == hash_files(scene.views[2].path)


def test_photos_for_a_detector_and_photos_that_are_missing(tmp_path: Path) -> None:
    folder = write_scene(tmp_path / "plant")
    scene = load_scene(folder)
    photos = load_photos(scene)
    assert [tuple(photo.shape) for photo in photos] == [(3, 96, 128)] * 4
    np.testing.assert_allclose(photos[2].permute(1, 2, 0).numpy() * 255, read_photo(scene, 2), atol=1e-4)
    check_photos(scene)
    (folder / "images" / "001.png").unlink()
    with pytest.raises(InputError, match=r"001\.png: the image of view 1 is missing"):
        check_photos(scene)
    for path in (folder / "images").iterdir():
        path.unlink()
    check_photos(scene)


@pytest.mark.parametrize("suffix", ["jpg", "png", "late.png", "tif", "deep.tif", "webp"])
@pytest.mark.parametrize("orientation", [1, 3, 6])
def test_photos_that_exif_turns_are_read_as_stored_and_warned_of(tmp_path: Path, orientation: int, suffix: str) -> None:
    """As COLMAP reads them, in every format."""
    folder = write_scene(tmp_path / "plant")
    rig = folder / "cameras.json"
    rig.write_text(rig.read_text().replace("000.png", f"000.{suffix}"))
    pixels = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    pixels[: HEIGHT // 2], pixels[:, : WIDTH // 3, 0] = 200, 80
    exif = Image.Exif()
    exif[0x0112] = orientation
    path = folder / "images" / f"000.{suffix}"
    if suffix == "deep.tif":
        tags = [(0x0112, "H", 1, orientation, True)]
        tifffile.imwrite(path, pixels.astype(np.uint16) * 257, photometric="rgb", extratags=tags)
    else:
        Image.fromarray(pixels).save(path, exif=exif, quality=95)
    if suffix == "late.png":  # as exiftool writes it: the chunk stands behind the pixels
        data = path.read_bytes()
        at = data.index(b"eXIf") - 4
        end = at + 12 + int.from_bytes(data[at : at + 4])
        path.write_bytes(data[:at] + data[end:-12] + data[at:end] + data[-12:])
    assert read_image_size(path) == (WIDTH, HEIGHT)
    if suffix != "webp":
        shown = pycolmap.Bitmap.read(str(path), as_rgb=True).to_array()
        assert np.abs(shown.astype(int) - pixels).mean() < 5
    scene = load_scene(folder)
    if orientation == 1:
        check_photos(scene)  # warnings are errors
    else:
        with warns_of("turned_for_display"):
            check_photos(scene)
    assert np.abs(read_photo(scene, 0).astype(int) - pixels).mean() < 5


def test_a_size_that_does_not_fit_names_exif(tmp_path: Path) -> None:
    folder = write_scene(tmp_path / "plant")
    rig = folder / "cameras.json"
    rig.write_text(rig.read_text().replace("000.png", "000.jpg"))
    exif = Image.Exif()
    exif[0x0112] = 6
    Image.fromarray(np.zeros((WIDTH, HEIGHT, 3), np.uint8)).save(folder / "images" / "000.jpg", exif=exif)
    with pytest.raises(InputError, match=rf"is {HEIGHT} x {WIDTH} \(as it is stored; EXIF turns it for display\)"):
        read_photo(load_scene(folder), 0)


def test_photos_in_other_capitals_are_found(tmp_path: Path) -> None:
    folder = write_scene(tmp_path / "plant")
    for view in range(4):
        (folder / "images" / f"{view:03d}.png").rename(folder / "images" / f"{view:03d}.PNG")
    scene = load_scene(folder)
    assert [view.path.name for view in scene.views] == ["000.PNG", "001.PNG", "002.PNG", "003.PNG"]
    assert [view.name for view in scene.views] == ["000", "001", "002", "003"]
    check_photos(scene)


def test_a_missing_photo_says_what_is_there(tmp_path: Path) -> None:
    folder = write_scene(tmp_path / "plant")
    scene = load_scene(folder)
    (folder / "images" / "001.png").rename(folder / "images" / "plant.png")
    with pytest.raises(InputError, match=r"view 1 is missing; found 000.png, 002.png, 003.png and 1 more"):
        check_photos(scene)
    for number in (0, 2, 3):
        (folder / "images" / f"{number:03d}.png").unlink()
    with warns_of("all_photos_missing"):
        check_photos(scene)


def test_heic_files_are_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pi_heif", None)  # as if it were not installed
    folder = write_scene(tmp_path / "plant")
    (folder / "images" / "001.png").write_bytes(b"\x00\x00\x00\x28ftypheic\x00\x00\x00\x00" + b"mif1heic" * 8)
    reason = r"view 1 cannot be read, .*: it is a HEIC file: pip install 'mvseg\[heic\]' reads it"
    with pytest.raises(InputError, match=reason):
        read_photo(load_scene(folder), 1)


@pytest.mark.parametrize("suffix", ["png", "tif"])
@pytest.mark.parametrize("channels", [1, 3])
def test_photos_of_12_bits_are_brightened_and_said(suffix: str, channels: int, tmp_path: Path) -> None:
    """A camera of 12 bits writes 0 to 4095 into files of 16 bits."""
    folder = write_scene(tmp_path / "plant")
    rng = np.random.default_rng(2)
    values = rng.integers(0, 4096, (HEIGHT, WIDTH, channels)[: 2 if channels == 1 else 3], dtype=np.uint16)
    edit_rig(folder, 1, file=f"images/001.{suffix}")
    write_image(folder / "images" / f"001.{suffix}", values)
    scene = load_scene(folder)
    with warns_of("few_bits"):
        check_photos(scene)
    expected = (values >> 4).astype(np.uint8)
    np.testing.assert_array_equal(read_photo(scene, 1), expected if channels == 3 else np.dstack([expected] * 3))
    values[0, 0] = 65535
    write_image(folder / "images" / f"001.{suffix}", values)
    check_photos(scene)  # all 16 bits: no warning
    difference = read_photo(scene, 1)[..., 0].astype(int) - (values.reshape(HEIGHT, WIDTH, -1)[..., 0] >> 8)
    assert np.abs(difference).max() <= 1


def write_deep_photos(folder: Path, *highest: int) -> Path:
    """Photos of 16 bits, each a ramp from 0 to its own highest number."""
    for view, top in enumerate(highest):
        ramp = np.linspace(0, top, HEIGHT * WIDTH * 3).astype(np.uint16).reshape(HEIGHT, WIDTH, 3)
        write_image(folder / "images" / f"{view:03d}.png", ramp)
    return folder


def test_one_range_brightens_all_photos_of_a_scene(tmp_path: Path) -> None:
    """A dark photo of 12 bits whose numbers would fit into 10 stays darker than its neighbours."""
    scene = load_scene(write_deep_photos(write_scene(tmp_path / "plant", 3), 4095, 1000, 2000))
    with warns_of("few_bits"):
        check_photos(scene)
    assert [read_photo(scene, view).max() for view in range(3)] == [255, 1000 >> 4, 2000 >> 4]
    write_deep_photos(tmp_path / "plant", 4095, 65535, 2000)  # one uses all 16: so may all
    assert [int(read_photo(scene, view).max()) for view in (0, 2)] == [4095 >> 8, 2000 >> 8]


def test_photos_of_8_bits_beside_deep_ones_stay(tmp_path: Path) -> None:
    scene = load_scene(write_deep_photos(write_scene(tmp_path / "plant", 2), 4095, 1000))
    whole = np.full((HEIGHT, WIDTH, 3), 77, np.uint8)
    write_image(scene.views[0].path, whole)
    np.testing.assert_array_equal(read_photo(scene, 0), whole)
    assert read_photo(scene, 1).max() == 1000 >> 2
