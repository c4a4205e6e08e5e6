"""Surfaces never harm: ids of masks of real and of simulated plants are at least as good with them as without. And they
do not depend on how the world stands."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from torch import Tensor

from benchmarks.faults import Faults, degrade_labels
from benchmarks.label_maps import visible_ids
from conftest import true_ids
from mvseg.evaluation.id_metrics import matching_metrics
from mvseg.evaluation.truth import true_instances
from mvseg.formats.scene_folder import load_masks, load_scene
from mvseg.matching.match import match_regions
from mvseg.regions import Regions, regions_from_label_maps
from mvseg.scene import Cameras
from mvseg.simulation.cameras import arc_cameras
from mvseg.simulation.growth import grow_plant
from turned_worlds import tell_otherwise
from verified import verify_ids

LEAST_ARI = {"basil-0729": 1.0, "basil-dense": 0.93, "maize-series/D54.9": 1.0}  # the second measured: 0.974

OTHERS = ("ovate", 2), ("lanceolate", 3)  # plants and their seeds

Given = tuple[Cameras, Regions, Tensor]  # and the true leaf of each region


def read(folder: Path) -> Given:
    scene = load_scene(folder)
    regions = load_masks(scene, folder / "masks")
    return scene.cameras, regions, true_ids(scene, regions, folder / "truth")


def ids_with_and_without(cameras: Cameras, regions: Regions) -> tuple[Tensor, Tensor]:
    matched = match_regions(regions, cameras).masks
    return verify_ids(matched, cameras=cameras).instance_ids, matched.instance_ids


@pytest.mark.slow
@pytest.mark.shared_data
@pytest.mark.filterwarnings("ignore::mvseg.errors.InputWarning")
@pytest.mark.parametrize("name", LEAST_ARI)
def test_surfaces_never_harm_ids_of_real_plants(name: str, shared_data: Path) -> None:
    cameras, regions, truth = read(shared_data / name)
    found, alone = (matching_metrics(ids, truth).ari for ids in ids_with_and_without(cameras, regions))
    assert found >= max(alone, LEAST_ARI[name])


@pytest.mark.filterwarnings("ignore::mvseg.errors.InputWarning")
@pytest.mark.parametrize(
    ("family", "seed"), [("rosette", 1), *(pytest.param(*each, marks=pytest.mark.slow) for each in OTHERS)]
)
def test_surfaces_never_harm_ids_of_simulated_plants(family: str, seed: int) -> None:
    plant = grow_plant(family, 6, seed)
    cameras = arc_cameras(5, plant, span_deg=200, elevations_deg=(20, 50), width=120, height=120)
    true = visible_ids(plant, cameras)
    faults = Faults(missed=0.1, split=0.1, merged=0.1)
    regions = regions_from_label_maps([degrade_labels(ids, faults, seed=view) for view, ids in enumerate(true)])
    truth = true_instances(regions, list(true), count_background=False)
    found, alone = (matching_metrics(ids, truth).ari for ids in ids_with_and_without(cameras, regions))
    assert found >= alone


def stand_otherwise(cameras: Cameras, regions: Regions, order: list[int]) -> tuple[Cameras, Regions]:
    """The same scene mirrored, turned and moved, in another unit, its views in another `order`, its photos turned."""
    ids = torch.arange(1, len(regions) + 1)
    sizes = [tuple(cameras.sizes[view].tolist()) for view in order]
    maps = [regions.label_map(view, ids, size).numpy() for view, size in zip(order, sizes, strict=True)]
    maps, turned = tell_otherwise(maps, cameras[order])["all three"]
    t = 0.01 * (turned.t - turned.R @ torch.tensor([70.0, -20, 5]).double())
    return replace(turned, t=t), regions_from_label_maps(maps)


@pytest.mark.slow
@pytest.mark.shared_data
@pytest.mark.parametrize(("name", "is_alone_the_same"), [("basil-0729", True), ("basil-dense", False)])
def test_ids_do_not_depend_on_how_the_world_stands(name: str, is_alone_the_same: bool, shared_data: Path) -> None:
    """Of the dense plant, those of the matcher alone do, in masks that it is not sure of: it casts few rays of each."""
    cameras, regions, _ = read(shared_data / name)
    order = torch.randperm(len(cameras), generator=torch.Generator().manual_seed(4)).tolist()
    moved, turned = stand_otherwise(cameras, regions, order)
    row = turned.labels - 1  # of the same mask
    found, alone = zip(ids_with_and_without(cameras, regions), ids_with_and_without(moved, turned), strict=True)
    for expected, other in (found, alone) if is_alone_the_same else (found,):
        one = expected[row]
        assert torch.equal(one[:, None] == one, other[:, None] == other)
