"""Fixtures that many tests share: the shipped scene, real plants, and analytic scenes with exact answers."""

from __future__ import annotations

import gc
import os
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import cv2
import pytest
import torch
from threadpoolctl import ThreadpoolController

from mvseg import demo
from mvseg.cli import command
from mvseg.evaluation.truth import true_instances
from mvseg.formats.label_png import read_label_png
from mvseg.formats.scene_folder import load_masks, load_scene
from mvseg.regions import Regions
from mvseg.scene import Scene
from mvseg.system import threads, worker_pool

ROOT = Path(__file__).parent.parent
if "OMP_NUM_THREADS" not in os.environ:
    torch.set_num_threads(1)  # deterministic sums, and no spinning beside other tests
cv2.setNumThreads(1)  # OMP_NUM_THREADS does not bound its threads, and they spin while they wait
gc.disable()  # until all modules are there: a search among what they keep takes a third of a second, and finds nothing


def pytest_collection_finish() -> None:
    gc.freeze()
    gc.enable()


@pytest.fixture(scope="session", autouse=True)
def one_parser() -> Iterator[None]:
    """The parser of the command line is built once: that takes longer than most commands of the tests."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(command, "build_parser", cache(command.build_parser))
        yield


@pytest.fixture(scope="session", autouse=True)
def one_worker() -> Iterator[None]:
    """Commands fit surfaces in the process of the test: another one would load all libraries for some leaves. Libraries
    are looked for once, and nobody waits for the disk."""
    libraries = ThreadpoolController()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(worker_pool, "default_workers", lambda: 1)
        patch.setattr(threads, "threadpool_limits", lambda limits, **of: libraries.limit(limits=limits, **of))
        patch.setattr(os, "fsync", lambda _: None)
        yield


@pytest.fixture(scope="session")
def demo_scene() -> Scene:
    return load_scene(demo.demo_scene())


@pytest.fixture(scope="session")
def demo_regions(demo_scene: Scene) -> Regions:
    return load_masks(demo_scene, demo.demo_scene() / "masks")


@pytest.fixture(scope="session")
def demo_truth(demo_scene: Scene, demo_regions: Regions) -> torch.Tensor:
    """(D,) true leaf of each region of the shipped scene."""
    return true_ids(demo_scene, demo_regions, demo.demo_scene() / "truth")


def true_ids(scene: Scene, regions: Regions, truth: Path) -> torch.Tensor:
    """(D,) true leaf of each region, from a folder of label PNGs."""
    sizes = scene.cameras.sizes.tolist()
    maps = [read_label_png(truth / f"{view.name}.png", *size) for view, size in zip(scene.views, sizes, strict=True)]
    return true_instances(regions, maps)


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of real plants, which do not ship with mvseg."""
    folder = Path(os.environ.get("MVSEG_SHARED_DATA", ROOT.parent / "shared" / "data"))
    if not folder.is_dir():
        pytest.skip(f"the real plants are not here ({folder}); set MVSEG_SHARED_DATA to their folder")
    return folder
