from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import binary_dilation
from scipy.spatial.transform import Rotation

from blade_scene import SIZE, as_regions, ring_cameras
from mvseg.reconstruction.surface.fit_surfaces import fit_surfaces
from mvseg.reconstruction.surface.leaf_frame import find_axes, find_middle, find_quarters, turn_matrix, turn_pixels
from mvseg.reconstruction.surface.leaf_surface import LeafSurface
from mvseg.scene import Cameras
from three_leaves import CAMERAS, true_maps
from turned_worlds import tell_otherwise

AREAS = np.array([50, 80, 70, 80, 20])


def some_cameras(num_views: int = 5) -> np.ndarray:
    return ring_cameras(num_views, elevations_deg=(10, 70, 35)).px_from_world.numpy()


def test_axes_turn_and_are_mirrored_as_the_world_is_and_the_middle_is_where_rays_meet() -> None:
    px_from_world, middle = some_cameras(), np.array([0.1, -0.2, 0.3])
    axes = find_axes(px_from_world, middle, AREAS)
    assert axes @ axes.T == pytest.approx(np.eye(3), abs=1e-12)
    turn = Rotation.random(random_state=0).as_matrix() @ np.diag([1.0, 1.0, -1.0])
    turned = np.concatenate([px_from_world[:, :, :3] @ turn.T, px_from_world[:, :, 3:]], 2)
    assert find_axes(turned, turn @ middle, AREAS) == pytest.approx(axes @ turn.T, abs=1e-9)
    order = [4, 0, 1, 2, 3]
    assert find_axes(px_from_world[order], middle, AREAS[order]) == pytest.approx(axes, abs=1e-9)
    px_from_world, point = some_cameras(), np.array([0.3, -0.1, 0.2])
    shown = px_from_world @ np.append(point, 1)
    assert find_middle(px_from_world, shown[:, :2] / shown[:, 2:]) == pytest.approx(point, abs=1e-9)


def test_turned_pixels_are_where_the_matrix_says() -> None:
    pixels = np.arange(12).reshape(3, 4)
    units = [np.diag([a, b]) for a in (1, -1) for b in (1, -1)]
    for quarter in (*units, *(unit[::-1] for unit in units)):
        turned, matrix = turn_pixels(pixels, quarter), turn_matrix(quarter, (4, 3))
        for row, column in np.ndindex(pixels.shape):
            x, y, _ = matrix @ (column + 0.5, row + 0.5, 1)
            assert turned[int(y), int(x)] == pixels[row, column]


def test_photos_are_turned_to_one_side_however_they_were() -> None:
    def shown_axes(cameras: Cameras) -> np.ndarray:
        """(V, 3, 3) the leaf's axes in the turned photos."""
        px_from_world = cameras.px_from_world.numpy()
        axes = find_axes(px_from_world, np.zeros(3), AREAS)
        quarters = find_quarters(px_from_world, np.zeros(3), axes)
        turns = np.array([turn_matrix(each, (SIZE, SIZE)) for each in quarters])
        return turns @ px_from_world[:, :, :3] @ axes.T

    cameras = ring_cameras(5, elevations_deg=(10, 70, 35))
    for _, told in tell_otherwise([np.zeros((SIZE, SIZE))] * 5, cameras).values():
        assert shown_axes(told) == pytest.approx(shown_axes(cameras), abs=1e-8)


def largest_change(surfaces: dict[int, LeafSurface], others: dict[int, LeafSurface]) -> float:
    """Of all areas, in their deviations."""
    assert surfaces.keys() == others.keys()
    assert [each.is_credible for each in surfaces.values()] == [each.is_credible for each in others.values()]
    return max(abs(others[i].area - each.area) / each.deviations[0] for i, each in surfaces.items() if each.exists)


def test_areas_do_not_depend_on_how_world_and_photos_are_turned() -> None:
    """Masks that contradict each other, so that the start decides."""
    maps, cameras = true_maps()[:4], CAMERAS[[0, 1, 2, 3]]
    for view, labels in enumerate(maps):
        labels[binary_dilation(labels == 2, iterations=1 + 2 * (view % 3)) & (labels == 0)] = 2
        labels[:, 95 + 4 * view : 105 + 4 * view] = 0
        labels[labels != 2] = 0
    surfaces = fit_surfaces(*as_regions(maps), cameras)
    turned, cameras = tell_otherwise(maps, cameras)["all three"]
    assert largest_change(surfaces, fit_surfaces(*as_regions(turned), cameras)) < 0.05
