"""Dense points of a scene by multi-view stereo, for the comparisons of Sec. 4.2 and 4.3.

By semi-global matching, on any CPU; the paper's PatchMatch needs a graphics card.
"""

from __future__ import annotations

import tempfile
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import torch
from torch import Tensor

from benchmarks.baselines.stereo import Ball, seen_ball, sgbm_depths, view_angles
from mvseg.errors import InputError
from mvseg.formats.image_file import write_png
from mvseg.formats.photos import read_photo
from mvseg.scene import Cameras, Scene

MAX_SIDE = 1000  # pixels; larger photos are made smaller for stereo
NUM_SOURCES = 20  # views that each view is compared with at most, COLMAP's default
POINTS_PER_VIEW = 50  # of the artificial sparse model


def sgbm_points(scene: Scene) -> Tensor:
    """(P, 3) float64 world points of semi-global matching (see `stereo`) and COLMAP's fusion, on any CPU; none when no
    two views are within 25 degrees of each other. Raises InputError: a photo is missing or broken."""
    photos, cameras = read_small_photos(scene)
    depths = sgbm_depths([cv2.cvtColor(photo, cv2.COLOR_RGB2GRAY) for photo in photos], cameras)
    return fuse_depths(photos, depths, cameras)


def fuse_depths(photos: list[np.ndarray], depths: list[np.ndarray], cameras: Cameras) -> Tensor:
    """(P, 3) float64 world points of V depth maps (H, W) float32, 0 = unknown, by COLMAP's fusion.

    A point needs three views that agree: depths within 1.5 %, normals (rough, since they come from the depth maps)
    within 45 degrees.
    """
    if not any(depth.any() for depth in depths):
        return torch.zeros(0, 3, dtype=torch.float64)
    with tempfile.TemporaryDirectory(prefix="mvseg-") as folder:
        workspace = Workspace(Path(folder), cameras)
        workspace.write(photos)
        for view, depth in enumerate(depths):
            write_map(workspace.map_path("depth", view), (depth / workspace.unit)[None])
            write_map(workspace.map_path("normal", view), depth_normals(depth, cameras.K[view].numpy()))
        options = pycolmap.StereoFusionOptions()
        options.min_num_pixels, options.max_depth_error, options.max_normal_error = 3, 0.015, 45.0
        return workspace.to_world(fuse(Path(folder), options))


def read_small_photos(scene: Scene) -> tuple[list[np.ndarray], Cameras]:
    """V photos (H, W, 3) uint8 RGB, scaled down to at most `MAX_SIDE` pixels a side, and their cameras on the CPU."""
    cameras = scene.cameras.to("cpu")
    K, sizes, photos = cameras.K.clone(), cameras.sizes.clone(), []
    for view in range(len(cameras)):
        photo = read_photo(scene, view)
        scale = min(1.0, MAX_SIDE / max(photo.shape[:2]))
        if scale < 1:
            full = sizes[view].double()
            sizes[view] = (full * scale).round().long().clamp(min=1)
            photo = cv2.resize(photo, tuple(sizes[view].tolist()), interpolation=cv2.INTER_AREA)
            K[view, :2] *= (sizes[view] / full)[:, None]  # pixel corners are whole numbers: scaling needs no shift
        photos.append(photo)
    return photos, replace(cameras, K=K, sizes=sizes)


@dataclass(frozen=True, eq=False)
class Workspace:
    """A dense workspace of COLMAP in `folder`.

    COLMAP computes with float32. So the workspace has a world of its own: the origin is the centre of what the cameras
    see, and the unit is their mean distance from it.
    """

    folder: Path
    cameras: Cameras

    @property
    def ball(self) -> Ball:
        return seen_ball(self.cameras)

    @property
    def unit(self) -> float:
        """One unit of the workspace in world units of the scene."""
        return float(torch.linalg.vector_norm(self.cameras.centers - self.ball.center, dim=1).mean())

    def to_world(self, points: Tensor) -> Tensor:
        """(P, 3) points of the workspace in the scene's world."""
        return points * self.unit + self.ball.center

    def image_name(self, view: int) -> str:
        return f"{view:05d}.png"

    def map_path(self, kind: str, view: int) -> Path:
        """Where the "depth" or "normal" map of a view is."""
        return self.folder / "stereo" / f"{kind}_maps" / f"{self.image_name(view)}.geometric.bin"

    def write(self, photos: list[np.ndarray]) -> None:
        """Write photos, a model, and which views to compare: everything except the maps."""
        for name in ("images", "sparse", "stereo/depth_maps", "stereo/normal_maps", "stereo/consistency_graphs"):
            (self.folder / name).mkdir(parents=True)
        for view, photo in enumerate(photos):
            write_png(self.folder / "images" / self.image_name(view), photo)
        num_sources = min(NUM_SOURCES, len(photos) - 1)
        sources = view_angles(self.cameras, self.ball).argsort(dim=1, stable=True)[:, :num_sources].tolist()
        names = [self.image_name(view) for view in range(len(photos))]
        (self.folder / "stereo" / "fusion.cfg").write_text("".join(f"{name}\n" for name in names))
        self.model(sources).write(self.folder / "sparse")

    def model(self, sources: list[list[int]]) -> pycolmap.Reconstruction:
        """The cameras as a COLMAP model.

        Fusion decides from the sparse points which views overlap. Here these are random points in the ball that a view
        and its sources see.
        """
        model = pycolmap.Reconstruction()
        generator = torch.Generator().manual_seed(0)
        for view in range(len(self.cameras)):
            K, (width, height) = self.cameras.K[view], self.cameras.sizes[view].tolist()
            params = [float(x) for x in (K[0, 0], K[1, 1], K[0, 2], K[1, 2])]
            camera = pycolmap.Camera(model="PINHOLE", width=width, height=height, params=params, camera_id=view + 1)
            model.add_camera_with_trivial_rig(camera)
            R, t = self.cameras.R[view], (self.cameras.t[view] + self.cameras.R[view] @ self.ball.center) / self.unit
            pose = pycolmap.Rigid3d(pycolmap.Rotation3d(R.numpy()), t.numpy())
            slots = POINTS_PER_VIEW * (1 + sum(view in near for near in sources))
            image = pycolmap.Image(
                name=self.image_name(view), keypoints=np.zeros((slots, 2)), camera_id=view + 1, image_id=view + 1
            )
            model.add_image_with_trivial_frame(image, pose)
        used = [0] * len(self.cameras)
        for view, near in enumerate(sources):
            points = torch.nn.functional.normalize(torch.randn(POINTS_PER_VIEW, 3, generator=generator).double(), dim=1)
            for point in points * self.ball.radius / self.unit / 2:
                track = pycolmap.Track()
                for seen_by in (view, *near):
                    track.add_element(seen_by + 1, used[seen_by])
                    used[seen_by] += 1
                model.add_point3D(point.numpy(), track)
        return model


def fuse(workspace: Path, options: pycolmap.StereoFusionOptions) -> Tensor:
    """(P, 3) float64: the points that COLMAP fuses from the depth and normal maps in a dense workspace. Raises
    InputError: the workspace cannot be read."""
    with tempfile.TemporaryDirectory(prefix="mvseg-") as output:
        options.num_threads = 1  # with more, the points depend on which thread comes first
        quiet = pycolmap.logging.minloglevel
        pycolmap.logging.minloglevel = int(pycolmap.logging.ERROR)
        try:
            fused = pycolmap.stereo_fusion(output, workspace, options=options)
        except (RuntimeError, ValueError, OSError) as error:
            raise InputError(f"{workspace}: depth maps cannot be fused ({' '.join(str(error).split())})") from None
        finally:
            pycolmap.logging.minloglevel = quiet
    points = [point.xyz for point in fused.points3D.values()]
    return torch.from_numpy(np.array(points, np.float64).reshape(-1, 3))


def write_map(path: Path, values: np.ndarray) -> None:
    """Write (C, H, W) numbers as COLMAP's depth map (C = 1) or normal map (C = 3)."""
    channels, height, width = values.shape
    path.write_bytes(f"{width}&{height}&{channels}&".encode() + values.astype("<f4").tobytes())


def depth_normals(depth: np.ndarray, K: np.ndarray) -> np.ndarray:
    """(3, H, W) float32: unit normals of a depth map (H, W), camera frame, towards the camera.

    From central differences; where a neighbour's depth is unknown (0) the surface is taken to face the camera.
    """
    v, u = np.indices(depth.shape) + 0.5
    rays = np.stack((u, v, np.ones_like(u)), -1) @ np.linalg.inv(K).T
    points = np.where(depth > 0, depth, np.nan)[..., None] * rays
    normals = np.full_like(points, np.nan)
    across, down = points[1:-1, 2:] - points[1:-1, :-2], points[2:, 1:-1] - points[:-2, 1:-1]
    normals[1:-1, 1:-1] = np.cross(down, across)
    normals = np.where(np.isfinite(normals).all(-1, keepdims=True), normals, -rays)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    normals *= np.where((normals * rays).sum(-1, keepdims=True) > 0, -1, 1)
    return normals.transpose(2, 0, 1).astype(np.float32)
