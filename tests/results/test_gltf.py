"""How a world lies in glTF's: metres, +y up."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from blade_scene import ring_cameras
from mvseg.results.plant_files import describe_world, gltf_from_world
from mvseg.results.plant_graph import leaf_extras
from mvseg.scene import Scene, View
from mvseg.traits.leaf import Measurement, missing
from mvseg.traits.measure import LeafTraits

SCENE = Scene("basil", tuple(View(str(view), Path("absent.png")) for view in range(2)), ring_cameras(2))


@pytest.mark.parametrize("up", [(0, 0, 1), (0, -1, 0), (0.6, 0, -0.8), (1, 0, 0)])
@pytest.mark.parametrize(("unit", "metres"), [("mm", 0.001), ("m", 1.0), (" CM", 0.01), ("inch", 0.0254)])
def test_up_is_y_and_lengths_are_metres(up: tuple[float, float, float], unit: str, metres: float) -> None:
    scene = replace(SCENE, up=up, unit=unit)
    matrix = gltf_from_world(scene)
    np.testing.assert_allclose(matrix @ [*up, 0], [0, metres, 0, 0], atol=1e-12)
    np.testing.assert_allclose(matrix[:3, :3] @ matrix[:3, :3].T, metres**2 * np.eye(3), atol=1e-12)
    assert np.linalg.det(matrix) == pytest.approx(metres**3)  # no mirror
    np.testing.assert_array_equal(matrix[:, 3], [0, 0, 0, 1])
    said = describe_world(scene)
    assert (said["is_in_metres"], said["is_y_up"], said["unit"]) == (True, True, unit)


def test_what_is_not_known_stays() -> None:
    np.testing.assert_array_equal(gltf_from_world(SCENE), np.eye(4))
    nothing = {"plant": "basil", "unit": None, "up": None, "is_in_metres": False, "is_y_up": False}
    assert describe_world(SCENE) == nothing
    odd = replace(SCENE, unit="pot", up=(0, 2, 0))
    np.testing.assert_allclose(gltf_from_world(odd), np.eye(4), atol=1e-12)
    assert describe_world(odd) == nothing | {"unit": "pot", "up": [0, 1, 0], "is_y_up": True}


def test_leaves_say_their_numbers_and_no_others() -> None:
    numbers = {
        "area": Measurement(1234.5678, 12.3456789, "surface"),
        "num_views": Measurement(4.0, float("nan"), "masks"),
        "azimuth": missing("up is not known"),
    }
    doubts = {"first": "one", "second": "two"}
    leaf = LeafTraits(leaf=12, numbers=numbers, method="surface", reasons=doubts, rejection=None, unit="mm")
    assert leaf_extras(leaf) == {
        "leaf": 12, "unit": "mm", "method": "surface", "use": "look", "quality": "one; two",
        "traits": {"area": 1234.57, "num_views": 4}, "sd": {"area": 12.3457},
    }  # fmt: skip
