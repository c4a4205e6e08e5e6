"""The world that the user asks for: the scale and the unit of its lengths, and which way is up."""

from __future__ import annotations

import warnings
from dataclasses import replace

from mvseg.errors import InputError, InputWarning
from mvseg.scene import Scene
from mvseg.traits.config import Up
from mvseg.traits.up import find_up


def place_scene(scene: Scene, *, scale: float | None = None, unit: str | None = None, up: Up | None = None) -> Scene:
    """The scene in the world that the user asks for; None leaves what the scene says.

    Warns (InputWarning) of a unit that contradicts the scene's and comes without a scale, and of an up that the cameras
    contradict (`Scene.seems_upside_down`).

    Args:
        scene: as it was loaded.
        scale: its lengths are multiplied by this.
        unit: name of the unit of the lengths after that.
        up: see `find_up`.

    Raises:
        InputError: a scale of cameras that say their unit, without the unit of the lengths after it; up cannot be
            found, see `find_up`.
    """
    if scale is not None:
        if unit is None and scene.unit and scale != 1:
            problem = f"scale is {scale:g} without a unit, but the cameras are in {scene.unit}"
            raise InputError(f"{problem}: expected the unit of the scaled lengths, too, as in --unit {scene.unit}")
        scene = replace(scene, cameras=scene.cameras.scale(scale))
    if unit is not None:
        if scene.unit not in ("", unit) and scale is None:
            message = f"the cameras are in {scene.unit}: unit {unit} without a scale only renames it"
            warnings.warn(message, InputWarning, stacklevel=4)
        scene = replace(scene, unit=unit)
    scene = find_up(scene, up)
    if scene.seems_upside_down:
        message = "up may be upside down: the cameras look up at the plant, or hang upside down; if not, reverse it"
        warnings.warn(message, InputWarning, stacklevel=4)
    return scene
