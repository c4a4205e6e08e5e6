"""A calibrated turntable refined by what the photos show of the plant itself.

Seen from the table, C cameras that stand still are a rig of C sensors, and A angles are A frames of it: COLMAP's bundle
adjustment refines the points, the poses of the frames and those of the sensors in the rig. It lets every frame go
anywhere; the points it finds are then a known shape, to which cameras, axis and angles are fitted as to a board. Lenses
stay as they are calibrated. What comes out is measured on features that took no part.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial.transform import Rotation

from mvseg.formats.lens import opencv_lens
from mvseg.poses.board_calibration import axes_about, find_axis
from mvseg.poses.cancellable import run_cancellable
from mvseg.poses.config import PoseConfig
from mvseg.poses.features import extract_features, match_features, number_photos
from mvseg.poses.pairs import choose_pairs
from mvseg.poses.photo_files import PhotoFile
from mvseg.poses.table_fit import Floats, Ints, Sightings, TableCamera, fit_table, turn_z

LEAST_VIEWS = 3  # of a point
LEAST_POINTS = 50  # that take part, and as many again that do not
LEAST_SEEN = 12  # points of the first kind at every angle, and by every camera
NUM_ROUNDS = 2
MOST_ERROR = 4.0  # times the median; sightings that are farther off are wrong
LEAST_GAIN = 0.1  # of the median distance; less is chance
LEAST_ERROR_PX = 2.0  # that makes a sighting wrong


@dataclass(frozen=True, eq=False)
class Table:
    """C cameras around a table, and its A angles in degrees."""

    cameras: list[TableCamera]
    angles: Floats


@dataclass(frozen=True, eq=False)
class Refinement:
    """A table after its refinement.

    Attributes:
        table: refined, or as it was.
        is_taken: it is refined.
        reason: why, in one sentence.
        num_points: of the plant, that took part.
        held_out_px: median distance between sightings that took no part and their points, before and after; None where
            it did not get that far.
    """

    table: Table
    is_taken: bool
    reason: str
    num_points: int
    held_out_px: tuple[float, float] | None = None


@dataclass(frozen=True, eq=False)
class Tracks:
    """Features that belong together: P sightings of T points in V photos, without lens distortion.

    Attributes:
        track: (P,) int64, the point; ordered, without gaps.
        view: (P,) int64, the photo.
        px: (P, 2) float64, as a pinhole with the camera's K would see it.
    """

    track: Ints
    view: Ints
    px: Floats

    @property
    def num_points(self) -> int:
        return int(self.track.max(initial=-1)) + 1

    def select(self, keep: NDArray[np.bool_]) -> Tracks:
        """The sightings (P,) to keep, of points that still have enough of them."""
        counts = np.bincount(self.track[keep], minlength=self.num_points)
        keep = keep & (counts >= LEAST_VIEWS)[self.track]
        _, track = np.unique(self.track[keep], return_inverse=True)
        return Tracks(track=track.astype(np.int64), view=self.view[keep], px=self.px[keep])


@dataclass(frozen=True, eq=False)
class Shots:
    """Which camera (V,) took each photo, and at which angle (V,): int64."""

    camera: Ints
    angle: Ints


def refine_table(table: Table, shots: Shots, tracks: Tracks) -> Refinement:
    """The table as the features in its photos want it, if there are enough of them, and others confirm it.

    Every fourth point takes no part in the refinement: it tells whether that was one. Height, direction and scale of
    the world, which the plant does not know, stay those of the calibration: the cameras keep their mean distance from
    the axis.

    Args:
        table: as it was calibrated.
        shots: of V photos.
        tracks: of the same photos, see `find_tracks`.
    """
    is_apart = tracks.track % 4 == 3
    part, apart = tracks.select(~is_apart), tracks.select(is_apart)
    found, before = table, _median_error(table, shots, apart)
    for _ in range(NUM_ROUNDS):
        part = _drop_wrong(found, shots, part)
        missing = _too_few(table, shots, part=part, apart=apart)
        if missing:
            return Refinement(table, is_taken=False, reason=f"{missing}: kept", num_points=part.num_points)
        found = _keep_world(_adjust(found, shots, part), table)
    after = _median_error(found, shots, apart)
    is_better = after < (1 - LEAST_GAIN) * before
    says = "nearer to" if is_better else "not clearly nearer to"
    reason = f"{apart.num_points} other points are {says} where they are seen"
    return Refinement(
        table=found if is_better else table,
        is_taken=is_better,
        reason=reason if is_better else f"{reason}: kept",
        num_points=part.num_points,
        held_out_px=(before, after),
    )


def find_tracks(
    images: Path,
    photos: Sequence[PhotoFile],
    cameras: Sequence[TableCamera],
    *,
    work: Path | None = None,
    progress: bool = False,
) -> Tracks:
    """Features of V photos that COLMAP takes for the same, in three photos or more and once in each.

    Args:
        images: folder of the photos.
        photos: V.
        cameras: V, the camera of each photo.
        work: folder on whose disk COLMAP keeps its database meanwhile.
        progress: show progress bars.

    Raises:
        InputError: COLMAP cannot read a photo.
    """
    with tempfile.TemporaryDirectory(dir=work, prefix="colmap-") as folder:
        database, numbered = Path(folder) / "features.db", Path(folder) / "photos"
        names = number_photos(images, photos, numbered)
        extract_features(database, numbered, names, photos=photos, config=PoseConfig(), progress=progress)
        match_features(database, names, choose_pairs([photo.name for photo in photos]), progress=progress)
        with pycolmap.Database.open(database) as opened:
            place = {image.image_id: names.index(image.name) for image in opened.read_all_images()}
            px = {view: np.asarray(opened.read_keypoints(number), np.float64)[:, :2] for number, view in place.items()}
            pairs, geometries = opened.read_two_view_geometries()
    starts = np.cumsum([0, *(len(px[view]) for view in range(len(photos)))])
    links = [np.zeros((0, 2), np.int64)]
    for pair, geometry in zip(pairs, geometries, strict=True):
        first, second = (place[number] for number in pycolmap.pair_id_to_image_pair(pair))
        links.append(np.asarray(geometry.inlier_matches, np.int64).reshape(-1, 2) + starts[[first, second]])
    linked = np.concatenate(links)
    ones = np.ones(len(linked), bool)
    _, label = connected_components(coo_matrix((ones, linked.T), (starts[-1], starts[-1])), directed=False)
    view = np.repeat(np.arange(len(photos)), np.diff(starts))
    is_used = np.bincount(label)[label] >= LEAST_VIEWS
    _, per_photo, counts = np.unique(label * len(photos) + view, return_inverse=True, return_counts=True)
    is_twice = np.bincount(label, counts[per_photo] > 1)[label] > 0
    pick = np.flatnonzero(is_used & ~is_twice)
    pick = pick[np.argsort(label[pick], kind="stable")]
    ideal = np.concatenate([_undistort(px[index], camera) for index, camera in enumerate(cameras)])
    _, track = np.unique(label[pick], return_inverse=True)
    return Tracks(track=track.astype(np.int64), view=view[pick], px=ideal[pick])


def _undistort(px: Floats, camera: TableCamera) -> Floats:
    """(P, 2) where a pinhole with the same K sees what is seen at `px`."""
    if not len(px) or not camera.distortion.any():
        return np.asarray(px, float).reshape(-1, 2)
    lens = opencv_lens(camera.K, camera.distortion.tolist(), width=camera.size[0], height=camera.size[1])
    rays = lens.cam_from_img(np.asarray(px, float))
    return np.asarray(rays @ camera.K[:2, :2].T + camera.K[:2, 2])


def _too_few(table: Table, shots: Shots, *, part: Tracks, apart: Tracks) -> str:
    """Why there are not enough features, or nothing."""
    least = min(part.num_points, apart.num_points * 3)
    if least < LEAST_POINTS:
        return f"the photos share {least} points, expected {LEAST_POINTS} or more"
    for name, of_view, count in (
        ("angle", shots.angle, len(table.angles)), ("camera", shots.camera, len(table.cameras))
    ):  # fmt: skip
        seen = np.bincount(of_view[part.view], minlength=count)
        if seen.min() < LEAST_SEEN:
            return f"{name} {int(seen.argmin())} shows {seen.min()} of the points, expected {LEAST_SEEN} or more"
    used = np.unique(part.view)
    camera, angle = shots.camera[used], shots.angle[used]
    for each in range(1, len(table.cameras)):  # or else nothing tells its place in the rig from the angles
        if not np.isin(angle[camera == each], angle[camera == 0]).any():
            return f"camera {each} took no photo at an angle at which camera 0 did"
    return ""


def _matrices(table: Table, shots: Shots) -> Floats:
    """(V, 3, 4) px_from_world of the photos, without lens distortion."""
    matrices = []
    for camera, angle in zip(shots.camera, shots.angle, strict=True):
        R, t = table.cameras[camera].pose(table.angles[angle])
        matrices.append(table.cameras[camera].K @ np.column_stack([R, t]))
    return np.stack(matrices)


def triangulate_tracks(matrices: Floats, tracks: Tracks) -> Floats:
    """(T, 3) points that are seen nearly where they should be: least squares of the homogeneous equations.

    Args:
        matrices: (V, 3, 4) px_from_world.
        tracks: of V photos, without lens distortion.
    """
    scale = np.linalg.norm(matrices[:, :, :3], axis=2, keepdims=True)
    units = matrices / np.maximum(scale[:, 2:], 1e-300)  # the last row then gives depths
    here = units[tracks.view]
    rows = tracks.px[:, :, None] * here[:, 2:] - here[:, :2]
    # World units must not matter: distances are measured by how far the cameras are away.
    far = float(np.abs(units[:, 2, 3]).mean()) or 1.0
    rows[:, :, 3] /= far
    products = np.einsum("pri,prj->pij", rows, rows)
    sums = np.zeros((tracks.num_points, 4, 4))
    np.add.at(sums, tracks.track, products)
    homogeneous = np.linalg.eigh(sums)[1][:, :, 0]
    last = np.where(np.abs(homogeneous[:, 3:]) < 1e-12, 1e-12, homogeneous[:, 3:])
    return np.asarray(far * homogeneous[:, :3] / last)


def _errors(table: Table, shots: Shots, tracks: Tracks) -> Floats:
    """(P,) distance of each sighting from its point, pixels; infinite for points behind a camera."""
    matrices = _matrices(table, shots)
    points = triangulate_tracks(matrices, tracks)
    cam = np.einsum("pij,pj->pi", matrices[tracks.view], np.column_stack([points, np.ones(len(points))])[tracks.track])
    is_ahead = cam[:, 2] > 0
    px = cam[:, :2] / np.where(is_ahead, cam[:, 2], 1)[:, None]
    return np.where(is_ahead, np.linalg.norm(px - tracks.px, axis=1), np.inf)


def _median_error(table: Table, shots: Shots, tracks: Tracks) -> float:
    return float(np.median(_errors(table, shots, tracks))) if tracks.num_points else float("inf")


def _drop_wrong(table: Table, shots: Shots, tracks: Tracks) -> Tracks:
    """Without the sightings that are much farther off than most."""
    if not tracks.num_points:
        return tracks
    errors = _errors(table, shots, tracks)
    return tracks.select(errors <= max(LEAST_ERROR_PX, MOST_ERROR * float(np.median(errors))))


def _adjust(table: Table, shots: Shots, tracks: Tracks) -> Table:
    """Bundle adjustment of a rig, then the turntable that explains its points best, in a world of its own."""
    model = _rig_model(table, shots, tracks)
    options = pycolmap.BundleAdjustmentOptions(
        refine_focal_length=False,
        refine_principal_point=False,
        refine_extra_params=False,
        print_summary=False,
    )
    options.ceres.loss_function_type = pycolmap.LossFunctionType.SOFT_L1
    options.ceres.solver_options.num_threads = 1  # repeatable
    config = pycolmap.BundleAdjustmentConfig()
    for image in model.images:
        config.add_image(image)
    config.set_constant_rig_from_world_pose(1)
    run_cancellable(lambda _: pycolmap.create_default_bundle_adjuster(options, config, model).solve())
    poses = [_from_colmap(model.frames[index + 1].rig_from_world) for index in range(len(table.angles))]
    direction, point, angles = find_axis(poses)
    if direction @ table.cameras[0].R[:, 2] < 0:
        direction, angles = -direction, -angles
    rig_from_table = axes_about(direction), point
    cameras = []
    for index, camera in enumerate(table.cameras):
        sensor = pycolmap.sensor_t(pycolmap.SensorType.CAMERA, index + 1)
        sensor_turn, sensor_shift = (
            (Rotation.identity(), np.zeros(3)) if index == 0 else _from_colmap(model.rigs[1].sensor_from_rig(sensor))
        )
        R = (sensor_turn * rig_from_table[0]).as_matrix()
        pinhole = replace(camera, distortion=np.zeros(5))
        cameras.append(replace(pinhole, R=R, t=sensor_turn.apply(point) + sensor_shift))
    turn, shift = poses[0]
    table_from_rig = rig_from_table[0].inv()
    points = np.stack([model.points3D[number + 1].xyz for number in range(tracks.num_points)])
    sightings = Sightings(
        camera=shots.camera[tracks.view], angle=shots.angle[tracks.view], point=points[tracks.track], px=tracks.px
    )
    fit = fit_table(
        cameras,
        angles,
        (table_from_rig * turn, table_from_rig.apply(shift - point)),
        sightings=sightings,
        fixed_angle=0,
        has_free_lenses=False,
    )
    fitted = [
        replace(camera, distortion=old.distortion) for camera, old in zip(fit.cameras, table.cameras, strict=True)
    ]
    return Table(fitted, fit.angles)


def _rig_model(table: Table, shots: Shots, tracks: Tracks) -> pycolmap.Reconstruction:
    """The table as COLMAP's rig: camera c is sensor c + 1, angle a is frame a + 1, track n is point n + 1."""
    model = pycolmap.Reconstruction()
    rig = pycolmap.Rig(rig_id=1)
    first = table.cameras[0]
    for index, camera in enumerate(table.cameras):
        K = camera.K
        params = [K[0, 0], K[1, 1], K[0, 2], K[1, 2]]
        pinhole = pycolmap.Camera(
            model="PINHOLE", width=camera.size[0], height=camera.size[1], params=params, camera_id=index + 1
        )
        model.add_camera(pinhole)
        if index == 0:
            rig.add_ref_sensor(pinhole.sensor_id)
        else:
            turn = camera.R @ first.R.T
            rig.add_sensor(pinhole.sensor_id, _to_colmap(turn, camera.t - turn @ first.t))
    model.add_rig(rig)
    images = []
    for view, (camera, angle) in enumerate(zip(shots.camera.tolist(), shots.angle.tolist(), strict=True)):
        image = pycolmap.Image(image_id=view + 1, camera_id=camera + 1, frame_id=angle + 1, name=str(view))
        image.points2D = pycolmap.Point2DList([pycolmap.Point2D(px) for px in tracks.px[tracks.view == view]])
        images.append(image)
    for angle, degrees in enumerate(table.angles):
        frame = pycolmap.Frame(frame_id=angle + 1, rig_id=1)
        for image in images:
            if image.frame_id == angle + 1:
                frame.add_data_id(image.data_id)
        frame.rig_from_world = _to_colmap(*first.pose(degrees))
        model.add_frame(frame)
    for image in images:
        model.add_image(image)
    for angle in range(len(table.angles)):
        model.register_frame(angle + 1)
    place = np.zeros(len(tracks.view), np.int64)  # of a sighting in its photo
    for view in range(len(images)):
        here = tracks.view == view
        place[here] = np.arange(here.sum())
    points = triangulate_tracks(_matrices(table, shots), tracks)
    starts = np.searchsorted(tracks.track, np.arange(tracks.num_points + 1))
    for number, point in enumerate(points):
        track = pycolmap.Track()
        for index in range(starts[number], starts[number + 1]):
            track.add_element(int(tracks.view[index]) + 1, int(place[index]))
        model.add_point3D_with_id(number + 1, pycolmap.Point3D(xyz=point, track=track))
    return model


def _keep_world(table: Table, calibrated: Table) -> Table:
    """A table with the angle 0, the direction, the height and the scale of the calibrated one."""
    offset = turn_z(-float(calibrated.angles[0] - table.angles[0]))
    cameras = [replace(camera, R=camera.R @ offset.as_matrix()) for camera in table.cameras]
    old, new = (np.stack([-camera.R.T @ camera.t for camera in each]) for each in (calibrated.cameras, cameras))
    scale = np.linalg.norm(old[:, :2], axis=1).mean() / np.linalg.norm(new[:, :2], axis=1).mean()
    across = (new[:, 0] * old[:, 1] - new[:, 1] * old[:, 0]).sum()
    turn = turn_z(float(np.degrees(np.arctan2(across, (new[:, :2] * old[:, :2]).sum()))))
    height = np.array([0, 0, old[:, 2].mean() - scale * new[:, 2].mean()])
    moved = []
    for camera in cameras:
        R = camera.R @ turn.inv().as_matrix()
        moved.append(replace(camera, R=R, t=scale * camera.t - R @ height))
    return Table(moved, table.angles + (calibrated.angles[0] - table.angles[0]))


def _to_colmap(R: Floats, t: Floats) -> pycolmap.Rigid3d:
    return pycolmap.Rigid3d(pycolmap.Rotation3d(R), t)


def _from_colmap(pose: pycolmap.Rigid3d | None) -> tuple[Rotation, Floats]:
    assert pose is not None  # COLMAP's, of a sensor or frame that has none
    return Rotation.from_matrix(pose.rotation.matrix()), np.asarray(pose.translation, float)
