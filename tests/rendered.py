"""One photo of a plant."""

from __future__ import annotations

from mvseg.scene import Cameras
from mvseg.simulation.growth import SimulatedPlant
from mvseg.simulation.ray_cast import Rendering, build_stage, render_stage


def render_view(plant: SimulatedPlant, cameras: Cameras, view: int, *, seed: int) -> Rendering:
    return render_stage(build_stage(plant, seed=seed), cameras, view)
