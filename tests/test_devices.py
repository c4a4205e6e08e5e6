"""Whatever device the masks are on: the same answers there, and nothing that a GPU would refuse."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor

from mvseg import (
    EpipolarAssignment,
    MatchConfig,
    cluster_aware_nms,
    epipolar_map,
    match_regions,
    reconstruct_instances,
    region_affinity,
)
from mvseg.reconstruction.config import ReconstructConfig
from mvseg.regions import Regions
from mvseg.scene import Cameras
from other_device import other_device
from synthetic import ball_scene

SCENE = ball_scene(4, 3, seed=1)
IDS = SCENE.regions.labels
COARSE = ReconstructConfig(voxel_budget=2_000)
XY = torch.tensor([[0.5, 0.5], [100.5, 80.5], [90.5, 95.5]])


@pytest.mark.parametrize(
    "step",
    [
        lambda regions, cameras, _: region_affinity(regions, cameras).to_dense(),
        lambda regions, cameras, _: region_affinity(regions, cameras, num_points=50, seed=0).to_dense(),
        lambda regions, cameras, _: match_regions(regions, cameras).instance_ids,
        lambda regions, cameras, _: match_regions(regions, cameras).match_scores,
        lambda regions, cameras, _: match_regions(regions, cameras, MatchConfig(method="one-per-view")).instance_ids,
        lambda regions, cameras, _: match_regions(regions, cameras, MatchConfig(method="symnmf")).instance_ids,
        lambda regions, cameras, _: epipolar_map(regions, cameras, view=1, xy=XY.to(regions.device)),
        lambda regions, cameras, ids: EpipolarAssignment()(regions, regions, ids, cameras=cameras)[0],
        lambda regions, cameras, ids: EpipolarAssignment()(regions, regions, ids, cameras=cameras)[1],
        lambda regions, cameras, ids: cluster_aware_nms(regions.boxes.float(), regions.areas.float(), ids),
        lambda regions, cameras, ids: reconstruct_instances(regions, ids, cameras, config=COARSE)[1].votes,
        lambda regions, cameras, ids: regions.label_map(0, ids, cameras.sizes[0].tolist()),
    ],
    ids=["affinity", "points", "nview", "scores", "one-per-view", "symnmf", "map", "assignment", "similarity", "nms",
         "voxels", "label map"],
)  # fmt: skip
def test_the_answer_is_there_and_the_same(step: Callable[[Regions, Cameras, Tensor], Any]) -> None:
    expected = step(SCENE.regions, SCENE.cameras, IDS)
    with other_device() as device:
        answer = step(SCENE.regions.to(device), SCENE.cameras.to(device), IDS.to(device))
        assert answer.device == device
        assert answer.dtype == expected.dtype
        torch.testing.assert_close(answer.cpu(), expected)


def test_the_other_device_refuses_what_a_gpu_refuses() -> None:
    here = torch.arange(6.0).reshape(2, 3)
    with other_device() as device:
        there = here.to(device)
        with pytest.raises(RuntimeError, match="expected all tensors on the same device"):
            there + here
        with pytest.raises(RuntimeError, match="expected all tensors on the same device"):
            there[[0, 1]] = here
        with pytest.raises(RuntimeError, match="expected all tensors on the same device"):
            here[there[0].long()]
        with pytest.raises(TypeError, match="to NumPy"):
            there.numpy()
        there[torch.tensor([1])] += 1
        assert (there + 1).device == device
        assert there.tolist() == [[0, 1, 2], [4, 5, 6]]
        assert torch.zeros_like(there).cpu().device == here.device
        assert torch.tensor([1.5], device=device).item() == 1.5


def test_autocast_there_is_that_of_a_gpu() -> None:
    """Convolutions and products are cast; what is single by name, and what is outside, is not."""
    layer, ones = torch.nn.Linear(2, 2), torch.ones(1, 2)
    with other_device() as device:
        layer, ones = layer.to(device), ones.to(device)
        with torch.autocast(device.type):
            assert layer(ones).dtype == torch.float16
            assert (ones + ones).dtype == torch.float32
            with torch.autocast(device.type, enabled=False):
                assert layer(ones).dtype == torch.float32
            assert layer(ones).dtype == torch.float16
        with torch.autocast("cpu", torch.bfloat16):
            assert layer(ones).dtype == torch.float32
            assert (torch.ones(1, 2) @ torch.ones(2, 1)).dtype == torch.bfloat16
        assert layer(ones).dtype == torch.float32
