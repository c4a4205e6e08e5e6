"""What scene.glb holds beside its meshes: the transform of the world to glTF's, and the traits of each leaf.

glTF is in metres, and +y is up. A scene whose cameras do not state unit or up keeps its own.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from mvseg.scene import Scene
from mvseg.traits.measure import Traits
from mvseg.traits.table import format_number
from mvseg.traits.up import level_frame

METRES = {
    "m": 1.0, "metre": 1.0, "metres": 1.0, "meter": 1.0, "meters": 1.0,
    "dm": 1e-1,
    "cm": 1e-2, "centimetre": 1e-2, "centimetres": 1e-2, "centimeter": 1e-2, "centimeters": 1e-2,
    "mm": 1e-3, "millimetre": 1e-3, "millimetres": 1e-3, "millimeter": 1e-3, "millimeters": 1e-3,
    "um": 1e-6, "µm": 1e-6,
    "in": 0.0254, "inch": 0.0254, "inches": 0.0254,
    "ft": 0.3048, "foot": 0.3048, "feet": 0.3048,
}  # fmt: skip


def gltf_from_world(scene: Scene) -> NDArray[np.float64]:
    """(4, 4) that rotates up to +y and east to +x (`level_frame`) if up is known, and scales lengths to metres if the
    unit is known."""
    matrix = np.eye(4)
    if scene.up is not None:
        east, north, up = level_frame(scene.up)
        matrix[:3, :3] = np.stack([east, up, -north])
    matrix[:3, :3] *= METRES.get(scene.unit.strip().lower(), 1.0)
    return matrix


def describe_world(scene: Scene) -> dict[str, Any]:
    """The extras of the node above all leaves: the unit and the up of the meshes' own coordinates, None where unknown,
    and whether the node brings them to glTF's."""
    is_known = scene.unit.strip().lower() in METRES
    up = None if scene.up is None else list(scene.up)
    placed = {"is_in_metres": is_known, "is_y_up": up is not None}
    return {"plant": scene.name, "unit": scene.unit or None, "up": up, **placed}


def leaf_extras(traits: Traits | None) -> dict[str, dict[str, Any]]:
    """{name of a leaf's node: its extras}: id, unit, method, quality, and its existing numbers with standard
    deviations."""
    found: dict[str, dict[str, Any]] = {}
    if traits is None:
        return found
    for leaf in traits.leaves:
        numbers = {name: number for name, number in leaf.numbers.items() if number.exists}
        found[f"leaf_{leaf.leaf:03d}"] = {
            "leaf": leaf.leaf,
            "unit": traits.unit or None,
            "method": leaf.method,
            "quality": "; ".join(leaf.reasons) or "good",
            "traits": {name: _rounded(number.value) for name, number in numbers.items()},
            "sd": {name: _rounded(number.sd) for name, number in numbers.items() if np.isfinite(number.sd)},
        }
    return found


def _rounded(value: float) -> float:
    return float(format_number(value))
