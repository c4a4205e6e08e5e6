"""Edits of what a detector found, from the masks that a person sees to the leaves that the views choose after them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
import torch

from blade_scene import as_regions
from mvseg.config import RunConfig
from mvseg.corrections.apply import APPLIED
from mvseg.corrections.file import Corrections, Edit, Reject
from mvseg.formats.photos import Photos
from mvseg.masks import Masks, Origin
from mvseg.matching.result import Matching, MatchReport
from mvseg.pipeline import list_stages
from mvseg.reconstruction.surface.leaf_surface import LeafSurface
from mvseg.scene import Cameras, Scene, View
from mvseg.stages import State
from mvseg.verification import choose as choosing
from three_leaves import CAMERAS, LEAVES, true_maps

REGIONS, IDS = as_regions(true_maps())
WEAK = 3  # the leaf whose masks score too low to be matched at first
PROPOSALS = Masks.of(
    replace(REGIONS, labels=torch.arange(len(REGIONS))),
    detection_scores=torch.where(IDS == WEAK, 0.25, 0.8),
    origin=Origin.DETECTED,
)
MATCHED = replace(PROPOSALS, instance_ids=IDS, match_scores=torch.full((len(IDS),), 0.9))
VIEWS = tuple(View(f"v{view}", Path(f"v{view}.png")) for view in range(len(CAMERAS)))
OTHERS = ("detect", "follow", "snap", "say_what_is_missing", "check", "reconstruct", "settle", "measure")
SCENE = Scene(name="plant", views=VIEWS, cameras=CAMERAS, unit="mm", up=None)


@dataclass(frozen=True)
class Found:
    """What a detector would have found: the sure masks are those of two leaves."""

    def match(self, cameras: Cameras) -> Matching:
        return Matching(MATCHED.select(IDS != WEAK), MatchReport("nview"))

    def match_more(self, cameras: Cameras) -> tuple[Masks, ...]:
        return (MATCHED,)

    def proposals(self, cameras: Cameras) -> Masks:
        return PROPOSALS


def fit(masks: Masks, _: Cameras) -> dict[int, LeafSurface]:
    ids = masks.instance_ids
    instances = ids[ids > 0].unique().tolist()
    return {each: LEAVES[int(IDS[masks.regions.labels[ids == each]].mode().values)] for each in instances}


def at(leaf: int, view: int) -> tuple[float, float]:
    """A point of a leaf in a photo."""
    row = int(((leaf == IDS) & (REGIONS.view_index == view)).nonzero()[0, 0])
    y, x = np.argwhere(REGIONS.crop(row).numpy())[0] + REGIONS.boxes[row, [1, 0]].numpy()
    return float(x) + 0.5, float(y) + 0.5


def run(*edits: Edit) -> State:
    found = Found()
    state = State(
        config=RunConfig(),
        scene=SCENE,
        photos=Photos(SCENE),
        found=found,  # type: ignore[arg-type]
        corrections=Corrections(edits) if edits else None,
    )
    for name, stage in list_stages(state.config, has_masks=False, has_edits=len(edits) > 0).items():
        state = state if name in OTHERS else stage(state)
    return state


@pytest.fixture(autouse=True)
def known_surfaces(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(choosing, "fit_roughly", fit)


def as_painted(state: State) -> list[np.ndarray]:
    """V maps of which leaf every pixel shows: the true number."""
    masks = state.masks
    leaves = IDS[masks.regions.labels] * (masks.instance_ids > 0)
    return [masks.regions.label_map(view, leaves, tuple(CAMERAS.sizes[view].tolist())).numpy() for view in range(6)]


def test_an_edit_is_about_the_mask_that_is_seen_whatever_it_scores() -> None:
    """Every mask of the weak leaf is shown, though none was matched at first; and it is gone as a whole."""
    before = run()
    assert set(np.unique(as_painted(before))) == {0, 1, 2, WEAK}
    state = run(Reject(view="v0", at=at(WEAK, 0), everywhere=True))
    assert [each.fate for each in state.result().fates] == [APPLIED]
    assert set(np.unique(as_painted(state))) == {0, 1, 2}
    for one, other in zip(as_painted(before), as_painted(state), strict=True):
        assert np.array_equal(np.where(one == WEAK, 0, one), other)


@pytest.mark.filterwarnings("ignore:correction 1")
def test_an_answer_that_changes_nothing_changes_nothing() -> None:
    before, after = run(), run(Reject(view="v0", at=(1.0, 1.0)))
    assert before.instances.probabilities == after.instances.probabilities
    assert torch.equal(before.masks.instance_ids, after.masks.instance_ids)
    assert torch.equal(before.masks.regions.crops, after.masks.regions.crops)


def test_what_is_known_without_a_person_is_found_once() -> None:
    known = run(Reject(view="v0", at=at(1, 0), everywhere=True)).unedited
    assert known is not None
    assert len(known.leaves.probabilities) == 3
    assert [len(each) for each in known.matched] == [int((IDS != WEAK).sum()), len(IDS)]
