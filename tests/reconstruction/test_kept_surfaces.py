"""A run fits an instance once, as long as its masks stay the same."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import pytest
import torch
from torch import Tensor

from mvseg.reconstruction.surface.kept_surfaces import fit_kept, name_each
from mvseg.reconstruction.surface.leaf_surface import LeafSurface
from mvseg.regions import Regions
from mvseg.scene import Cameras
from mvseg.system.running import running
from synthetic import ball_scene

SCENE = ball_scene(4, 3, seed=1)
REGIONS, IDS = SCENE.regions, SCENE.regions.labels
Asked = list[set[int]]


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> Asked:
    """The instances that each call fitted anew."""
    seen: Asked = []

    def fit(
        _: Regions, ids: Tensor, cameras: Cameras, known: Mapping[int, LeafSurface] = {}, **how: Any
    ) -> dict[int, LeafSurface]:
        present = {*ids[ids > 0].tolist()}
        seen.append(present - {*known})
        return {each: known.get(each, LeafSurface.none(torch.arange(2), f"{each}")) for each in present}

    monkeypatch.setattr("mvseg.reconstruction.surface.kept_surfaces.fit_surfaces", fit)
    return seen


def test_the_same_masks_are_fitted_once_whatever_their_number_and_order(asked: Asked) -> None:
    everything = {*IDS.tolist()}
    with running(keep=True):
        first = fit_kept(REGIONS, IDS, SCENE.cameras)
        with running(progress=False, keep=True):  # what the outer one keeps, the inner one has
            again = fit_kept(REGIONS, IDS + 10, SCENE.cameras)
        turned = torch.arange(len(IDS)).flip(0)
        third = fit_kept(REGIONS.select(turned), IDS[turned], SCENE.cameras)
    assert asked == [everything]
    assert all(first[each] is again[each + 10] is third[each] for each in everything)


def test_what_changed_is_fitted_again(asked: Asked) -> None:
    one = int(IDS[0])
    moved = torch.where(torch.arange(len(IDS)) == 0, -1, IDS)
    with running(keep=True):
        fit_kept(REGIONS, IDS, SCENE.cameras)
        fit_kept(REGIONS, moved, SCENE.cameras)
        fit_kept(REGIONS, moved, SCENE.cameras, is_rough=True)
        fit_kept(REGIONS, moved, SCENE.cameras, starts={})
        fit_kept(REGIONS, IDS, SCENE.cameras[[1, 0, 2]])
    assert asked == [{*IDS.tolist()}, {one}, {*moved.tolist()} - {-1}, {*IDS.tolist()}]


def test_without_a_run_nothing_is_kept(asked: Asked) -> None:
    for _ in range(2):
        fit_kept(REGIONS, IDS, SCENE.cameras)
    with running(keep=True):
        fit_kept(REGIONS, IDS, SCENE.cameras)
    assert asked == [{*IDS.tolist()}] * 3
    assert fit_kept(REGIONS, torch.full_like(IDS, -1), SCENE.cameras) == {}


def test_names_are_those_of_contents() -> None:
    names = name_each(REGIONS)
    assert len({*names}) == len(REGIONS)
    assert name_each(REGIONS.select(torch.tensor([2, 0]))) == [names[2], names[0]]
