"""A turntable whose calibration went wrong by some tenths of a degree: what the plant's own features make of it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mvseg.poses.table_fit import TableCamera
from mvseg.poses.table_refinement import Shots, Table, Tracks, refine_table, triangulate_tracks
from turntable_board import ANGLES, HEIGHT, SIDE_R, SIDE_T, WIDTH, K, R, T

NOISE_PX = 0.3


def true_table(num_cameras: int) -> Table:
    poses = [(R, T), (SIDE_R, SIDE_T)][:num_cameras]
    cameras = [TableCamera(K=K, distortion=np.zeros(5), R=R, t=t, size=(WIDTH, HEIGHT)) for R, t in poses]
    return Table(cameras, ANGLES.copy())


def shots_of(table: Table) -> Shots:
    """Every camera at every angle."""
    camera, angle = np.meshgrid(np.arange(len(table.cameras)), np.arange(len(table.angles)), indexing="ij")
    return Shots(camera=camera.ravel(), angle=angle.ravel())


def poses_of(table: Table, shots: Shots) -> list[tuple[np.ndarray, np.ndarray]]:
    pairs = zip(shots.camera, shots.angle, strict=True)
    return [table.cameras[camera].pose(table.angles[angle]) for camera, angle in pairs]


def matrices_of(table: Table, shots: Shots) -> np.ndarray:
    """(V, 3, 4) px_from_world."""
    return np.stack([K @ np.column_stack(pose) for pose in poses_of(table, shots)])


def see_points(table: Table, *, num_points: int = 240, share_wrong: float = 0.05) -> Tracks:
    """Points of a plant on the table, each seen in half of the photos; some of the sightings are wrong."""
    rng = np.random.default_rng(0)
    points = rng.uniform([-60, -60, 0], [60, 60, 90], (num_points, 3))
    shots = shots_of(table)
    matrices = matrices_of(table, shots)
    cam = np.einsum("vij,pj->pvi", matrices, np.column_stack([points, np.ones(num_points)]))
    px = cam[..., :2] / cam[..., 2:] + rng.normal(scale=NOISE_PX, size=(*cam.shape[:2], 2))
    px[rng.random(px.shape[:2]) < share_wrong] += 40
    track, view = np.nonzero(rng.random(px.shape[:2]) < 0.5)
    tracks = Tracks(track=track, view=view, px=px[track, view])
    return tracks.select(np.ones(len(track), bool))


def disturb(table: Table, *, degrees: float = 0.3) -> Table:
    """Each camera tilted against the axis, and other angles."""
    rng = np.random.default_rng(1)
    turn = Rotation.from_rotvec([np.radians(degrees), 0, 0]).as_matrix()
    angles = table.angles + np.append(0, rng.normal(scale=degrees, size=len(table.angles) - 1))
    return Table([replace(camera, R=camera.R @ turn) for camera in table.cameras], angles)


def pose_errors(table: Table, truth: Table) -> tuple[float, float]:
    """Largest errors of the poses of photos against the first one: degrees, and shares of the distance from the axis.

    The scale, which no feature knows, does not count.
    """
    turns, shifts = [], []
    for each in (table, truth):
        poses = poses_of(each, shots_of(truth))
        first, shift = poses[0]
        turns.append(np.array([turn @ first.T for turn, _ in poses]))
        shifts.append(np.array([t - turn @ first.T @ shift for turn, t in poses]))
    degrees = np.degrees(Rotation.from_matrix(turns[0] @ turns[1].transpose(0, 2, 1)).magnitude())
    scale = (shifts[0] * shifts[1]).sum() / (shifts[0] ** 2).sum()
    away = np.linalg.norm(scale * shifts[0] - shifts[1], axis=1)
    return float(degrees.max()), float(away.max() / np.linalg.norm(T))


@pytest.mark.parametrize("num_cameras", [1, 2])
def test_features_bring_the_poses_back(num_cameras: int) -> None:
    truth = true_table(num_cameras)
    wrong, tracks = disturb(truth), see_points(truth)
    found = refine_table(wrong, shots_of(truth), tracks)
    assert found.is_taken
    before, after = found.held_out_px
    assert after < before
    was, is_now = (np.array(pose_errors(each, truth)) for each in (wrong, found.table))
    assert was[0] > 0.3
    assert is_now[0] < 0.15
    assert (is_now < was / 4).all()
    for old, new in zip(wrong.cameras, found.table.cameras, strict=True):  # the world stays: a tenth of the distance
        assert np.linalg.norm(old.R.T @ old.t - new.R.T @ new.t) < 0.01 * np.linalg.norm(T)
    assert found.table.angles[0] == pytest.approx(wrong.angles[0])


def test_cameras_that_took_turns() -> None:
    """No angle at which both took a photo: places in the rig and angles cannot be told apart."""
    truth = true_table(2)
    wrong, tracks, shots = disturb(truth), see_points(truth, num_points=480, share_wrong=0), shots_of(truth)
    takes_part = (shots.camera == shots.angle % 2)[tracks.view]
    found = refine_table(wrong, shots, tracks.select(takes_part))
    assert found.table is wrong
    assert found.reason == "camera 1 took no photo at an angle at which camera 0 did: kept"


def test_a_right_calibration_stays_right() -> None:
    truth = true_table(2)
    found = refine_table(truth, shots_of(truth), see_points(truth))
    assert not found.is_taken
    assert found.table is truth
    assert found.reason.endswith("other points are not clearly nearer to where they are seen: kept")


def test_too_few_features_change_nothing() -> None:
    truth = true_table(1)
    wrong = disturb(truth)
    found = refine_table(wrong, shots_of(truth), see_points(truth, num_points=30))
    assert not found.is_taken
    assert found.table is wrong
    assert "points, expected 50 or more: kept" in found.reason
    tracks = see_points(truth)
    hidden = refine_table(wrong, shots_of(truth), tracks.select(tracks.view != 3))
    assert hidden.reason == "angle 3 shows 0 of the points, expected 12 or more: kept"


def test_features_that_belong_to_nothing_change_nothing() -> None:
    truth = true_table(1)
    tracks = see_points(truth)
    px = np.random.default_rng(3).uniform([0, 0], [WIDTH, HEIGHT], tracks.px.shape)
    found = refine_table(truth, shots_of(truth), replace(tracks, px=px))
    assert not found.is_taken
    assert found.table is truth


def test_points_come_back_in_any_world() -> None:
    """Slow twin: the point that projects nearest, by least squares."""
    truth = true_table(2)
    tracks = see_points(truth, num_points=20, share_wrong=0)
    matrices = matrices_of(truth, shots_of(truth))
    points = triangulate_tracks(matrices, tracks)
    for scale in (1e-3, 1e3):
        scaled = matrices * [1, 1, 1, scale]
        np.testing.assert_allclose(triangulate_tracks(scaled, tracks), scale * points, rtol=1e-6)
    for number, point in enumerate(points):
        here = tracks.track == number
        seen = zip(tracks.px[here], matrices[tracks.view[here]], strict=True)
        rows = [px[:, None] * matrix[2] - matrix[:2] for px, matrix in seen]
        stacked = np.concatenate([row / np.linalg.norm(matrices[0][2, :3]) for row in rows])
        plain = np.linalg.lstsq(stacked[:, :3], -stacked[:, 3], rcond=None)[0]
        np.testing.assert_allclose(point, plain, atol=0.2)
