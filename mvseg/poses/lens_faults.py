"""Whether the lens that photos share explains them: they may be zoomed, squashed, cut, or taken with a fisheye.

Each cause is a hypothesis: one more bundle adjustment with the freedom that it needs, from where the first one ended. A
cause is believed if it lowers the noise, and more than the others do: a wrong one often lowers it, too.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pycolmap
from numpy.typing import NDArray

from mvseg.findings.finding import Finding
from mvseg.poses.cancellable import quiet_colmap
from mvseg.poses.focal_length import adjuster, noise_px
from mvseg.poses.numbers import LENS

Lens = Callable[[pycolmap.Camera], tuple[str, list[float]]]  # the model and its parameters


@dataclass(frozen=True, eq=False)
class LensReport:
    """Whether another lens explains the photos better.

    Attributes:
        finding: the fault; None: the lens explains the photos, or nothing explains them better.
        model: the photos and points with the lens that is to stay.
        is_square_known: whether photos show the shape of pixels, as walks at one height do not; else assumed square.
    """

    finding: Finding | None
    model: pycolmap.Reconstruction
    is_square_known: bool = True


@dataclass(frozen=True, eq=False)
class _Trial:
    """A model after an adjustment with another lens, its noise as a share of that before, and the adjustment."""

    model: pycolmap.Reconstruction
    noise: float
    adjusting: pycolmap.CeresBundleAdjuster


def find_lens_fault(model: pycolmap.Reconstruction) -> LensReport:
    """The fault of the shared lens of a model that explains its photos best. Photos that are squashed keep two focal
    lengths: nothing is lost then. The others need what their sentence says. Nothing is asked of models that are not
    COLMAP's SIMPLE_RADIAL, or in which each photo has its own lens."""
    names = {camera.model_name for camera in model.cameras.values()}
    if names != {"SIMPLE_RADIAL"} or len(model.cameras) == model.num_reg_images():
        return LensReport(None, model)
    with quiet_colmap():
        own = _try(model, _same, is_own=True)
        two = _try(model, _two_focal_lengths)
        middle = _try(model, _same, is_middle_free=True)
        own_middle = _try(model, _same, is_own=True, is_middle_free=True)
        fisheye = _try(model, lambda camera: ("SIMPLE_RADIAL_FISHEYE", _same(camera)[1]))
        aspect, deviation = _aspect(two)
    lengths, spread = _focal_lengths_of_photos(own.model, model)
    is_square_known = deviation < LENS.most_aspect_sd
    others = min(two.noise, middle.noise, fisheye.noise)
    if spread > LENS.zoomed and own.noise < min(LENS.noise_of_zooms, others):
        shared = float(model.cameras[min(model.cameras)].params[0])
        values = {"low": float(lengths.min()), "high": float(lengths.max()), "shared": shared}
        return LensReport(Finding("zooms", values=values), model, is_square_known)
    is_squashed = abs(math.log(aspect)) > LENS.squashed and is_square_known and two.noise < LENS.noise_of_squashed
    least_of_own = min(LENS.noise_of_cut_each, LENS.gain_of_own * others)  # it has by far the most freedom
    causes = (
        (two.noise, Finding("squashed", values={"aspect": aspect}), two.model, is_squashed),
        (middle.noise, Finding("photos_cut"), model, middle.noise < LENS.noise_of_cut),
        (own_middle.noise, Finding("photos_cut_each"), model, own_middle.noise < least_of_own),
        (fisheye.noise, Finding("wide_lens"), model, fisheye.noise < LENS.noise_of_fisheye),
        (math.inf, None, model, True),
    )
    _, finding, best, _ = min((cause for cause in causes if cause[3]), key=lambda cause: cause[0])
    return LensReport(finding, best, is_square_known)


def _same(camera: pycolmap.Camera) -> tuple[str, list[float]]:
    return camera.model_name, list(map(float, camera.params))


def _two_focal_lengths(camera: pycolmap.Camera) -> tuple[str, list[float]]:
    focal, x, y, radial = _same(camera)[1]
    return "OPENCV", [focal, focal, x, y, radial, 0.0, 0.0, 0.0]


def _try(model: pycolmap.Reconstruction, lens: Lens, *, is_own: bool = False, is_middle_free: bool = False) -> _Trial:
    """Adjust with another lens, one for each photo or for each camera, and perhaps its principal point."""
    other = _with_lenses(model, lens, is_own=is_own)
    options = pycolmap.BundleAdjustmentOptions(print_summary=False, refine_principal_point=is_middle_free)
    adjusting = adjuster(other, options)
    adjusting.solve()
    other.update_point_3d_errors()
    return _Trial(other, noise_px(other) / max(noise_px(model), 1e-12), adjusting)


def _with_lenses(model: pycolmap.Reconstruction, lens: Lens, *, is_own: bool) -> pycolmap.Reconstruction:
    other = pycolmap.Reconstruction()
    for number in model.reg_image_ids():
        image = model.images[number]
        camera, camera_id = model.cameras[image.camera_id], number if is_own else image.camera_id
        if camera_id not in other.cameras:
            name, params = lens(camera)
            size = {"width": camera.width, "height": camera.height}
            other.add_camera_with_trivial_rig(pycolmap.Camera(model=name, params=params, camera_id=camera_id, **size))
        pixels = np.array([point.xy for point in image.points2D]).reshape(-1, 2)
        alone = pycolmap.Image(name=image.name, keypoints=pixels, camera_id=camera_id, image_id=number)
        other.add_image_with_trivial_frame(alone, image.cam_from_world())
    for point in model.points3D.values():
        other.add_point3D(point.xyz, point.track, point.color)
    return other


def _focal_lengths_of_photos(
    own: pycolmap.Reconstruction, model: pycolmap.Reconstruction
) -> tuple[NDArray[np.float64], float]:
    """Focal length of each photo (V,), pixels, and their largest relative deviation among photos of one camera."""
    numbers = sorted(own.cameras)
    lengths = np.array([own.cameras[number].params[0] for number in numbers])
    cameras = np.array([model.images[number].camera_id for number in numbers])
    groups = [lengths[cameras == camera] for camera in np.unique(cameras)]
    return lengths, max(float(each.std() / each.mean()) for each in groups)


def _aspect(two: _Trial) -> tuple[float, float]:
    """Width of a pixel in heights, and its deviation, of the least certain camera; (1, infinite) if not determined."""
    known = pycolmap.estimate_ba_covariance(pycolmap.BACovarianceOptions(), two.model, two.adjusting)
    worst = 1.0, 0.0
    for camera in two.model.cameras.values():
        covariance = None if known is None else known.get_other_params_cov(camera.params)
        if covariance is None:
            return 1.0, math.inf
        x, y = camera.params[:2]
        gain = np.zeros(len(covariance))
        gain[:2] = -y / x**2, 1 / x
        deviation = noise_px(two.model) * math.sqrt(max(float(gain @ covariance @ gain), 0.0))
        if deviation >= worst[1]:
            worst = float(y / x), deviation
    return worst
