"""Cameras, views and scenes. This docstring is the convention sheet of the whole project.

Frames     world, cam (one per view), px. Poses are `cam_from_world`: x_cam = R @ x_world + t. The camera looks along
           +z, +x is right, +y is down (OpenCV, COLMAP). Names carry frames, so that products cancel: `j_from_world`,
           `px_from_cam`, `world_from_px`.
Pixels     the centre of the top-left pixel is (0.5, 0.5) (COLMAP); pixel (column c, row r) covers [c, c+1) x [r, r+1).
           Zero-centred habits (OpenCV, torchvision) are converted where they enter, in `formats/` and `detectors/`.
           Boxes of masks are computed in `regions.py`.
Boxes      xyxy, half-open and continuous: x2 - x1 is the number of pixel columns.
Lenses     distortion is removed once, on load: `Cameras` are pinholes. `View.lens` keeps the photo's own camera, so
           that labels can be written in the frame of the photo the user took.
Axes       V views, D all regions of a scene, N and M regions of two views, K clusters, P points or pixels, B bins of
           plane angle, H W image.
Units      world units are the scene's (`Scene.unit`); thresholds are in pixels or fractions, never in world units.
           Which way is up is not known, unless the cameras' file or the user says so (`Scene.up`).
Ids        instances are 1, 2, ... in Python as in files; -1 is a region matched to nothing, 0 the background of a label
           image. Cluster numbers (0, 1, ...) are array indices inside `matching/` and do not leave it.
Types      cameras and plane angles in float64 on entry, image-sized work in float32; indices int64. Tensors, on the
           device of the inputs; only `matching/nview/` works in NumPy, up to the `Matching` that `match_nview`
           returns.
Ragged     one flat tensor and an index vector, never padded, never lists of lists.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from mvseg.errors import InputError
from mvseg.table import Table

if TYPE_CHECKING:
    import pycolmap

ROTATION_TOLERANCE = 1e-4  # limit: |R R^T - I|; hand-typed rig files carry about six digits
MIN_FOCAL, MAX_PX = 1e-3, 1e9  # limit: of K, pixels; far beyond any lens, and products of them are still numbers
UNIT_DIAGONAL = 700.0  # definition: pixels of the photo's diagonal per unit
LEVEL, UPSIDE_DOWN = 0.17, -0.7  # chosen: sine of the pitch of level cameras; cosine of their up and the world's
MAX_WORLD = 1e12  # limit: of t, world units: millimetres on a map of the whole earth fit


@dataclass(frozen=True, eq=False, repr=False)
class Cameras(Table):
    """V pinhole cameras with known poses.

    Attributes:
        K: (V, 3, 3) float64, px_from_cam; `K[:, 0, 0]`, `K[:, 1, 1]` are the focal lengths in pixels, > 0.
        R: (V, 3, 3) float64, rotation of cam_from_world.
        t: (V, 3) float64, translation of cam_from_world, world units.
        sizes: (V, 2) int64, image width and height in pixels.

    Raises:
        InputError: a wrong shape, a number that is not finite, a focal length <= 0, a K that is not upper triangular
            with last row (0, 0, 1), an R that is not a rotation (reflections included), an image size < 1, numbers
            that no camera has (`MAX_PX`, `MAX_WORLD`). The message names the view by its index.
    """

    K: Tensor
    R: Tensor
    t: Tensor
    sizes: Tensor

    def __repr__(self) -> str:
        sizes = sorted({(width, height) for width, height in self.sizes.tolist()})
        shown = ", ".join(f"{width} x {height}" for width, height in sizes[:3]) + (", ..." if len(sizes) > 3 else "")
        return f"Cameras({len(self.K)} views: {shown})"

    def __post_init__(self) -> None:
        num_views = len(self.K)
        for field, shape in (("K", (3, 3)), ("R", (3, 3)), ("t", (3,)), ("sizes", (2,))):
            value = getattr(self, field)
            if tuple(value.shape) != (num_views, *shape):
                raise InputError(f"{field} has shape {tuple(value.shape)}, expected {(num_views, *shape)}")
            object.__setattr__(self, field, value.to(torch.int64 if field == "sizes" else torch.float64))
        for index in range(num_views):
            if problem := camera_problem(self.K[index], self.R[index], self.t[index], size=self.sizes[index]):
                raise InputError(f"view {index}: {problem}")

    def __getitem__(self, index: Any) -> Cameras:
        """The cameras at a slice, a list or a tensor of view indices; of one view: `cameras[[0]]`."""
        if isinstance(index, int):
            raise InputError(f"cameras[{index}] asks for a single camera, expected a list: cameras[[{index}]]")
        return replace(self, **self._pick_rows(index))

    @property
    def centers(self) -> Tensor:
        """(V, 3) camera centres in world coordinates, -R^T t."""
        return -(self.R.mT @ self.t[:, :, None])[:, :, 0]

    @property
    def world_from_px(self) -> Tensor:
        """(V, 3, 3): `world_from_px @ (u, v, 1)` is the viewing ray of a pixel in world axes, with depth 1 along +z."""
        return self.R.mT @ torch.linalg.inv(self.K)

    @property
    def px_from_world(self) -> Tensor:
        """(V, 3, 4): `px_from_world @ (x, y, z, 1)` is the pixel of a world point, times its depth."""
        return self.K @ torch.cat((self.R, self.t[:, :, None]), 2)

    @property
    def unit_px(self) -> float:
        """Unit of measures that depend on drawn masks, in pixels: a 700th of the photos' diagonal, at least one pixel.
        Masks and features of large photos are less exact."""
        return max(1.0, float(self.sizes.double().norm(dim=1).median()) / UNIT_DIAGONAL)

    def scale(self, factor: float) -> Cameras:
        """The same cameras in a world whose lengths are multiplied by `factor` > 0; every point keeps its pixel."""
        return replace(self, t=factor * self.t)

    def project(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Project world points (P, 3) into every view.

        Returns:
            (V, P, 2) float64 pixel positions and (V, P) depths along +z in world units. Points with depth <= 0 lie
            behind the camera; their pixel position has no meaning (not finite for depth 0).
        """
        cam = points.to(self.K) @ self.R.mT + self.t[:, None, :]
        px = cam @ self.K.mT
        return px[..., :2] / px[..., 2:], cam[..., 2]


def nearest_point(origins: Tensor, directions: Tensor) -> Tensor:
    """(3,) the point nearest to N rays in the least squares, from `origins` (N, 3) along `directions` (N, 3) of any
    length; of parallel rays, one of many."""
    rays = torch.nn.functional.normalize(directions, dim=1)
    across = torch.eye(3).to(rays) - rays[:, :, None] * rays[:, None, :]
    # From the mean origin: far from the world's origin the products would cancel.
    middle = origins.mean(0)
    target = (across @ (origins - middle)[..., None]).sum(0)
    return middle + (torch.linalg.pinv(across.sum(0), rtol=1e-9) @ target)[:, 0]


def camera_problem(K: Tensor, R: Tensor, t: Tensor, *, size: Tensor) -> str | None:
    """Fault of one camera, as the end of a sentence; None for a sound one. Shapes as in `Cameras`."""
    for name, value in (("K", K), ("R", R), ("t", t)):
        if not torch.isfinite(value).all():
            return f"{name} holds a number that is not finite"
    if size.min() < 1:
        return f"the image size is {size[0]} x {size[1]}, expected at least 1 x 1"
    if K[0, 0] <= 0 or K[1, 1] <= 0:
        return f"the focal length is {K[0, 0]:g}, {K[1, 1]:g}, expected positive numbers"
    if min(K[0, 0], K[1, 1]) < MIN_FOCAL:
        return f"the focal length is {K[0, 0]:g}, {K[1, 1]:g}, expected pixels"
    if K.abs().max() > MAX_PX:
        return f"K holds {K.abs().max():g}, expected pixels, at most {MAX_PX:g}"
    if t.abs().max() > MAX_WORLD:
        return f"t holds {t.abs().max():g}, expected at most {MAX_WORLD:g}"
    if K[1, 0] != 0 or K[2].tolist() != [0.0, 0.0, 1.0]:
        return "K is not upper triangular with last row 0, 0, 1"
    deviation = (R @ R.T - torch.eye(3).to(R)).abs().max().item()
    if deviation > ROTATION_TOLERANCE:
        return f"R is not a rotation (R R^T differs from the identity by {deviation:.2g})"
    if torch.linalg.det(R) < 0:
        return "R is a reflection (its determinant is -1), expected a rotation"
    return None


@dataclass(frozen=True)
class View:
    """One photo of a scene.

    Attributes:
        name: unique in its scene; the path of the photo below the folder that all photos share, without suffix. Masks
            and results of this view are called `<name>.png`.
        path: where the photo is expected; it may be absent when only masks are used.
        lens: the photo's own camera (any COLMAP model) when it has distortion, else None.
    """

    name: str
    path: Path
    lens: pycolmap.Camera | None = None


@dataclass(frozen=True, eq=False, repr=False)
class Scene:
    """Photos of one plant from V known cameras (two or more, when read from a folder).

    Attributes:
        name: the folder's name.
        views: one `View` per camera.
        cameras: undistorted, in the order of the views.
        unit: name of the world unit ("mm", "m", ...); "" when the cameras do not say.
        source: the file or folder that the cameras were read from.
        up: unit vector (x, y, z) of the world that points up; None when the cameras do not say.

    Raises:
        InputError: as many cameras as views are expected, with different names; an `up` without a direction.
    """

    name: str
    views: tuple[View, ...]
    cameras: Cameras
    unit: str = ""
    source: Path | None = None
    up: tuple[float, float, float] | None = None

    def __repr__(self) -> str:
        return f"Scene({self.name!r}, {len(self.views)} views, unit {self.unit or 'unknown'})"

    def __post_init__(self) -> None:
        if self.up is not None:
            length = math.hypot(*self.up)
            if not 0 < length < math.inf:
                raise InputError(f"up is {self.up}, expected a direction: three finite numbers, not all 0")
            x, y, z = self.up
            object.__setattr__(self, "up", (x / length, y / length, z / length))
        if len(self.views) != len(self.cameras):
            raise InputError(f"{len(self.views)} views with {len(self.cameras)} cameras, expected one per view")
        names = [view.name for view in self.views]
        for index, name in enumerate(names):
            if (first := names.index(name)) < index:
                raise InputError(f"views {first} and {index} have the same name '{name}'")

    def select(self, index: Tensor) -> Scene:
        """The scene with the views at (S,) int64, in that order."""
        views = tuple(self.views[view] for view in index.tolist())
        return replace(self, views=views, cameras=self.cameras[index.to(self.cameras.device)])

    @property
    def seems_upside_down(self) -> bool:
        """Do the cameras contradict `up`? False where it is not known.

        People and gantries look down on plants, or at them from the side with the camera upright. Here the cameras look
        up by more than ten degrees in the mean, or are level and hang upside down. The leaves cannot tell: the cameras
        tell which of their sides is the upper one, too.
        """
        if self.up is None:
            return False
        up = torch.tensor(self.up).to(self.cameras.R)
        own, ahead = (float((sign * self.cameras.R[:, row] @ up).mean()) for sign, row in ((-1, 1), (1, 2)))
        return ahead > LEVEL or (ahead > -LEVEL and own < UPSIDE_DOWN)
