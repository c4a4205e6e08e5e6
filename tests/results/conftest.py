"""A plant and its result: three balls in four views, one of them through a lens, as voxels."""

from __future__ import annotations

from pathlib import Path

import pytest

from mvseg.config import RunConfig
from mvseg.formats.label_png import read_label_png
from mvseg.formats.lens import distort, opencv_lens
from mvseg.pipeline.run_scene import run_scene
from mvseg.reconstruction.config import ReconstructConfig
from mvseg.results.result import Result
from scene_folders import HEIGHT, WIDTH, K, edit_rig, write_image, write_scene


@pytest.fixture(scope="session")
def plant(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder, distortion = write_scene(tmp_path_factory.mktemp("scenes") / "plant"), [-0.8, 0.3, 0.01, -0.01, 0.0]
    edit_rig(folder, 2, distortion=distortion)
    lens = opencv_lens(K, distortion, width=WIDTH, height=HEIGHT)
    for path in (folder / "masks" / "002.png", folder / "truth" / "002.png"):
        write_image(path, distort(read_label_png(path, WIDTH, HEIGHT), lens, K))
    return folder


@pytest.fixture(scope="session")
def result(plant: Path) -> Result:
    config = RunConfig(reconstruct=ReconstructConfig(shape="voxels", voxel_budget=8000))
    return run_scene(plant, plant / "masks", config)
