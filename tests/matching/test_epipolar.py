"""Eqs. 1, 2 and 4 without lines, against lines: OpenCV's, and drawn ones."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest
import torch

from mvseg.errors import InputError
from mvseg.matching.epipolar import Spans, choose_bins, epipolar_bands, epipolar_map, find_spans, span_histogram
from mvseg.matching.pencil import epipolar_pencil, epipolar_pencils, is_coincident
from mvseg.matching.samples import view_runs, view_samples
from mvseg.regions import regions_from_label_maps
from mvseg.scene import Cameras
from reference import epipolar_map_reference, fundamental_reference
from synthetic import arc_positions, ball_scene, cameras_at, moved

# Two cameras side by side; one behind the other (epipoles inside both images); one above the other; face to face.
RIGS = {
    "side by side": [[10.0, 0, 0], [9.0, 4, 0]],
    "one behind the other": [[10.0, 0, 0], [6.0, 0.2, 0.1]],
    "one above the other": [[10.0, 0, 1], [8.0, 0, 6]],
    "face to face": [[10.0, 0, 1], [-10.0, 0.5, 1]],
}


def rig(name: str) -> Cameras:
    return cameras_at(torch.tensor(RIGS[name]))


def pixels_of_a_grid(cameras: Cameras, view: int) -> torch.Tensor:
    width, height = cameras.sizes[view].tolist()
    return torch.cartesian_prod(torch.arange(5.5, width, 20), torch.arange(5.5, height, 20))


@pytest.mark.parametrize("name", RIGS)
def test_corresponding_pixels_have_equal_angles(name: str) -> None:
    cameras = rig(name)
    points = torch.randn(200, 3, generator=torch.Generator().manual_seed(1)).double()
    px, depth = cameras.project(points)
    assert (depth > 0).all()
    pencil = epipolar_pencil(cameras, 0, 1)
    first, second = (pencil.angles(side, px[side]) for side in (0, 1))
    apart = (first - second).abs()
    torch.testing.assert_close(torch.minimum(apart, 4 - apart), torch.zeros(200).double(), atol=1e-9, rtol=0)


@pytest.mark.parametrize("name", RIGS)
def test_pixels_on_an_opencv_epipolar_line_share_its_half_plane(name: str) -> None:
    cameras = rig(name)
    pencil = epipolar_pencil(cameras, 0, 1)
    F = fundamental_reference(cameras, 0, 1)
    for pixel in pixels_of_a_grid(cameras, 0)[::7]:
        line = cv2.computeCorrespondEpilines(pixel.numpy().reshape(1, 1, 2).astype(np.float64), 1, F)[0, 0]
        u = torch.linspace(-500, 900, 50).double()
        a, b, c = line
        on_line = torch.stack((u, -(c + a * u) / b) if abs(b) > abs(a) else (-(c + b * u) / a, u), 1)
        line_angles = _angle(pencil.angles(1, on_line))
        pixel_angle = _angle(pencil.angles(0, pixel[None].double()))
        # The line is one plane: its two halves differ by half a turn.
        half_turn = torch.remainder(line_angles - pixel_angle + math.pi / 2, math.pi) - math.pi / 2
        assert half_turn.abs().max() < 1e-6


def _angle(pseudo: torch.Tensor) -> torch.Tensor:
    """The true angle, in radians, of a 1-norm angle."""
    y = torch.where(pseudo.abs() <= 1, pseudo, pseudo.sign() * (2 - pseudo.abs()))
    x = (1 - y.abs()) * torch.where(pseudo.abs() <= 1, 1.0, -1.0)
    return torch.atan2(y, x)


def test_pitch_is_the_angle_of_one_pixel_across_the_line() -> None:
    cameras = rig("side by side")
    pencil = epipolar_pencil(cameras, 0, 1)
    xy = torch.tensor([[50.5, 60.5]]).double()
    turn = torch.linspace(0, 6.28, 400).double()
    steps = torch.stack((turn.cos(), turn.sin()), 1)
    change = (pencil.angles(0, xy + 0.01 * steps) - pencil.angles(0, xy)).abs().max() / 0.01
    assert pencil.pitch(0, xy) == pytest.approx(float(change), rel=1e-3)


def test_pencils_of_many_pairs_are_those_of_each_pair() -> None:
    cameras = cameras_at(torch.cat([torch.tensor(positions) for positions in RIGS.values()]))
    pairs = (~is_coincident(cameras)).nonzero().tolist()
    for (i, j), pencil in zip(pairs, epipolar_pencils(cameras, pairs), strict=True):
        expected = epipolar_pencil(cameras, i, j).plane_from_px
        torch.testing.assert_close(pencil.plane_from_px, expected, atol=1e-12, rtol=0)
    assert epipolar_pencils(cameras, []) == []
    cameras = cameras_at(torch.tensor([[10.0, 0, 0], [10.0, 0, 0], [0.0, 10, 0]]))
    assert is_coincident(cameras).tolist() == [[True, True, False], [True, True, False], [False, False, True]]
    with pytest.raises(InputError, match="views 0 and 1"):
        epipolar_pencil(cameras, 0, 1)


def test_many_cameras_far_from_the_origin_keep_their_baselines() -> None:
    shift = torch.tensor([5e5, 5e6, 0.0]).double()
    cameras = moved(cameras_at(arc_positions(28, distance=0.35)), 1.0, torch.eye(3).double(), shift)
    assert torch.equal(is_coincident(cameras), torch.eye(28, dtype=torch.bool))


def test_histograms_of_very_many_pixels_count_in_wider_numbers() -> None:
    weight = torch.full((10,), 4e6)
    angles, owner = torch.full((10,), 0.5), torch.zeros(10, dtype=torch.int64)
    bins = choose_bins((0.01, 0.01), (torch.tensor([0.0, 1.0]),) * 2)
    spans = Spans(angles, angles.clone(), owner, weight, num_pixels=4e7, num_regions=1)
    assert span_histogram(bins, spans).sum() == 4e7


def test_runs_across_the_jump_and_near_an_epipole_count_as_pixels() -> None:
    cameras = rig("one behind the other")
    epipole = cameras.project(cameras.centers[1:])[0][0, 0].int().tolist()
    labels = np.zeros((2, 240, 320), np.uint8)
    labels[:, epipole[1] - 3 : epipole[1] + 3, epipole[0] - 40 : epipole[0] + 40] = 1
    runs, pixels = (view(regions_from_label_maps(labels))[0][0] for view in (view_runs, view_samples))
    pencil = epipolar_pencil(cameras, 0, 1)
    spans, angles = find_spans(pencil, 0, runs), pencil.angles(0, pixels.xy)
    bins = choose_bins((pencil.pitch(0, pixels.xy),) * 2, (angles, angles))
    assert float((spans.high - spans.low).max()) <= 0.25
    assert (spans.high == spans.low).sum() > 50
    far = (span_histogram(bins, spans) - span_histogram(bins, find_spans(pencil, 0, pixels))).cumsum(1).abs().max()
    assert far < 0.02 * len(angles)


@pytest.mark.parametrize("name", RIGS)
def test_epipolar_map_agrees_with_drawn_lines(name: str) -> None:
    """All pixels of a ball send out lines; the map and the drawing may differ only along the rim of a band."""
    scene = ball_scene(5, 3, seed=4)
    cameras = Cameras(*(torch.cat(pair) for pair in _with_third(rig(name))))
    members = scene.regions.select((scene.regions.labels == 1) & (scene.regions.view_index < 2))
    members = type(members)(members.view_index, members.boxes, members.crops, 3, members.labels)
    width, height = 320, 240
    v, u = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    ours = epipolar_map(members, cameras, view=2, xy=torch.stack((u, v), -1).reshape(-1, 2)).reshape(height, width)
    drawn = epipolar_map_reference(members, cameras, 2)
    assert ours.unique().numel() >= 2
    inside_both = (ours.numpy() > 0) & (drawn > 0)
    assert np.abs(ours.numpy() - drawn)[inside_both].mean() < 0.03
    kernel = np.ones((7, 7), np.uint8)
    rim = cv2.dilate(drawn, kernel) - cv2.erode(drawn, kernel)
    half_plane = ours.numpy()[rim == 0]  # away from rims both agree, but for the half of a line beyond the epipole
    assert (half_plane <= drawn[rim == 0] + 1e-6).mean() > 0.995
    if name != "one behind the other":
        assert np.abs(half_plane - drawn[rim == 0]).mean() < 0.01


def _with_third(pair: Cameras) -> list[tuple[torch.Tensor, torch.Tensor]]:
    third = cameras_at(torch.tensor([[2.0, 10, 3]]))
    return [(getattr(pair, name), getattr(third, name)) for name in ("K", "R", "t", "sizes")]


def test_a_region_has_no_band_in_its_own_view_and_true_matches_lie_in_each_others_bands() -> None:
    scene = ball_scene(8, 4, seed=2)
    regions = scene.regions
    for view in range(4):
        here = regions.select(regions.view_index == view)
        xy, owner = here.pixels()
        bands = epipolar_bands(regions, scene.cameras, view=view, xy=xy)
        assert not bands[regions.view_index == view].any()
        for number, label in enumerate(here.labels.tolist()):
            same = bands[(regions.labels == label) & (regions.view_index != view)][:, owner == number]
            assert same.float().mean() > 0.6


def test_a_map_without_members_elsewhere_is_zero() -> None:
    scene = ball_scene(3, 3)
    alone = scene.regions.select(scene.regions.view_index == 0)
    xy = torch.tensor([[10.5, 10.5], [160.5, 120.5]])
    assert epipolar_map(alone, scene.cameras, view=0, xy=xy).tolist() == [0.0, 0.0]
    assert epipolar_map(alone, scene.cameras, view=1, xy=torch.zeros(0, 2)).shape == (0,)
