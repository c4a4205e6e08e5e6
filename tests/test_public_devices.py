"""Every public name: what it gives back is where its inputs were, or on the CPU where its docstring says so.
Nothing is asked of a device that a GPU would refuse."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import mvseg
from mvseg import (
    Cameras,
    EpipolarAssignment,
    LeafSurface,
    Masks,
    MatchConfig,
    Matching,
    MatchReport,
    Origin,
    ReconstructConfig,
    Regions,
    Scene,
    check_scene,
    cluster_affinity,
    cluster_aware_nms,
    epipolar_map,
    fit_surfaces,
    match_regions,
    matching_metrics,
    measure_plant,
    reconstruct_instances,
    region_affinity,
    shape_distance,
)
from mvseg.corrections.mask_questions import list_mask_questions
from mvseg.formats.photos import Photos
from mvseg.matching.links import Links
from mvseg.matching.match import match_masks
from mvseg.scene import View
from mvseg.verification.choose import Judges, choose_leaves
from mvseg.verification.snap_edges import snap_masks
from other_device import other_device
from synthetic import ball_scene

SCENE = ball_scene(2, 3, seed=1)
IDS = SCENE.regions.labels
CPU = torch.device("cpu")
COARSE, XY = ReconstructConfig(voxel_budget=2_000), torch.tensor([[0.5, 0.5], [100.5, 80.5], [90.5, 95.5]])
# Names whose answers are tried on another device in other files, and names that take and give no tensors.
ELSEWHERE = {"MultiViewMaskRCNN", "Cameras"}
WITHOUT_TENSORS = {
    "__version__", "InputError", "InputWarning", "MatchConfig", "DetectConfig", "TraitsConfig", "ReconstructConfig",
    "RunConfig", "Check", "Finding", "Corrections", "load_corrections", "LeafLink", "Tracks", "track_leaves",
    "running", "demo_scene", "Traits", "MatchReport", "Matching", "Origin", "Affinity",
}  # fmt: skip
# They read files, or take arrays of any kind: what they make is on the CPU.
MAKERS = {
    "load_masks", "load_result", "load_scene", "load_photos", "load_detector", "run_scene",
    "regions_from_masks", "Scene",
    "regions_from_label_maps", "with_instance_ids",
}  # fmt: skip


def scene_there(cameras: Cameras) -> Scene:
    views = tuple(View(f"{view}", Path("nowhere") / f"{view}.png") for view in range(len(cameras)))
    return Scene("balls", views, cameras)


@cache
def surfaces() -> dict[int, LeafSurface]:
    return fit_surfaces(SCENE.regions, IDS, SCENE.cameras)


def masks_of(regions: Regions, ids: torch.Tensor) -> Masks:
    return Masks.of(regions, ids, torch.ones(len(regions)).to(regions.device))


def detected(regions: Regions, ids: torch.Tensor) -> Masks:
    """What a detector found, numbered as the excessive set is."""
    masks = masks_of(replace(regions, labels=torch.arange(len(regions)).to(regions.device)), ids)
    origin = torch.full_like(masks.origin, Origin.DETECTED)
    return replace(masks, origin=origin, detection_scores=masks.match_scores * 0.8)


def grey_photos(cameras: Cameras) -> Callable[[int], np.ndarray]:
    sizes = cameras.sizes.tolist()
    return lambda view: np.full((sizes[view][1], sizes[view][0], 3), 128, np.uint8)


Step = Callable[[Regions, Cameras, torch.Tensor], Any]
STEPS: dict[str, tuple[Step, bool]] = {  # and whether the answer stays on the device
    "region_affinity": (lambda r, c, i: region_affinity(r, c).to_dense(), True),
    "random points": (lambda r, c, i: region_affinity(r, c, num_points=50, seed=0).to_dense(), True),
    "nview": (lambda r, c, i: match_regions(r, c).match_scores, True),
    "one-per-view": (lambda r, c, i: match_regions(r, c, MatchConfig(method="one-per-view")).instance_ids, True),
    "symnmf": (lambda r, c, i: match_regions(r, c, MatchConfig(method="symnmf")).instance_ids, True),
    "epipolar_map": (lambda r, c, i: epipolar_map(r, c, view=1, xy=XY.to(r.device)), True),
    "EpipolarAssignment": (lambda r, c, i: torch.stack([*EpipolarAssignment()(r, r, i, cameras=c)]), True),
    "cluster_aware_nms": (lambda r, c, i: cluster_aware_nms(r.boxes.float(), r.areas.float(), i), True),
    "reconstruct_instances": (lambda r, c, i: reconstruct_instances(r, i, c, config=COARSE)[1].votes, True),
    "Regions": (lambda r, c, i: r.label_map(0, i, c.sizes[0].tolist()), True),
    "match_regions": (lambda r, c, i: match_regions(r, c, links=Links.of([(0, 3)], [(0, 1)])).instance_ids, True),
    "match_masks": (lambda r, c, i: match_masks(masks_of(r, i), c, links=Links.of()).match_scores, True),
    "cluster_affinity": (lambda r, c, i: cluster_affinity(region_affinity(r, c), r.num_per_view).instance_ids, True),
    "Masks": (lambda r, c, i: Masks.concatenate([masks_of(r, i)] * 2).count_sure_views(), True),
    "LeafSurface": (lambda r, c, i: surfaces()[1].project(c)[0], True),
    "fit_surfaces": (lambda r, c, i: fit_surfaces(r, i, c)[1].coefficients, False),
    "choose_leaves": (
        lambda r, c, i: choose_leaves(m := detected(r, i), {"matched": m}, Judges(c.to("cpu"))).probabilities, False
    ),
    "snap_masks": (lambda r, c, i: snap_masks(detected(r, i), grey_photos(c)).instance_ids, False),
    "list_mask_questions": (lambda r, c, i: len(list_mask_questions(masks_of(r, i), surfaces(), cameras=c)), False),
    "matching_metrics": (lambda r, c, i: matching_metrics(i, i).ari, False),
    "shape_distance": (lambda r, c, i: shape_distance(c.t, c.t), False),
    "check_scene": (lambda r, c, i: len(check_scene(scene_there(c), r).findings), False),
    "measure_plant": (
        lambda r, c, i: measure_plant(
            scene_there(c), Matching(masks_of(r, i), MatchReport("none")), surfaces=surfaces(), voxels={},
            photos=Photos(scene_there(c)),
        ).whole["total_leaf_area"].value,
        False,
    ),
}  # fmt: skip


@pytest.mark.filterwarnings("ignore::mvseg.errors.InputWarning")
@pytest.mark.parametrize("name", STEPS)
def test_the_answer_is_the_same_there(name: str) -> None:
    step, stays = STEPS[name]
    expected = step(SCENE.regions, SCENE.cameras, IDS)
    surfaces()  # fitted here
    with other_device() as device:
        answer = step(SCENE.regions.to(device), SCENE.cameras.to(device), IDS.to(device))
        if not isinstance(answer, torch.Tensor):
            assert answer == pytest.approx(expected)
            return
        assert answer.device == (device if stays else CPU)
        torch.testing.assert_close(answer.cpu(), expected)


def test_every_public_name_is_looked_at() -> None:
    inner = {"match_masks", "choose_leaves", "snap_masks", "list_mask_questions"}  # of stages, not public
    inner |= {"random points", "nview", "one-per-view", "symnmf"}
    assert STEPS.keys() - inner | ELSEWHERE | WITHOUT_TENSORS | MAKERS == set(mvseg.__all__)


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
