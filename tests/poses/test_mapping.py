"""Structure from motion of a rendered room, whose cameras are known."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest

from mvseg.errors import InputError
from mvseg.formats.image_file import write_png
from mvseg.formats.opencv_yaml import Calibration
from mvseg.formats.photos import read_photo
from mvseg.formats.rig import read_rig
from mvseg.poses import features, mapping
from mvseg.poses.alignment import fit_similarity
from mvseg.poses.config import PoseConfig
from mvseg.poses.mapping import IMAGES, find_structure, move_structure, write_cameras, write_structure
from mvseg.poses.numbers import STRUCTURE
from mvseg.poses.photo_files import PhotoFile, copy_photos, list_photos
from room_scene import FOCAL, HEIGHT, WIDTH, draw_room, room_cameras, texture
from watched_stages import watch_stages


def test_all_photos_register_where_they_were_taken(room) -> None:
    structure, truth = room.structure, room.truth
    assert structure.registered == tuple(photo.name for photo in room.files)
    assert (structure.left_out, structure.other_models) == ((), ())
    assert structure.residual_px < 0.5
    centers, true_centers = room.scene.cameras.centers.numpy(), truth.centers.numpy()
    similarity = fit_similarity(centers, true_centers)
    assert np.abs(similarity * centers - true_centers).max() < 2  # mm, at 600 mm
    assert room.scene.cameras.K[0, 0, 0] == pytest.approx(FOCAL, rel=0.01)
    turned = room.scene.cameras.R.numpy() @ similarity.rotation.matrix().T
    angles = np.degrees(np.linalg.norm(turned - truth.R.numpy(), axis=(1, 2)) / np.sqrt(2))
    assert angles.max() < 0.3


def test_photos_may_have_spaces_in_their_names_and_one_shares_a_camera(room) -> None:
    assert len(room.structure.model.cameras) == 1
    assert not list(room.folder.glob("colmap-*"))  # the database is gone


def test_a_moved_world_shows_the_same_photos(room, tmp_path: Path) -> None:
    """Rig file and COLMAP model say the same; points keep their pixels."""
    folder = shutil.copytree(room.folder, tmp_path / "scene")
    similarity = pycolmap.Sim3d(
        3.0, pycolmap.Rotation3d(np.array([[0, -1.0, 0], [0, 0, -1], [1, 0, 0]])), np.array([5.0, 6, 7])
    )
    structure = replace(room.structure, model=pycolmap.Reconstruction(room.folder / "sparse" / "0"))
    points = np.array([point.xyz for point in structure.model.points3D.values()])
    before, _ = write_structure(structure, folder).cameras.project(room.scene.cameras.centers.new_tensor(points))
    scene = replace(move_structure(structure, similarity, folder), unit="mm", up=(0.0, 0.0, 1.0))
    moved = scene.cameras.centers.new_tensor(similarity * points)
    after, depths = scene.cameras.project(moved)
    np.testing.assert_allclose(after.numpy(), before.numpy(), atol=1e-6)
    assert (depths > 0).all()
    write_cameras(scene, folder)
    rig = read_rig(folder / "cameras.json")
    assert (rig.unit, rig.up) == ("mm", (0.0, 0.0, 1.0))
    assert [view.name for view in rig.views] == [view.name for view in scene.views]
    np.testing.assert_allclose(rig.cameras.project(moved)[0].numpy(), after.numpy(), atol=1e-9)
    assert np.abs(read_photo(rig, 0).astype(int) - read_photo(scene, 0)).max() <= 1  # the same lens


@pytest.mark.slow
def test_a_calibrated_camera_stays_and_a_photo_without_texture_is_left_out(room, tmp_path: Path) -> None:
    source, names = list_photos(room.folder / IMAGES)
    files = copy_photos(source, names[:4], tmp_path)
    write_png(tmp_path / "grey.png", np.full((HEIGHT, WIDTH, 3), 120, np.uint8))
    files.insert(2, PhotoFile("grey.png", WIDTH, HEIGHT))
    K = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL + 1, HEIGHT / 2], [0, 0, 1]])
    calibration = Calibration(K=K, distortion=(), is_fisheye=False, width=None, height=None)
    structure = find_structure(tmp_path, files, config=PoseConfig(), calibration=calibration)
    assert structure.left_out == ("grey.png",)
    assert structure.registered == tuple(names[:4])
    (camera,) = structure.model.cameras.values()
    np.testing.assert_array_equal(camera.calibration_matrix(), K)


def test_one_quick_mapping_where_it_succeeds(room) -> None:
    assert room.steps == ("find_features", "match_features 21", "_map")


@pytest.mark.slow
def test_photos_that_chosen_pairs_leave_out_are_compared_with_all(room, monkeypatch: pytest.MonkeyPatch) -> None:
    steps = watch_stages(monkeypatch)
    monkeypatch.setattr(mapping, "choose_pairs", lambda names, how, alike: [(0, 1), (0, 2), (1, 2), (4, 5)])
    structure = find_structure(room.folder / IMAGES, room.files, config=PoseConfig())
    assert steps == ["find_features", "match_features 4", "_map", "match_features 17", "_map"]
    assert structure.registered == tuple(photo.name for photo in room.files)
    asked = PoseConfig(pairs="sequential", min_registered=3)  # pairs that were asked for stay
    assert len(find_structure(room.folder / IMAGES, room.files, config=asked).registered) == 3


@pytest.mark.slow
def test_too_few_matches_ask_for_more_features(room, monkeypatch: pytest.MonkeyPatch) -> None:
    steps = watch_stages(monkeypatch)
    monkeypatch.setattr(features, "STRUCTURE", replace(STRUCTURE, quick_most=12))
    structure = find_structure(room.folder / IMAGES, room.files, config=PoseConfig())
    assert steps[-3:] == ["extract_features", "match_features 21", "_map"]
    assert structure.registered == tuple(photo.name for photo in room.files)
    centers = np.array([image.projection_center() for image in structure.model.images.values()])
    order = [int(Path(image.name).stem) for image in structure.model.images.values()]
    true_centers = room.truth.centers.numpy()[order]
    assert np.abs(fit_similarity(centers, true_centers) * centers - true_centers).max() < 2  # mm


def test_a_backdrop_that_stays_matches_nothing(tmp_path: Path) -> None:
    """As on a turntable before a poster: a third of each photo shows the same, at the same pixels."""
    backdrop = cv2.resize(texture(9, grains=(8, 20, 60)), (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA)
    rng, photos, is_backdrop = np.random.default_rng(0), [], []
    for photo in draw_room(room_cameras(9, focal=250)[[3, 4]]):
        is_backdrop.append((photo == photo[0, 0]).all(2))
        photo[is_backdrop[-1]] = backdrop[is_backdrop[-1]]
        name = f"{len(photos)}.png"
        write_png(tmp_path / name, np.clip(photo + rng.normal(size=photo.shape) * 2, 0, 255).astype(np.uint8))
        photos.append(PhotoFile(name, WIDTH, HEIGHT))
    database, numbered = tmp_path / "photos.db", features.number_photos(tmp_path, photos, tmp_path / "numbered")
    features.make_database(database, tmp_path / "numbered", numbered, config=PoseConfig(), lens=None)
    features.find_features(database, tmp_path / "numbered", list(numbered), image_size=WIDTH)
    features.match_features(database, list(numbered), [(0, 1)])
    with pycolmap.Database.open(database) as opened:
        one, other = opened.read_two_view_geometry(1, 2).inlier_matches.T
        px, other_px = opened.read_keypoints(1)[one, :2], opened.read_keypoints(2)[other, :2]
    assert len(one) > 200
    assert np.linalg.norm(px - other_px, axis=1).min() > 3
    column, row = px.astype(int).T
    assert np.mean(is_backdrop) > 0.3
    assert is_backdrop[0][row, column].mean() < 0.02


def test_too_few_photos_are_one_sentence(tmp_path: Path) -> None:
    files = []
    for name in ("a.png", "b.png", "c.png"):
        write_png(tmp_path / name, np.full((64, 80, 3), 120, np.uint8))
        files.append(PhotoFile(name, 80, 64))
    message = r"^0 of 3 photos could be registered, expected at least 3; 3 have hardly any texture, .* a.png\. Next"
    with pytest.raises(InputError, match=message):
        find_structure(tmp_path, files, config=PoseConfig())
    with pytest.raises(InputError, match=r"^0 of 3 .*--min_registered asks for 4"):
        find_structure(tmp_path, files, config=PoseConfig(min_registered=4))


def test_a_calibration_of_other_photos_is_refused(tmp_path: Path) -> None:
    files = [PhotoFile("a.png", 80, 64)]
    calibration = Calibration(K=np.eye(3), distortion=(), is_fisheye=False, width=64, height=80)
    with pytest.raises(InputError, match=r"a.png: the calibration is of 64 x 80 pixels, the photo has 80 x 64"):
        find_structure(tmp_path, files, config=PoseConfig(), calibration=calibration)
    fisheye = replace(calibration, distortion=(0.1, 0, 0, 0), is_fisheye=True, width=80, height=64)
    with pytest.raises(InputError, match="is of a fisheye"):
        find_structure(tmp_path, files, config=PoseConfig(), calibration=fisheye)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"image_size": 10}, "image_size is 10"),
        ({"min_registered": 1}, "min_registered is 1"),
        ({"frames": 2}, "frames is 2"),
        ({"calibration": Path("c.yaml"), "shared_camera": False}, "beside a calibration"),
    ],
)
def test_options_out_of_range(options, message: str) -> None:
    with pytest.raises(InputError, match=message):
        PoseConfig(**options)
