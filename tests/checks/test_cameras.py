"""Cameras on their own: each fault has its sentence, and sound cameras have none."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import cv2
import numpy as np
import pytest
import torch
from torch import Tensor

from mvseg.checks.camera_plan import RED, draw_walk
from mvseg.checks.cameras import FLIP, camera_findings, field_of_view, find_coverage
from mvseg.findings.finding import Finding
from mvseg.scene import Cameras, Scene, View
from synthetic import arc_positions, cameras_at, moved

Fault = Callable[[Cameras], Cameras]


def findings_of(scene: Scene, cameras: Cameras) -> list[Finding]:
    scene = replace(scene, cameras=cameras)
    return camera_findings(scene, find_coverage(cameras))


def rotation(axis: list[float], degrees: float) -> Tensor:
    vector = np.radians(degrees) * np.array(axis) / np.linalg.norm(axis)
    return torch.from_numpy(cv2.Rodrigues(vector)[0])


def turned(cameras: Cameras, view: int, degrees: float) -> Cameras:
    """One camera turned about its own upright axis."""
    R, t, turn = cameras.R.clone(), cameras.t.clone(), rotation([0, 1, 0], degrees)
    R[view], t[view] = turn @ R[view], turn @ t[view]
    return replace(cameras, R=R, t=t)


def edited(cameras: Cameras, view: int, change: Callable[[Tensor, Tensor], None]) -> Cameras:
    """`change` may write into K and t of one view."""
    K, t = cameras.K.clone(), cameras.t.clone()
    change(K[view], t[view])
    return replace(cameras, K=K, t=t)


def inverted(cameras: Cameras) -> Cameras:
    return replace(cameras, R=cameras.R.mT, t=cameras.centers)


def flipped(cameras: Cameras) -> Cameras:
    flip = torch.from_numpy(FLIP)
    return replace(cameras, R=flip @ cameras.R, t=cameras.t @ flip)


@pytest.mark.parametrize("num_views", [4, 5, 12, 30])
def test_cameras_on_an_arc_have_no_finding(num_views: int, demo_scene: Scene) -> None:
    scene = replace(demo_scene, views=tuple(replace(demo_scene.views[0], name=str(view)) for view in range(num_views)),
                    cameras=cameras_at(arc_positions(num_views)))  # fmt: skip
    assert findings_of(scene, scene.cameras) == []


def test_absurd_numbers_are_borne(demo_scene: Scene) -> None:
    for factor in (1e-9, 1e9):
        assert find_coverage(demo_scene.cameras.scale(factor)).sees.all()
    same = replace(demo_scene.cameras, R=demo_scene.cameras.R[[0] * 6 + [1, 2, 3]],
                   t=demo_scene.cameras.t[[0] * 6 + [1, 2, 3]])  # fmt: skip
    found = findings_of(demo_scene, same)
    assert [each.views for each in found if each.code == "same_position"] == [(0, 1, 2, 3, 4, 5)]


def test_another_world_changes_nothing(demo_scene: Scene) -> None:
    turn = rotation([1, 2, 3], 70)
    cameras = moved(demo_scene.cameras, 0.013, turn, torch.tensor([5.0, -3.0, 100.0]).double())
    here, there = find_coverage(demo_scene.cameras), find_coverage(cameras)
    assert there.sees.all()
    np.testing.assert_allclose(there.angle, here.angle, atol=0.5)  # points of several rays are equally good
    expected = 0.013 * turn.numpy() @ here.point + [5, -3, 100]
    np.testing.assert_allclose(there.point, expected, atol=0.013 * 10)  # mm, of 400 to the cameras
    assert findings_of(demo_scene, turned(cameras, 3, 60))[0].views == (3,)


def test_the_point_is_where_the_plant_is(demo_scene: Scene) -> None:
    """All cameras of the arc look at the origin: neighbours see it under the angle between their places."""
    cameras = cameras_at(arc_positions(6))
    coverage = find_coverage(cameras)
    assert coverage.sees.all()
    assert np.linalg.norm(coverage.point) < 1.0  # of 10 to the cameras
    outwards = cameras.centers.numpy() / 10
    apart = np.degrees(np.arccos(np.clip(outwards @ outwards.T, -1, 1))) + 360 * np.eye(6)
    np.testing.assert_allclose(coverage.angle, apart.min(1), atol=4)


@pytest.mark.parametrize(
    ("fault", "level", "views", "code"),
    [
        (inverted, "error", (), "inverse_poses"),
        (flipped, "error", (), "opengl_poses"),
        (lambda cameras: inverted(flipped(cameras)), "error", (), "inverse_opengl_poses"),
        (lambda cameras: turned(cameras, 4, 70), "warning", (4,), "look_past"),
        (lambda cameras: replace(cameras, R=cameras.R[[0] * 9], t=cameras.t[[0] * 9]), "error", (), "same_place"),
        (lambda cameras: edited(cameras, 2, lambda K, t: t.mul_(1000)), "error", (2,), "mixed_units"),
        (lambda cameras: edited(cameras, 2, lambda K, t: t.mul_(20)), "warning", (2,), "far_out"),
        (lambda cameras: edited(cameras, 5, lambda K, t: K[:2].mul_(2)), "warning", (5,), "odd_principal_point"),
        (lambda cameras: edited(cameras, 5, lambda K, t: K[0, 0].mul_(1.5)), "warning", (5,), "odd_focal_lengths"),
    ],
)  # fmt: skip
def test_each_fault_has_its_code(
    fault: Fault, level: str, views: tuple[int, ...], code: str, demo_scene: Scene
) -> None:
    found = findings_of(demo_scene, fault(demo_scene.cameras))
    assert (code, level, views) in [(each.code, each.level, each.views) for each in found]


def test_cameras_that_look_elsewhere_are_no_fault(demo_scene: Scene) -> None:
    """A third of the photos of a row of plants look past the plant that most look at: nothing in them is wrong."""
    cameras = demo_scene.cameras
    for view in (1, 4, 7):
        cameras = turned(cameras, view, 60)
    found = findings_of(demo_scene, cameras)
    assert [(each.level, each.views) for each in found if each.code == "look_past"] == [("warning", (1, 4, 7))]
    assert "error" not in {each.level for each in found}


@pytest.mark.parametrize(
    ("views", "few"), [((1, 3, 5, 7), (1, 3, 5, 7)), ((0, 2, 4, 6, 8), (1, 3, 5, 7)), ((6,), (6,))]
)
@pytest.mark.parametrize(
    ("factor", "times", "units"),
    [(0.001, 1000, "millimetres and m"), (100, 100, "centimetres and m"), (0.1, 10, "millimetres and centim")],
)
def test_cameras_in_two_units(
    views: tuple[int, ...], few: tuple[int, ...], factor: float, times: int, units: str, demo_scene: Scene
) -> None:
    """Wherever the world's origin is; nothing else is said of where these cameras are."""
    far = moved(demo_scene.cameras, 1.0, rotation([1, 2, 3], 40), torch.tensor([900.0, -300.0, 100.0]).double())
    for cameras in (demo_scene.cameras, far):
        t = cameras.t.clone()
        t[list(views)] *= factor
        (found,) = findings_of(demo_scene, replace(cameras, t=t))
        ratio = 1 / times if (factor < 1) == (views == few) else times
        assert (found.code, found.views) == ("mixed_units", few)
        assert (found.values["ratio"], found.values["others"]) == (ratio, 9 - len(few))
        assert str(found.values["units"]).startswith(units)
        assert found.level == "error" or times == 10


def test_an_origin_at_a_camera_is_no_other_unit(demo_scene: Scene) -> None:
    for view in (0, 4):
        cameras = moved(demo_scene.cameras, 1.0, torch.eye(3).double(), -demo_scene.cameras.centers[view])
        assert findings_of(demo_scene, cameras) == []


def test_a_field_of_view_that_no_lens_has(demo_scene: Scene) -> None:
    K = demo_scene.cameras.K.clone()
    K[1, [0, 1], [0, 1]] = 50.0  # millimetres, taken for pixels
    cameras = replace(demo_scene.cameras, K=K)
    np.testing.assert_allclose(field_of_view(cameras)[1], np.degrees(2 * np.arctan(400 / 50)))  # photos of 640 x 480
    (found,) = findings_of(demo_scene, cameras)
    assert (found.code, found.views) == ("odd_field_of_view", (1,))


def test_views_from_one_side_only_or_too_far_apart(demo_scene: Scene) -> None:
    cameras = cameras_at(arc_positions(9, span=1.0)[[0, 2, 4, 6, 8, 0, 2, 4, 6]])
    found = findings_of(demo_scene, cameras)
    assert [(each.code, each.views) for each in found] == [
        ("same_position", (0, 1, 2, 3, 5, 6, 7, 8)),
        ("no_depth", ()),
    ]
    scene = replace(demo_scene, cameras=cameras_at(arc_positions(17, span=17.0)[::2]))
    (narrow,) = camera_findings(scene, find_coverage(scene.cameras))
    assert (narrow.code, narrow.level) == ("one_sided", "warning")
    assert narrow.values["degrees"] == pytest.approx(17, abs=2)
    scene = replace(demo_scene, views=demo_scene.views[:2], cameras=demo_scene.cameras[[0, 4]])
    (found,) = camera_findings(scene, find_coverage(scene.cameras))
    assert (found.code, found.level, found.views) == ("next_view_far", "warning", (0, 1))


def test_cameras_that_look_nowhere_together(demo_scene: Scene) -> None:
    R, t = (part.clone() for part in (demo_scene.cameras.R, demo_scene.cameras.t))
    for view in range(9):  # one at a place, all looking outwards along different axes
        R[view] = rotation([0, 0, 1], 40.0 * view) @ demo_scene.cameras.R[0]
        R[view] = R[view] @ rotation([0, 1, 0], 40.0 * view)
        t[view] = -R[view] @ (torch.eye(3).double()[view % 3] * 0.01 * view)
    found = findings_of(demo_scene, replace(demo_scene.cameras, R=R, t=t))
    assert "error" in {each.level for each in found} or "few_look_at_one_point" in [each.code for each in found]


def test_what_is_not_known_is_a_note(demo_scene: Scene) -> None:
    found = findings_of(replace(demo_scene, unit="", up=None), demo_scene.cameras)
    assert [(each.level, each.code) for each in found] == [("note", "unknown_unit"), ("note", "unknown_up")]


@pytest.mark.parametrize("up", [(0.0, 0.0, 1.0), None])
@pytest.mark.parametrize(("span", "num", "degrees", "gaps"), [(30, 3, 30, 1), (160, 9, 160, 1), (320, 9, 360, 0)])
def test_the_walk_is_measured_in_any_world(
    up: tuple[float, ...] | None, span: float, num: int, degrees: float, gaps: int
) -> None:
    """Without up, cameras at two heights are turned a little."""
    turn, shift = rotation([1, 2, 3], 70), torch.tensor([5.0, -3.0, 100.0]).double()
    here = cameras_at(arc_positions(num, span=span))
    for cameras, to in ((here, torch.eye(3).double()), (moved(here, 0.013, turn, shift), turn)):
        views = tuple(View(f"<{view}>", Path()) for view in range(num))
        scene = Scene("walk", views, cameras, up=up and tuple((to @ torch.tensor(up).double()).tolist()))
        sentence, picture = draw_walk(scene, off=(1,))
        assert int(sentence.split()[2]) == pytest.approx(degrees, abs=2 if up else 20)
        assert gaps == sentence.count(f"degrees between <{num - 1}> and <0>")
        parts = ElementTree.fromstring(picture)
        assert [part.get("fill") == RED for part in parts.findall("{*}g")] == [view == 1 for view in range(num)]
        assert sum(part.get("stroke") == RED for part in parts.findall("{*}circle")) == gaps
