"""One photo of a plant, and all bytes of its meshes."""

from __future__ import annotations

from mvseg.scene import Cameras
from mvseg.simulation.growth import SimulatedPlant
from mvseg.simulation.ray_cast import Rendering, build_stage, render_stage


def render_view(plant: SimulatedPlant, cameras: Cameras, view: int, *, seed: int) -> Rendering:
    return render_stage(build_stage(plant, seed=seed), cameras, view)


def flatten(plant: SimulatedPlant) -> bytes:
    meshes = [(leaf.vertices, leaf.faces) for leaf in plant.leaves]
    meshes += [(part.vertices, part.faces) for part in plant.parts]
    return b"".join(array.tobytes() for mesh in meshes for array in mesh)
