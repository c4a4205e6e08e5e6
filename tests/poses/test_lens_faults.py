"""What is wrong with the lens that photos share: of a synthetic cloud of points whose cameras are known."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pycolmap
import pytest

from mvseg.poses.cancellable import quiet_colmap
from mvseg.poses.lens_faults import find_lens_fault

MIDDLE = np.array([512.0, 384.0])
Floats = np.ndarray


def seen_by_one_lens(change: Callable[[Floats, int], Floats], *, focal: float = 900.0) -> pycolmap.Reconstruction:
    """Photos of a cloud of points whose pixels are changed, as an adjustment with one lens leaves them."""
    options = pycolmap.SyntheticDatasetOptions(num_rigs=1, num_cameras_per_rig=1, num_frames_per_rig=10)
    options.num_points3D, options.camera_model_id = 200, pycolmap.CameraModelId.SIMPLE_RADIAL
    options.camera_params = [focal, *MIDDLE, 0.0]
    pycolmap.set_random_seed(1)
    model = pycolmap.synthesize_dataset(options)
    rng = np.random.default_rng(0)
    for number, image in model.images.items():
        for point in image.points2D:
            point.xy = change(point.xy + rng.normal(0, 0.3, 2), number)
    with quiet_colmap():
        pycolmap.bundle_adjustment(model, pycolmap.BundleAdjustmentOptions(print_summary=False))
    model.update_point_3d_errors()
    return model


def about_middle(px: Floats, factor: object) -> Floats:
    return MIDDLE + (px - MIDDLE) * factor


@pytest.mark.parametrize(
    ("change", "code"),
    [
        (lambda px, _: px, None),
        (lambda px, number: about_middle(px, 1.3 if number % 2 else 1.0), "zooms"),
        (lambda px, number: about_middle(px, 1.01 if number % 2 else 1.0), None),  # a lens that focuses anew
        (lambda px, _: about_middle(px, (0.75, 1.0)), "squashed"),
        (lambda px, _: px - (200.0, 0.0), "photos_cut"),
        (lambda px, number: px + 150 * np.array([np.sin(number * 2.4), np.cos(number * 2.4)]), "photos_cut_each"),
    ],
    ids=["right", "zooms", "focus", "squashed", "cut", "cut each"],
)
def test_the_cause_that_mends_it_is_named(change: Callable[[Floats, int], Floats], code: str | None) -> None:
    model = seen_by_one_lens(change)
    report = find_lens_fault(model)
    assert (None if report.finding is None else report.finding.code) == code
    if code == "squashed":
        assert report.finding is not None
        assert report.finding.values["aspect"] == pytest.approx(4 / 3, rel=0.02)
        (camera,) = report.model.cameras.values()
        assert camera.params[0] / camera.params[1] == pytest.approx(0.75, rel=0.02)
    else:
        assert report.model is model


def test_a_fisheye() -> None:
    """Ten photos of points around, up to 65 degrees off the axis: a lens with radial distortion cannot bend so."""
    rng, model = np.random.default_rng(0), pycolmap.Reconstruction()
    camera = pycolmap.Camera(model="SIMPLE_RADIAL", width=1024, height=768, params=[400, *MIDDLE, 0], camera_id=1)
    model.add_camera_with_trivial_rig(camera)
    polar, turn = np.arccos(rng.uniform(np.cos(np.radians(65)), 1, 300)), rng.uniform(0, 2 * np.pi, 300)
    ways = np.stack([np.sin(polar) * np.cos(turn), np.sin(polar) * np.sin(turn), np.cos(polar)], 1)
    points, pixels = ways * rng.uniform(2, 4, (300, 1)), []
    for number in range(1, 11):
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(rng.normal(0, 0.1, 3)), rng.normal(0, 0.4, 3))
        seen = points @ pose.rotation.matrix().T + pose.translation
        far = np.linalg.norm(seen[:, :2], axis=1)
        pixels.append(MIDDLE + 400 * seen[:, :2] * (np.arctan2(far, seen[:, 2]) / far)[:, None])
        pixels[-1] += rng.normal(0, 0.3, (300, 2))
        image = pycolmap.Image(name=f"{number}.jpg", keypoints=pixels[-1], camera_id=1, image_id=number)
        model.add_image_with_trivial_frame(image, pose)
    for index, point in enumerate(points):
        track = pycolmap.Track([pycolmap.TrackElement(number, index) for number in range(1, 11)])
        model.add_point3D(point, track, np.zeros(3, np.uint8))
    with quiet_colmap():
        pycolmap.bundle_adjustment(model, pycolmap.BundleAdjustmentOptions(print_summary=False))
    model.update_point_3d_errors()
    report = find_lens_fault(model)
    assert report.finding is not None
    assert report.finding.code == "wide_lens"


def test_other_lenses_are_not_asked() -> None:
    model = seen_by_one_lens(lambda px, _: px)
    for camera in model.cameras.values():
        camera.model, camera.params = pycolmap.CameraModelId.PINHOLE, [900.0, 900.0, 512.0, 384.0]
    report = find_lens_fault(model)
    assert report.finding is None
    assert report.model is model
