"""COLMAP models, written by pycolmap, against pycolmap's own projection; and models that are not whole."""

from __future__ import annotations

import shutil
import struct
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pycolmap
import pytest
import torch

from mvseg.errors import InputError
from mvseg.formats.colmap import find_colmap_model, read_colmap
from mvseg.formats.lens import photo_from_pinhole
from mvseg.formats.scene_folder import load_scene
from scene_folders import arc_pose
from warned import warns_of

WIDTH, HEIGHT = 128, 96
PINHOLES = {"SIMPLE_PINHOLE": [150, 64, 48], "PINHOLE": [150, 155, 63.5, 48.25]}
LENSES = {
    "SIMPLE_RADIAL": [150, 64, 48, -0.1],
    "RADIAL": [150, 64, 48, -0.1, 0.02],
    "OPENCV": [150, 155, 63.5, 48.25, -0.1, 0.02, 0.001, -0.002],
    "FULL_OPENCV": [150, 155, 63.5, 48.25, -0.1, 0.02, 0.001, -0.002, 0.01, 0.02, 0.01, 0.001],
    "OPENCV_FISHEYE": [120, 125, 64, 48, 0.02, -0.01, 0.003, 0.001],
    "SIMPLE_RADIAL_FISHEYE": [120, 64, 48, 0.02],
    "FOV": [120, 125, 64, 48, 0.8],
    "THIN_PRISM_FISHEYE": [120, 125, 64, 48, 0.02, -0.01, 0.001, -0.001, 0.002, 0.001, 0.003, 0.002],
}
POINTS = np.random.default_rng(1).uniform(-8, 8, (20, 3))


def build_model(lenses: dict[str, Sequence[float]]) -> pycolmap.Reconstruction:
    """One image per camera, with observations of all points."""
    model = pycolmap.Reconstruction()
    for number, (name, params) in enumerate(lenses.items(), start=1):
        camera = pycolmap.Camera(model=name, width=WIDTH, height=HEIGHT, params=params)
        camera.camera_id = number
        model.add_camera_with_trivial_rig(camera)
        R, t = arc_pose(number - 1, len(lenses))
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(R), t)
        image = pycolmap.Image()
        image.name, image.image_id, image.camera_id = f"{name.lower()}/{number:02d}.jpg", number, number
        pixels = camera.img_from_cam(POINTS @ R.T + t)
        image.points2D = pycolmap.Point2DList([pycolmap.Point2D(xy) for xy in pixels])
        model.add_image_with_trivial_frame(image, pose)
    for index, point in enumerate(POINTS):
        track = [pycolmap.TrackElement(number + 1, index) for number in range(len(lenses))]
        model.add_point3D(point, pycolmap.Track(track), np.array([1, 2, 3], np.uint8))
    return model


@pytest.fixture(scope="module")
def model() -> pycolmap.Reconstruction:
    return build_model(PINHOLES | LENSES)


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A scene folder with a binary model of two views."""
    folder = tmp_path_factory.mktemp("plant")
    (folder / "sparse").mkdir()
    build_model({"PINHOLE": PINHOLES["PINHOLE"], "OPENCV": LENSES["OPENCV"]}).write_binary(folder / "sparse")
    return folder


@pytest.mark.parametrize("place", ["sparse", "sparse/0", "colmap/sparse/0"])
@pytest.mark.parametrize("kind", ["text", "binary"])
def test_projections_agree_with_pycolmap(model: pycolmap.Reconstruction, kind: str, place: str, tmp_path: Path) -> None:
    (tmp_path / place).mkdir(parents=True)
    getattr(model, f"write_{kind}")(tmp_path / place)
    scene = load_scene(tmp_path)
    assert scene.source == tmp_path / place
    assert scene.unit == ""
    assert len(scene.views) == len(model.images)
    pinhole_px, depth = scene.cameras.project(torch.from_numpy(POINTS))
    assert (depth > 0).all()
    names = [view.path.relative_to(tmp_path / "images").as_posix() for view in scene.views]
    assert names == sorted(image.name for image in model.images.values())
    for index, view in enumerate(scene.views):
        image = model.find_image_with_name(names[index])
        expected = np.stack([image.project_point(point) for point in POINTS])
        found = pinhole_px[index].numpy()
        if view.lens is not None:
            found = photo_from_pinhole(view.lens, scene.cameras.K[index].numpy(), found)
        np.testing.assert_allclose(found, expected, atol=1e-6)
        np.testing.assert_allclose(scene.cameras.centers[index], image.projection_center(), atol=1e-9)
        assert (view.lens is None) == (names[index].split("/")[0].upper() in PINHOLES)
        assert view.name == names[index].removesuffix(".jpg")


def test_radial_without_distortion_is_a_pinhole_but_a_fisheye_is_not(tmp_path: Path) -> None:
    lenses = {"OPENCV": [150, 150, 64, 48, 0, 0, 0, 0], "OPENCV_FISHEYE": [150, 150, 64, 48, 0, 0, 0, 0]}
    build_model(lenses).write_binary(tmp_path)
    by_name = {view.name: view.lens for view in read_colmap(tmp_path, tmp_path).views}
    assert by_name["opencv/01"] is None
    assert by_name["opencv_fisheye/02"].model_name == "OPENCV_FISHEYE"


def copy_model(small: Path, folder: Path) -> Path:
    shutil.copytree(small, folder)
    return folder / "sparse"


@pytest.mark.parametrize("name", ["cameras.bin", "images.bin", "points3D.bin", "rigs.bin", "frames.bin"])
def test_cut_binary_files_are_named(name: str, small: Path, tmp_path: Path) -> None:
    """Wherever they are cut: pycolmap itself takes some of these as whole, or asks for gigabytes."""
    model = copy_model(small, tmp_path / "plant")
    data = (model / name).read_bytes()
    assert len(read_colmap(model, tmp_path).views) == 2
    for length in [*range(0, len(data), 17), 1, 4, 8, 9, len(data) - 9, len(data) - 8, len(data) - 1]:
        (model / name).write_bytes(data[:length])
        with pytest.raises(InputError, match=rf"{name}: not a whole COLMAP file"):
            read_colmap(model, tmp_path)


@pytest.mark.parametrize("name", ["cameras.bin", "images.bin", "points3D.bin"])
def test_too_long_binary_files_and_absurd_counts_are_named(name: str, small: Path, tmp_path: Path) -> None:
    model = copy_model(small, tmp_path / "plant")
    data = (model / name).read_bytes()
    for content in (data + b"\0", struct.pack("<Q", 2**63) + data[8:], b"\xff" * len(data)):
        (model / name).write_bytes(content)
        with pytest.raises(InputError, match=rf"{name}: (not a whole COLMAP file|camera model number -1 is not known)"):
            read_colmap(model, tmp_path)


class TestText:
    @pytest.fixture
    def folder(self, small: Path, tmp_path: Path) -> Path:
        (tmp_path / "sparse").mkdir()
        pycolmap.Reconstruction(small / "sparse").write_text(tmp_path / "sparse")
        return tmp_path

    def replace(self, folder: Path, name: str, old: str, new: str) -> None:
        path = folder / "sparse" / name
        text = path.read_text()
        assert old in text
        path.write_text(text.replace(old, new))

    def test_unknown_camera_model(self, folder: Path) -> None:
        self.replace(folder, "cameras.txt", "OPENCV", "CUBIST")
        with pytest.raises(
            InputError, match=r"sparse: cannot be read as a COLMAP model \(Camera model does not exist\)"
        ):
            load_scene(folder)

    def test_name_that_leads_out(self, folder: Path) -> None:
        self.replace(folder, "images.txt", "pinhole/01.jpg", "../../01.jpg")
        with pytest.raises(InputError, match=r"sparse: view 0 \(images/../../01.jpg\): the file name leads out"):
            load_scene(folder)

    def test_no_perspective(self, folder: Path) -> None:
        path = folder / "sparse" / "cameras.txt"
        lines = [line for line in path.read_text().splitlines() if not line.startswith("2 ")]
        path.write_text("\n".join([*lines, "2 EQUIRECTANGULAR 128 96 128 96"]) + "\n")
        with pytest.raises(
            InputError, match=r"image opencv/02.jpg: camera model EQUIRECTANGULAR is not a perspective one"
        ):
            load_scene(folder)

    @pytest.mark.parametrize("share", [0.0, 0.5, 0.8, 0.95])
    @pytest.mark.parametrize("name", ["cameras.txt", "images.txt"])
    def test_cut(self, folder: Path, name: str, share: float) -> None:
        path = folder / "sparse" / name
        text = path.read_text()
        path.write_text(text[: int(share * len(text))])
        with pytest.raises(InputError, match=r"sparse: (cannot be read as a COLMAP model|there are no views)"):
            load_scene(folder)


def test_photos_without_a_pose_are_warned_of(small: Path, tmp_path: Path) -> None:
    model = copy_model(small, tmp_path / "plant")
    (tmp_path / "plant" / "images").mkdir(exist_ok=True)
    (tmp_path / "plant" / "images" / "stranger.jpg").write_bytes(b"")
    with warns_of("photos_without_pose"):
        scene = read_colmap(model, tmp_path / "plant")
    assert "stranger" not in [view.name for view in scene.views]


@pytest.mark.parametrize("kind", ["text", "binary"])
@pytest.mark.parametrize("place", ["sparse", "colmap/sparse"])
def test_of_several_models_that_with_the_most_photos_is_taken(place: str, kind: str, tmp_path: Path) -> None:
    for number, count in ((0, 2), (1, 5), (10, 3)):
        (tmp_path / place / str(number)).mkdir(parents=True)
        model = build_model(dict(list(LENSES.items())[:count]))
        getattr(model, f"write_{kind}")(tmp_path / place / str(number))
    with warns_of("several_models") as noticed:
        scene = load_scene(tmp_path)
    assert (noticed[0].values["count"], noticed[0].values["taken"]) == (3, "1")
    assert scene.source == tmp_path / place / "1"
    assert len(scene.views) == 5
    for number in (0, 10):
        shutil.rmtree(tmp_path / place / str(number))
    assert len(load_scene(tmp_path).views) == 5  # alone, under any number, without a warning


def test_a_model_in_sparse_itself_goes_first(small: Path, tmp_path: Path) -> None:
    folder = tmp_path / "plant"
    shutil.copytree(small, folder)
    shutil.copytree(small / "sparse", folder / "sparse" / "0")
    assert load_scene(folder).source == folder / "sparse"
    assert find_colmap_model(tmp_path) is None


def test_a_name_that_is_no_utf_8_is_refused(small: Path, tmp_path: Path) -> None:
    pycolmap.Reconstruction(small / "sparse").write_text(tmp_path)
    images = tmp_path / "images.txt"
    images.write_bytes(images.read_bytes().replace(b".png", b"\xff.png").replace(b".jpg", b"\xff.jpg"))
    with pytest.raises(InputError, match="cannot be read as a COLMAP model"):
        read_colmap(tmp_path, tmp_path)


def test_names_with_spaces(tmp_path: Path) -> None:
    """pycolmap cuts names at a space; here one camera has no points, and one name two spaces and a suffix."""
    model = build_model({"PINHOLE": PINHOLES["PINHOLE"], "SIMPLE_PINHOLE": PINHOLES["SIMPLE_PINHOLE"]})
    model.images[1].name, model.images[2].name = "A plant (1).jpg", "A plant  (2).jpg"
    (tmp_path / "sparse").mkdir()
    model.write_text(tmp_path / "sparse")
    lines = (tmp_path / "sparse" / "images.txt").read_text().splitlines()
    lines[lines.index(next(line for line in lines if line.endswith("(1).jpg"))) + 1] = ""
    (tmp_path / "sparse" / "images.txt").write_text("\n".join(lines) + "\n")
    (tmp_path / "sparse" / "points3D.txt").write_text("")
    scene = load_scene(tmp_path)
    assert sorted(view.path.name for view in scene.views) == ["A plant  (2).jpg", "A plant (1).jpg"]
