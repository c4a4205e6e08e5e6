"""Surfaces never harm: ids of masks of real and of simulated plants are at least as good with them as without. And they
do not depend on how the world stands."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
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
    """Masks of a faulty segmenter."""
    plant = grow_plant(family, 6, seed)
    cameras = arc_cameras(5, plant, span_deg=200, elevations_deg=(20, 50), width=120, height=120)
    true = visible_ids(plant, cameras)
    faults = Faults(missed=0.1, split=0.1, merged=0.1)
    regions = regions_from_label_maps([degrade_labels(ids, faults, seed=view) for view, ids in enumerate(true)])
    truth = true_instances(regions, list(true), count_background=False)
    found, alone = (matching_metrics(ids, truth).ari for ids in ids_with_and_without(cameras, regions))
    assert found >= alone


def stand_otherwise(cameras: Cameras, regions: Regions, order: Tensor) -> tuple[Cameras, Regions]:
    """The same scene mirrored, turned and moved, in another unit, its views in another `order` (V,), its photos turned
    by 90 degrees, pixel for pixel. The regions of a view keep their order."""
    mirror = torch.diag(torch.tensor([-1.0, 1, 1], dtype=torch.float64))
    quarter = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]], dtype=torch.float64)
    world = torch.from_numpy(Rotation.from_rotvec([0.4, -1.1, 0.7]).as_matrix())
    R, t = quarter @ mirror @ cameras.R @ mirror, (quarter @ mirror @ cameras.t[..., None])[..., 0]
    K = cameras.K.clone()
    # clockwise: what was at (u, v) of a mirrored photo of height H is at (H - v, u)
    K[:, 0, 0], K[:, 1, 1] = cameras.K[:, 1, 1], cameras.K[:, 0, 0]
    K[:, 0, 2], K[:, 1, 2] = cameras.sizes[:, 1] - cameras.K[:, 1, 2], cameras.sizes[:, 0] - cameras.K[:, 0, 2]
    moved = Cameras(K=K, R=R @ world.T, t=0.01 * (t - (R @ world.T @ torch.tensor([70.0, -20, 5]).double())),
                    sizes=cameras.sizes.flip(1))  # fmt: skip
    maps = []
    for view in order.tolist():
        ids = torch.arange(1, len(regions) + 1)
        labels = regions.label_map(view, ids, tuple(cameras.sizes[view].tolist())).numpy()
        maps.append(np.rot90(labels[:, ::-1], -1))
    return moved[order.tolist()], regions_from_label_maps([np.ascontiguousarray(each) for each in maps])


@pytest.mark.slow
@pytest.mark.shared_data
@pytest.mark.parametrize(("name", "is_alone_the_same"), [("basil-0729", True), ("basil-dense", False)])
def test_ids_do_not_depend_on_how_the_world_stands(name: str, is_alone_the_same: bool, shared_data: Path) -> None:
    """Of the dense plant, those of the matcher alone do, in masks that it is not sure of: it casts few rays of each."""
    cameras, regions, _ = read(shared_data / name)
    order = torch.randperm(len(cameras), generator=torch.Generator().manual_seed(4))
    moved, turned = stand_otherwise(cameras, regions, order)
    row = turned.labels - 1  # of the same mask
    found, alone = zip(ids_with_and_without(cameras, regions), ids_with_and_without(moved, turned), strict=True)
    for expected, other in (found, alone) if is_alone_the_same else (found,):
        one = expected[row]
        assert torch.equal(one[:, None] == one, other[:, None] == other)
