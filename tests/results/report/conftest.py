"""A result for the page: three balls of voxels in four views."""

from __future__ import annotations

import pytest

from mvseg.config import RunConfig
from mvseg.pipeline.run_scene import run_scene
from mvseg.reconstruction.config import ReconstructConfig
from mvseg.results.result import Result
from scene_folders import write_scene


@pytest.fixture(scope="session")
def balls(tmp_path_factory: pytest.TempPathFactory) -> Result:
    plant = write_scene(tmp_path_factory.mktemp("scenes") / "balls")
    voxels = ReconstructConfig(shape="voxels", voxel_budget=8000)
    return run_scene(plant, plant / "masks", RunConfig(reconstruct=voxels))
