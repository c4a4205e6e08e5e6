"""The world that the user asks for: scale, unit, and up, as the user says or as level cameras or flat markers show."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from mvseg.arrays import Floats
from mvseg.errors import InputError, warn
from mvseg.findings.finding import Finding
from mvseg.formats.markers import find_scene_markers
from mvseg.formats.photos import Photos
from mvseg.reconstruction.triangulate import triangulate_points
from mvseg.scene import Cameras, Scene
from mvseg.traits.config import Up

LEVEL = np.radians(2.0)  # how level cameras are at best
MOST_TILT = np.radians(10.0)  # root mean square, of cameras that were held level
MOST_DOUBT = np.radians(6.0)  # standard deviation of the answer
MOST_BEND = 0.1  # chosen: smallest standard deviation of markers' corners over the middle one: they lie in one plane


def place_scene(
    scene: Scene,
    photos: Photos | None = None,
    *,
    scale: float | None = None,
    unit: str | None = None,
    up: Up | None = None,
) -> Scene:
    """The scene in the world that the user asks for; None leaves what the scene says. Its lengths are multiplied by
    `scale`, and are then in `unit`; photos, where none are given, are read if `up` is "board".

    Warns (InputWarning) of a unit that contradicts the scene's and comes without a scale, and of an up that the cameras
    contradict (`Scene.seems_upside_down`). Raises InputError for a scale of cameras that say their unit, without the
    unit of the lengths after it, and if up cannot be found, see `find_up`.
    """
    if scale is not None:
        if unit is None and scene.unit and scale != 1:
            problem = f"scale is {scale:g} without a unit, but the cameras are in {scene.unit}"
            raise InputError(f"{problem}: expected the unit of the scaled lengths, too, as in --unit {scene.unit}")
        scene = replace(scene, cameras=scene.cameras.scale(scale))
    if unit is not None:
        if scene.unit not in ("", unit) and scale is None:
            warn(Finding("unit_only_renamed", values={"before": scene.unit, "unit": unit}))
        scene = replace(scene, unit=unit)
    scene = find_up(scene, up, photos)
    if scene.seems_upside_down:
        warn(Finding("upside_down"))
    return scene


def find_up(scene: Scene, up: Up | None, photos: Photos | None = None) -> Scene:
    """The scene with the direction of up that the user says, or else its own. Raises InputError for "rig" or "board"
    where these do not tell it, see `up_of_cameras` and `up_of_board`, and for a vector without a direction."""
    if up is None:
        return scene
    if isinstance(up, str):
        x, y, z = (up_of_board(scene, photos) if up == "board" else up_of_cameras(scene.cameras)).tolist()
        up = x, y, z
    return replace(scene, up=up)


def up_of_cameras(cameras: Cameras) -> Floats:
    """(3,) unit vector up, from V cameras that were held level, at any height and pitch: it is perpendicular to the
    horizontal axes of their photos. Raises InputError if the cameras were not held level, or all look in nearly the
    same direction."""
    R = cameras.R.cpu().numpy()
    _, sizes, axes = np.linalg.svd(R[:, 0], full_matrices=True)
    sizes = np.append(sizes, [0.0] * (3 - len(sizes))) / np.sqrt(len(R))
    tilt = max(float(sizes[2]), LEVEL)
    if tilt > MOST_TILT or tilt > MOST_DOUBT * sizes[1] * np.sqrt(len(R)):
        reason = "were not held level" if tilt > MOST_TILT else "all look in nearly the same direction"
        raise InputError(f"up is 'rig', but the cameras {reason}: expected the direction as three numbers, as in 0 0 1")
    # Level cameras have their own up on the upper side, and look down on plants rather than up at them.
    towards = -R[:, 1].mean(0) - R[:, 2].mean(0)
    return axes[2] if axes[2] @ towards >= 0 else -axes[2]


def up_of_board(scene: Scene, photos: Photos | None = None) -> Floats:
    """(3,) unit vector up: the normal of the plane of all ArUco or ChArUco markers, on the side of the cameras. The
    family of markers with the most corners in space counts. Raises InputError if a photo is missing or broken, no
    marker is seen in two photos, or the markers lie in no one plane."""
    found = [triangulate_points(scene.cameras, seen) for seen in find_scene_markers(photos or Photos(scene)).values()]
    corners = np.array(list(max(found, key=len).values()))
    if not len(corners):
        raise InputError("up is 'board', but no ArUco marker is seen in two photos, expected one that lies flat")
    middle = corners.mean(0)
    _, sizes, axes = np.linalg.svd(corners - middle, full_matrices=False)
    if sizes[2] > MOST_BEND * sizes[1]:
        raise InputError(f"up is 'board', but the {len(corners)} corners of its markers lie in no one plane")
    towards = scene.cameras.centers.mean(0).cpu().numpy() - middle
    return axes[2] if axes[2] @ towards >= 0 else -axes[2]


def level_frame(up: Floats | tuple[float, float, float]) -> Floats:
    """(3, 3) rows: east, north, up, a right-handed frame. East, azimuth 0, is the world's +x made horizontal (its +y
    where +x is steep)."""
    upwards = np.asarray(up, dtype=np.float64)
    axis = np.eye(3)[0 if abs(upwards[0]) < 0.9 else 1]
    east = axis - (axis @ upwards) * upwards
    east /= np.linalg.norm(east)
    return np.stack([east, np.cross(upwards, east), upwards])
