"""How sure a focal length is: it scales all depths and heights, and residuals do not show that it is wrong."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pycolmap
from numpy.typing import NDArray

from mvseg.findings.finding import Finding
from mvseg.poses.numbers import TABLE


@dataclass(frozen=True)
class FocalLength:
    """A focal length and its standard deviation, which is None where the lens was given; pixels."""

    px: float
    deviation: float | None

    def describe(self) -> str:
        if self.deviation is None:
            return f"focal length {self.px:.0f} px, as given"
        return f"focal length {self.px:.0f} +- {self.deviation:.2g} px ({self.deviation / self.px:.1%})"

    def doubts(self, code: str, where: str = "") -> list[Finding]:
        """The finding of this code where the deviation is above `TABLE.most_sd`, none where it is not."""
        if self.deviation is None or self.deviation <= TABLE.most_sd * self.px:
            return []
        return [Finding(code, where, {"px": self.px, "deviation": self.deviation, "share": self.deviation / self.px})]


def least_sure(lengths: Sequence[FocalLength]) -> FocalLength:
    """The one with the largest relative deviation."""
    return max(lengths, key=lambda length: (length.deviation or 0.0) / length.px)


def focal_lengths(model: pycolmap.Reconstruction, *, is_given: bool) -> list[FocalLength]:
    """The focal length (the first of two) of each camera of a model, in order of their numbers. A deviation is that of
    the bundle adjustment, which has the principal point in the middle, and what moving that by `TABLE.off_middle`
    changes: nearly all of it for flat scenes and photos from one height. 100 % where nothing is determined."""
    covariance = None if is_given else _covariance(model)
    noise, lengths = noise_px(model), []
    for _, camera in sorted(model.cameras.items()):
        focal, *_ = camera.focal_length_idxs()
        px = float(camera.params[focal])
        of_lens = None if covariance is None else covariance.get_other_params_cov(camera.params)
        deviation = px if of_lens is None else _deviation(camera, noise**2 * of_lens, focal)
        lengths.append(FocalLength(px, None if is_given else deviation))
    return lengths


def _deviation(camera: pycolmap.Camera, covariance: NDArray[np.float64], focal: int) -> float:
    """Deviation of the focal length for a fixed principal point, pixels; `covariance` is that with a free one."""
    principal = camera.principal_point_idxs()
    gain = np.linalg.solve(covariance[np.ix_(principal, principal)], covariance[principal, focal])
    variance = covariance[focal, focal] - gain @ covariance[principal, focal]
    shift_px = TABLE.off_middle * max(camera.width, camera.height)
    return float(np.sqrt(max(variance, 0) + shift_px**2 * (gain @ gain)))


def _covariance(model: pycolmap.Reconstruction) -> pycolmap.BACovariance | None:
    """The covariance of all parameters, for residuals of 1 pixel; None where they are not determined."""
    adjusting = adjuster(model, pycolmap.BundleAdjustmentOptions(refine_principal_point=True))
    return pycolmap.estimate_ba_covariance(pycolmap.BACovarianceOptions(), model, adjusting)


def adjuster(model: pycolmap.Reconstruction, options: pycolmap.BundleAdjustmentOptions) -> pycolmap.CeresBundleAdjuster:
    """A bundle adjustment of all photos of a model."""
    config = pycolmap.BundleAdjustmentConfig()
    for image in model.reg_image_ids():
        config.add_image(image)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    return pycolmap.create_default_ceres_bundle_adjuster(options, config, model)


def noise_px(model: pycolmap.Reconstruction) -> float:
    """Standard deviation of each coordinate of a feature: more than residuals, which points and poses make small."""
    points = model.points3D.values()
    lengths = np.array([point.track.length() for point in points])
    errors = np.array([point.error for point in points])  # means of distances, which are Rayleigh-distributed
    free = 2 * lengths.sum() - 3 * len(lengths) - 6 * model.num_reg_images()
    return float(np.sqrt(4 / np.pi * (lengths * errors**2).sum() / max(free, 1)))
