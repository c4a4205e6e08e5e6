"""The convention sheet, checked against OpenCV."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from blade_scene import ring_cameras
from mvseg.errors import InputError
from mvseg.scene import Cameras, Scene, View, nearest_point
from synthetic import arc_positions, cameras_at


def some_cameras() -> Cameras:
    return cameras_at(arc_positions(4))


def test_project_agrees_with_opencv() -> None:
    cameras = some_cameras()
    points = torch.randn(50, 3, generator=torch.Generator().manual_seed(0)).double()
    px, depth = cameras.project(points)
    for view in range(4):
        K = cameras.K[view].numpy().copy()
        K[:2, 2] -= 0.5  # OpenCV's pixel centres are whole numbers
        rotation, _ = cv2.Rodrigues(cameras.R[view].numpy())
        expected, _ = cv2.projectPoints(points.numpy(), rotation, cameras.t[view].numpy(), K, None)
        np.testing.assert_allclose(px[view].numpy(), expected[:, 0] + 0.5, atol=1e-9)
        cam = cameras.R[view] @ points.T + cameras.t[view][:, None]
        torch.testing.assert_close(depth[view], cam[2])


def test_the_matrix_projects_as_the_cameras_do() -> None:
    cameras = some_cameras()
    points = torch.randn(50, 3, generator=torch.Generator().manual_seed(0)).double()
    image = torch.cat((points, torch.ones(50, 1)), 1) @ cameras.px_from_world.mT
    px, depth = cameras.project(points)
    torch.testing.assert_close(image[..., 2], depth)
    torch.testing.assert_close(image[..., :2] / image[..., 2:], px)


@pytest.mark.parametrize("offset", [0.0, 1e6])
def test_rays_through_one_point_are_nearest_to_it(offset: float) -> None:
    """Wherever the origin of the world is; of rays that miss each other, no point nearby is nearer."""
    cameras = some_cameras()
    shift = torch.tensor([offset, -offset, offset]).double()
    cameras = replace(cameras, t=cameras.t - (cameras.R @ shift[:, None])[:, :, 0])
    point, views = shift + torch.tensor([3.0, -2.0, 1.0]), torch.tensor([0, 1, 2, 3, 3])
    rays = (point - cameras.centers[views]) * torch.tensor([1.0, 2, 3, 4, 5])[:, None]
    torch.testing.assert_close(nearest_point(cameras.centers[views], rays), point, rtol=0, atol=1e-6)
    rays = rays + 0.1 * rays.norm(dim=1, keepdim=True) * torch.eye(5, 3)

    def cost(at: torch.Tensor) -> float:
        return float(torch.linalg.cross(at - cameras.centers[views], rays / rays.norm(dim=1)[:, None]).square().sum())

    found = nearest_point(cameras.centers[views], rays)
    assert all(cost(found + sign * step) > cost(found) for step in torch.eye(3) for sign in (1, -1))
    parallel = torch.tensor([[0.0, 0, 1]]).double().expand(4, 3)
    assert bool(nearest_point(cameras.centers, parallel).isfinite().all())


@pytest.mark.parametrize(("size", "unit_px"), [((300, 400), 1.0), ((2100, 2800), 5.0)])
def test_units_of_large_photos_are_larger(size: tuple[int, int], unit_px: float) -> None:
    cameras = some_cameras()
    assert replace(cameras, sizes=torch.tensor([size] * 4)).unit_px == unit_px


def test_center_projects_to_depth_zero_and_rays_return_to_their_pixel() -> None:
    cameras = some_cameras()
    for view in range(4):
        _, depth = cameras.project(cameras.centers)
        assert depth[view, view].abs() < 1e-12
        pixel = torch.tensor([17.5, 100.5, 1.0]).double()
        point = cameras.centers[view] + 3.0 * cameras.world_from_px[view] @ pixel
        px, depth = cameras.project(point[None])
        torch.testing.assert_close(px[view, 0], pixel[:2])
        torch.testing.assert_close(depth[view, 0], torch.tensor(3.0).double())


@pytest.mark.parametrize(
    ("field", "change", "message"),
    [
        ("K", lambda K: K.index_put((torch.tensor(0), torch.tensor(0)), torch.tensor(0.0).double()), "focal length"),
        ("K", lambda K: -K, "focal length"),
        ("K", lambda K: K.T.clone(), "upper triangular"),
        ("R", lambda R: R * torch.tensor([[1.0], [1.0], [-1.0]]).double(), "reflection"),
        ("R", lambda R: 1.01 * R, "not a rotation"),
        ("t", lambda t: t * float("nan"), "not finite"),
        ("t", lambda t: t + 1e30, r"t holds 1e\+30, expected at most 1e\+12"),
        ("K", lambda K: torch.tensor([1e300, 1e300, 1], dtype=K.dtype).diag(), r"K holds 1e\+300, expected pixels"),
        ("K", lambda K: torch.tensor([1e-300, 1e-300, 1], dtype=K.dtype).diag(), "focal length is 1e-300"),
        ("sizes", lambda sizes: 0 * sizes, "image size"),
    ],
)
def test_unsound_camera_is_named(field: str, change, message: str) -> None:
    cameras = some_cameras()
    fields = {name: getattr(cameras, name).clone() for name in ("K", "R", "t", "sizes")}
    fields[field][2] = change(fields[field][2])
    with pytest.raises(InputError, match=rf"view 2: .*{message}"):
        Cameras(**fields)


def test_wrong_shape_is_named() -> None:
    cameras = some_cameras()
    with pytest.raises(InputError, match=r"t has shape \(3, 3\), expected \(4, 3\)"):
        Cameras(cameras.K, cameras.R, cameras.t[:3], cameras.sizes)


def test_views_are_selected_with_their_cameras_and_have_names_of_their_own() -> None:
    views = tuple(View(name, Path(f"{name}.jpg")) for name in "abc")
    scene = Scene("plant", views, ring_cameras(3), unit="mm", up=(0.0, 0.0, 1.0))
    some = scene.select(torch.tensor([2, 0]))
    assert [view.name for view in some.views] == ["c", "a"]
    assert torch.equal(some.cameras.t, scene.cameras.t[[2, 0]])
    assert (some.name, some.unit, some.up) == ("plant", "mm", (0, 0, 1))
    views = tuple(View(name, Path(name)) for name in ("a", "b", "a", "c"))
    with pytest.raises(InputError, match="views 0 and 2 have the same name 'a'"):
        Scene("plant", views, some_cameras())


@pytest.mark.parametrize("elevation_deg", [-5.0, 0.0, 5.0, 15.0, 60.0, 89.0])
def test_cameras_look_down_on_plants(elevation_deg: float) -> None:
    cameras = ring_cameras(6, elevations_deg=(elevation_deg,))
    views = tuple(View(str(view), Path(f"{view}.png")) for view in range(6))
    for up, is_doubtful in ((None, False), ((0.0, 0.0, 2.0), False), ((0.0, 0.0, -1.0), True), ((1.0, 0, 0), False)):
        assert Scene("plant", views, cameras, up=up).seems_upside_down == is_doubtful


def test_cameras_that_hang_upside_down_but_look_down_are_no_contradiction() -> None:
    cameras = ring_cameras(6, elevations_deg=(20,))
    flip = torch.diag(torch.tensor([-1.0, -1.0, 1.0])).double()
    cameras = replace(cameras, R=flip @ cameras.R, t=cameras.t @ flip)
    views = tuple(View(str(view), Path(f"{view}.png")) for view in range(6))
    assert not Scene("plant", views, cameras, up=(0.0, 0.0, 1.0)).seems_upside_down
