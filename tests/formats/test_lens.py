"""Lens distortion against OpenCV, whose pixel centres are whole numbers: half a pixel less than ours."""

from __future__ import annotations

import tracemalloc

import cv2
import numpy as np
import pycolmap
import pytest
from scipy import ndimage

from mvseg.formats.lens import (
    _positions,
    distort,
    opencv_distortion,
    opencv_lens,
    photo_from_pinhole,
    pinhole_from_photo,
    undistort,
)

WIDTH, HEIGHT = 160, 120
K = np.array([[150.0, 0, 81.3], [0, 155.0, 58.2], [0, 0, 1]])
OPENCV_K = K - np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
COEFFICIENTS = {
    "barrel": [-0.25, 0.08, 0.001, -0.002],
    "pincushion": [0.15, 0.02, -0.001, 0.001, 0.01],
    "rational": [-0.2, 0.05, 0.001, 0.001, 0.01, 0.05, 0.01, 0.002],
}
FISHEYE = [0.03, -0.01, 0.004, -0.001]


@pytest.fixture(params=COEFFICIENTS)
def coefficients(request: pytest.FixtureRequest) -> list[float]:
    return COEFFICIENTS[request.param]


def lens_of(coefficients: list[float]) -> pycolmap.Camera:
    return opencv_lens(K, coefficients, width=WIDTH, height=HEIGHT)


def fisheye_lens(focal: float = 80.0) -> tuple[pycolmap.Camera, np.ndarray]:
    params = [focal, focal, WIDTH / 2, HEIGHT / 2, *FISHEYE]
    lens = pycolmap.Camera(model="OPENCV_FISHEYE", width=WIDTH, height=HEIGHT, params=params)
    return lens, np.array(lens.calibration_matrix())


def pixels(step: int = 7) -> np.ndarray:
    """(P, 2) float64 positions all over the image, not only centres."""
    rows, columns = np.mgrid[0.2:HEIGHT:step, 0.7:WIDTH:step]
    return np.stack((columns.ravel(), rows.ravel()), 1)


def centers() -> np.ndarray:
    rows, columns = np.indices((HEIGHT, WIDTH)) + 0.5
    return np.stack((columns.ravel(), rows.ravel()), 1)


def paint_blobs(xy: np.ndarray) -> np.ndarray:
    """(H, W) uint16: what an ideal pinhole would see at (H W, 2) positions: a checker of numbered discs."""
    cell = np.floor(xy / 20)
    number = 1 + cell[:, 0] + 8 * cell[:, 1]
    hit = np.linalg.norm(xy - 20 * cell - 10, axis=1) < 7
    inside = (xy >= 0).all(1) & (xy < (WIDTH, HEIGHT)).all(1)
    return np.where(hit & inside, number, 0).astype(np.uint16).reshape(HEIGHT, WIDTH)


def test_projection_agrees_with_opencv(coefficients: list[float]) -> None:
    rays = np.concatenate((pixels(), np.ones((len(pixels()), 1))), 1) @ np.linalg.inv(K).T
    expected, _ = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), OPENCV_K, np.array(coefficients))
    found = photo_from_pinhole(lens_of(coefficients), K, pixels())
    np.testing.assert_allclose(found - 0.5, expected[:, 0], atol=1e-9)
    assert np.abs(found - pixels()).max() > 1  # there was something to do


def test_inverse_agrees_with_opencv(coefficients: list[float]) -> None:
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 200, 1e-12)
    arguments = ((pixels() - 0.5)[:, None], OPENCV_K, np.array(coefficients))
    if hasattr(cv2, "undistortPointsIter"):  # until OpenCV 5
        expected = cv2.undistortPointsIter(*arguments, None, OPENCV_K, criteria)[:, 0]
    else:
        expected = cv2.undistortPoints(*arguments, P=OPENCV_K, criteria=criteria)[:, 0]
    np.testing.assert_allclose(pinhole_from_photo(lens_of(coefficients), K, pixels()) - 0.5, expected, atol=1e-5)


def test_fisheye_agrees_with_opencv() -> None:
    lens, matrix = fisheye_lens()
    rays = (pixels() - matrix[:2, 2]) / matrix[0, 0]
    expected = cv2.fisheye.distortPoints(rays[:, None], matrix, np.array(FISHEYE))[:, 0]
    np.testing.assert_allclose(photo_from_pinhole(lens, matrix, pixels()), expected, atol=1e-9)


def test_skewed_pinhole_and_back() -> None:
    skewed = K + np.array([[0, 4.0, 0], [0, 0, 0], [0, 0, 0]])
    lens = lens_of(COEFFICIENTS["barrel"])
    photo = photo_from_pinhole(lens, skewed, pixels())
    np.testing.assert_allclose(pinhole_from_photo(lens, skewed, photo), pixels(), atol=1e-6)


def test_undistorted_photo_agrees_with_opencv(coefficients: list[float]) -> None:
    rng = np.random.default_rng(0)
    photo = cv2.GaussianBlur(rng.integers(0, 255, (HEIGHT, WIDTH, 3), dtype=np.uint8), (0, 0), 3)
    maps = cv2.initUndistortRectifyMap(
        OPENCV_K, np.array(coefficients), np.eye(3), OPENCV_K, (WIDTH, HEIGHT), cv2.CV_32FC1
    )
    expected = cv2.remap(photo, *maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=0)
    found = undistort(photo, lens_of(coefficients), K)
    assert np.abs(found.astype(int) - expected).max() <= 2  # roundings of the positions to 1/32 pixel
    assert np.abs(photo.astype(int) - expected).max() > 20


def test_labels_there_and_back_are_the_same_away_from_borders(coefficients: list[float]) -> None:
    lens, labels = lens_of(coefficients), paint_blobs(centers())
    back = undistort(distort(labels, lens, K), lens, K)
    seen = undistort(np.ones_like(labels), lens, K) > 0
    within = (ndimage.minimum_filter(labels, 5) == ndimage.maximum_filter(labels, 5)) & ndimage.binary_erosion(seen)
    assert within.mean() > 0.3
    np.testing.assert_array_equal(back[within], labels[within])
    assert set(np.unique(back)) <= set(np.unique(labels))  # numbers are never mixed
    assert back.dtype == labels.dtype


@pytest.mark.parametrize("kind", [*COEFFICIENTS, "fisheye"])
def test_masks_move_with_the_photo(kind: str) -> None:
    """Discs seen through a lens (by OpenCV's inverse) are discs again, where the pinhole shows them."""
    if kind == "fisheye":
        lens, matrix = fisheye_lens()
        rays = cv2.fisheye.undistortPoints(centers()[:, None], matrix, np.array(FISHEYE))[:, 0]
        seen_at = rays @ matrix[:2, :2].T + matrix[:2, 2]
    else:
        lens, matrix = lens_of(COEFFICIENTS[kind]), K
        rays = cv2.undistortPoints((centers() - 0.5)[:, None], OPENCV_K, np.array(COEFFICIENTS[kind]))[:, 0]
        seen_at = rays @ K[:2, :2].T + K[:2, 2]
    masks = paint_blobs(seen_at)
    photo = np.where(masks > 0, 250, 10).astype(np.uint8)[..., None].repeat(3, 2)
    ideal = paint_blobs(centers())
    moved = undistort(masks, lens, matrix)
    shown = undistort(np.ones_like(masks), lens, matrix) > 0
    whole = [number for number in np.unique(ideal)[1:] if shown[ideal == number].all()]
    assert len(whole) >= 15
    shifts = []
    for number in whole:
        common, both = ((ideal == number) & (moved == number)).sum(), ((ideal == number) | (moved == number)).sum()
        assert common / both > 0.85, number
        shifts.append(np.subtract(ndimage.center_of_mass(moved == number), ndimage.center_of_mass(ideal == number)))
    assert np.abs(shifts).max() < 0.5  # nearest neighbours, twice
    assert np.abs(np.mean(shifts, 0)).max() < 0.06
    assert ((undistort(photo, lens, matrix)[..., 0] > 130) == (moved > 0))[shown].mean() > 0.97
    assert (masks != ideal).mean() > 0.03  # there was something to do


def test_a_lens_polynomial_that_turns_back_shows_nothing_twice() -> None:
    matrix = np.array([[70.0, 0, WIDTH / 2], [0, 70.0, HEIGHT / 2], [0, 0, 1]])  # corners beyond r (1 - 0.3 r^2)'s top
    lens = opencv_lens(matrix, [-0.3, 0, 0, 0], width=WIDTH, height=HEIGHT)
    far = np.array([[0.5, 0.5]])
    folded = photo_from_pinhole(lens, matrix, far)
    assert not np.allclose(pinhole_from_photo(lens, matrix, folded), far, atol=1)  # the corner lands on other rays
    shown = undistort(np.ones((HEIGHT, WIDTH), np.uint8), lens, matrix)
    radius = np.linalg.norm((centers() - matrix[:2, 2]) / 70, axis=1).reshape(HEIGHT, WIDTH)
    assert (shown[radius < 1.0] == 1).all()
    assert (shown[radius > 1.15] == 0).all()


def test_beyond_90_degrees_a_fisheye_gets_no_labels() -> None:
    lens, matrix = fisheye_lens(focal=40.0)
    angle = np.linalg.norm(centers() - matrix[:2, 2], axis=1).reshape(HEIGHT, WIDTH) / 40  # about, without k1 to k4
    labels = distort(np.full((HEIGHT, WIDTH), 7, np.uint16), lens, matrix)
    assert opencv_distortion(lens) is None
    assert angle.max() > 2
    assert (labels[angle > 1.7] == 0).all()
    assert (labels[angle < 0.8] == 7).all()


def test_without_lens_the_image_stays_and_lenses_in_turn_do_not_disturb_each_other() -> None:
    labels = paint_blobs(centers())
    assert undistort(labels, None, K) is labels
    assert distort(labels, None, K) is labels
    labels = paint_blobs(centers())
    first = {name: undistort(labels, lens_of(values), K) for name, values in COEFFICIENTS.items()}
    for name, values in COEFFICIENTS.items():
        np.testing.assert_array_equal(undistort(labels, lens_of(values), K), first[name])
    assert (first["barrel"] != first["pincushion"]).any()


@pytest.mark.parametrize(
    ("model", "params"),
    [
        ("SIMPLE_PINHOLE", [150, 80, 60]),
        ("PINHOLE", [150, 155, 80, 60]),
        ("SIMPLE_RADIAL", [150, 80, 60, -0.1]),
        ("RADIAL", [150, 80, 60, -0.1, 0.02]),
        ("OPENCV", [150, 155, 80, 60, -0.1, 0.02, 0.001, -0.002]),
        ("FULL_OPENCV", [150, 155, 80, 60, -0.1, 0.02, 0.001, -0.002, 0.01, 0.02, 0.003, 0.001]),
    ],
)
def test_lenses_of_colmap_are_opencvs(model: str, params: list[float]) -> None:
    lens = pycolmap.Camera(model=model, width=WIDTH, height=HEIGHT, params=params)
    coefficients = opencv_distortion(lens)
    assert coefficients is not None
    same = opencv_lens(lens.calibration_matrix(), coefficients, width=WIDTH, height=HEIGHT) or lens
    rays = np.random.default_rng(0).uniform(-0.4, 0.4, (20, 2))
    rays = np.column_stack([rays, np.ones(20)])
    np.testing.assert_allclose(same.img_from_cam(rays), lens.img_from_cam(rays), atol=1e-9)


def test_positions_are_computed_part_by_part(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whole rows at a time; the last part may have fewer."""
    K_large = K * [[4], [4], [1]]
    lens = opencv_lens(K_large, COEFFICIENTS["rational"], width=4 * WIDTH, height=4 * HEIGHT)
    labels = np.arange(16 * WIDTH * HEIGHT).reshape(4 * HEIGHT, -1) % 60_000
    _positions.cache_clear()
    whole = undistort(labels.astype(np.uint16), lens, K_large)
    for chunk in (1, 7 * 4 * WIDTH + 5):
        monkeypatch.setattr("mvseg.formats.lens.CHUNK", chunk)
        _positions.cache_clear()
        tracemalloc.start()
        np.testing.assert_array_equal(undistort(labels.astype(np.uint16), lens, K_large), whole)
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert peak < 4 * 8 * labels.size  # bytes: the positions take 8 of each pixel
    _positions.cache_clear()
