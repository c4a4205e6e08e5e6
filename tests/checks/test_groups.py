"""Views of two worlds: each agrees with its group, and no group with the other."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from benchmarks.faults import Faults, degrade_labels
from mvseg.checks.groups import group_findings, world_groups
from mvseg.checks.poses import PoseAgreement, pairwise_agreement
from mvseg.errors import InputWarning
from mvseg.findings.finding import Finding
from mvseg.formats.scene_folder import load_masks, load_scene
from mvseg.regions import Regions, regions_from_label_maps
from mvseg.scene import Cameras, Scene
from synthetic import ball_scene
from two_worlds import every_second_farther, half_turned

TWO_WORLDS = [
    pytest.param(lambda cameras: every_second_farther(cameras, 1.1), ((0, 2, 4, 6, 8), (1, 3, 5, 7)), id="t x 1.1"),
    pytest.param(lambda cameras: half_turned(cameras, 10), ((4, 5, 6, 7, 8), (0, 1, 2, 3)), id="half turned"),
]


def findings_of(regions: Regions, cameras: Cameras) -> list[Finding]:
    names = tuple(f"{view:03d}" for view in range(len(cameras)))
    return group_findings(pairwise_agreement(regions, cameras), names)


def degraded(regions: Regions, cameras: Cameras, seed: int) -> Regions:
    """The masks of a faulty segmenter."""
    sizes = enumerate(cameras.sizes.tolist())
    maps = [regions.label_map(view, regions.labels, size).numpy().astype(np.uint16) for view, size in sizes]
    return regions_from_label_maps(
        [degrade_labels(labels, Faults(), seed=9 * seed + view) for view, labels in enumerate(maps)]
    )


@pytest.mark.parametrize(("fault", "groups"), TWO_WORLDS)
@pytest.mark.parametrize("masks", ["true", "degraded"])
def test_two_worlds_are_named(
    masks: str,
    fault: Callable[[Cameras], Cameras],
    groups: tuple[tuple[int, ...], ...],
    demo_scene: Scene,
    demo_regions: Regions,
) -> None:
    cameras = demo_scene.cameras
    regions = demo_regions if masks == "true" else degraded(demo_regions, cameras, 0)
    assert world_groups(pairwise_agreement(regions, fault(cameras))) == groups
    (found,) = findings_of(regions, fault(cameras))
    assert (found.code, found.level, found.views) == ("separate_worlds", "error", groups[1])


@pytest.mark.parametrize("seed", [None, 0])
def test_one_world_is_one_group(seed: int | None, demo_scene: Scene, demo_regions: Regions) -> None:
    regions = demo_regions if seed is None else degraded(demo_regions, demo_scene.cameras, seed)
    assert findings_of(regions, demo_scene.cameras) == []
    assert world_groups(pairwise_agreement(regions, demo_scene.cameras)) == (tuple(range(9)),)


def test_three_worlds() -> None:
    """Three groups of three views; between them, chance alone."""
    group = np.repeat(np.arange(3), 3)
    is_same = group[:, None] == group
    pairs = PoseAgreement(
        fitting=np.where(np.eye(9) > 0, np.nan, np.where(is_same, 0.8, 0.1)),
        num_masks=np.where(np.eye(9) > 0, 0, 20),
        offset=np.where(np.eye(9) > 0, np.nan, np.where(is_same, 0.0, 9.0)),
        unit_px=1.0,
    )
    assert world_groups(pairs) == ((0, 1, 2), (3, 4, 5), (6, 7, 8))
    assert [each.views for each in group_findings(pairs, tuple("abcdefghi"))] == [(3, 4, 5), (6, 7, 8)]


def test_a_view_without_masks_is_in_no_group(demo_scene: Scene, demo_regions: Regions) -> None:
    regions = demo_regions.select(demo_regions.view_index != 3)
    cameras = every_second_farther(demo_scene.cameras, 1.1)
    assert world_groups(pairwise_agreement(regions, cameras)) == ((0, 2, 4, 6, 8), (1, 5, 7))
    none = demo_regions.select(torch.zeros(0, dtype=torch.int64))
    assert findings_of(none, cameras) == []


def test_few_masks_are_a_warning_at_most() -> None:
    scene = ball_scene(4, 8)
    assert {each.level for each in findings_of(scene.regions, every_second_farther(scene.cameras, 1.3))} <= {"warning"}


@pytest.mark.shared_data
def test_a_small_turn_of_half_the_real_cameras_is_named(shared_data: Path) -> None:
    """(tests/test_check.py: right ones have no finding.)"""
    scene = load_scene(shared_data / "basil-0729")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", InputWarning)
        regions = load_masks(scene, shared_data / "basil-0729" / "masks")
    (found,) = findings_of(regions, half_turned(scene.cameras, 5))
    assert found.views == (6, 7, 8, 9, 10, 11)
