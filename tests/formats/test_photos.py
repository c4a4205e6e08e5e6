"""From photos and cameras to a scene, and the reading of photos."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from mvseg.errors import InputError, InputWarning
from mvseg.formats.photos import Photo, build_scene, check_photos, load_photos, read_photo, view_names
from mvseg.formats.scene_folder import load_scene
from mvseg.scene import Scene
from scene_folders import HEIGHT, WIDTH, K, arc_pose, cut_file, write_image, write_scene


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


def test_two_photos_of_one_view_name() -> None:
    with pytest.raises(InputError, match=r"plant/cameras.json: views 0 and 2 have the same name 'a'"):
        scene_of(make_photo("images/a.jpg"), make_photo("images/b.jpg", 1), make_photo("images/a.png", 2))


class TestReadPhoto:
    @pytest.fixture
    def folder(self, tmp_path: Path) -> Path:
        return write_scene(tmp_path / "plant", 2)

    def test_colours_are_rgb(self, folder: Path) -> None:
        write_image(folder / "images" / "001.png", np.full((HEIGHT, WIDTH, 3), (200, 100, 50), np.uint8))
        photo = read_photo(load_scene(folder), 1)
        assert photo.shape == (HEIGHT, WIDTH, 3)
        assert photo.dtype == np.uint8
        assert (photo == (200, 100, 50)).all()

    def test_grey_photo_becomes_rgb(self, folder: Path) -> None:
        write_image(folder / "images" / "001.png", np.full((HEIGHT, WIDTH), 77, np.uint8))
        assert (read_photo(load_scene(folder), 1) == (77, 77, 77)).all()

    def test_missing(self, folder: Path) -> None:
        (folder / "images" / "001.png").unlink()
        with pytest.raises(InputError, match=r"images/001\.png: the image of view 1 is missing"):
            read_photo(load_scene(folder), 1)

    def test_other_size(self, folder: Path) -> None:
        write_image(folder / "images" / "001.png", np.zeros((HEIGHT, WIDTH + 1, 3), np.uint8))
        with pytest.raises(InputError, match=r"001\.png: the image of view 1 is 129 x 96, its camera says 128 x 96"):
            read_photo(load_scene(folder), 1)

    @pytest.mark.parametrize("share", [0.0, 0.01, 0.5, 0.999])
    @pytest.mark.parametrize("suffix", [".png", ".jpg"])
    def test_cut_short(self, folder: Path, suffix: str, share: float) -> None:
        scene = load_scene(folder)
        picture = folder / f"picture{suffix}"
        write_image(picture, read_photo(scene, 1))
        cut_file(picture, share)
        picture.rename(scene.views[1].path)
        with pytest.raises(InputError, match=r"001\.png: the image of view 1 cannot be read, expected a whole image"):
            read_photo(scene, 1)


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


@pytest.mark.parametrize("orientation", [1, 3, 6])
def test_photos_that_exif_turns_are_read_as_stored_and_warned_of(tmp_path: Path, orientation: int) -> None:
    folder = write_scene(tmp_path / "plant")
    rig = folder / "cameras.json"
    rig.write_text(rig.read_text().replace("000.png", "000.jpg"))
    pixels = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    pixels[: HEIGHT // 2] = 200
    exif = Image.Exif()
    exif[0x0112] = orientation
    Image.fromarray(pixels).save(folder / "images" / "000.jpg", exif=exif, quality=95)
    scene = load_scene(folder)
    if orientation == 1:
        check_photos(scene)  # warnings are errors
    else:
        with pytest.warns(InputWarning, match=r"000\.jpg: EXIF turns 1 photos for display"):
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
