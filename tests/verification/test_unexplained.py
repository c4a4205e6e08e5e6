"""Where leaves were probably missed, one sentence says so; where none was, nothing is said."""

from __future__ import annotations

import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from blade_scene import SIZE, as_regions
from found_masks import FoundMasks, open_photos, see_masks
from leafy_scene import write_leafy_scene
from mvseg.config import RunConfig
from mvseg.corrections.corrected import Fate
from mvseg.masks import Masks, Origin
from mvseg.matching.result import Matching, MatchReport
from mvseg.pipeline.find_in_photos import find_in_photos
from mvseg.pipeline.finish import check_result, shape_leaves
from mvseg.verification.numbers import COLORS
from mvseg.verification.picture import find_missing, share_unexplained
from three_leaves import true_maps
from warned import warns_of

MAPS = true_maps()
REGIONS, IDS = as_regions(MAPS)
GREEN, GREY = (40, 160, 50), (128, 120, 110)


def photo(view: int) -> np.ndarray:
    """Green leaves before grey."""
    return np.where((MAPS[view] > 0)[..., None], np.uint8(GREEN), np.uint8(GREY))


def found(leaves: tuple[int, ...], score: float = 0.8) -> Masks:
    keep = torch.isin(IDS, torch.tensor(leaves, dtype=torch.int64))
    scores = torch.full((int(keep.sum()),), score)
    return Masks.of(REGIONS.select(keep), IDS[keep], torch.ones_like(scores), detection_scores=scores)


@pytest.mark.parametrize("leaves", [(1, 2, 3), (1, 3), (2,)])
def test_the_share_is_that_of_the_pixels(leaves: tuple[int, ...]) -> None:
    every = sum(int((labels > 0).sum()) for labels in MAPS)
    inside = sum(int(np.isin(labels, leaves).sum()) for labels in MAPS)
    assert share_unexplained(found(leaves), photo) == pytest.approx(1 - inside / every)


def test_thinned_photos_say_nearly_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    whole = share_unexplained(found((2,)), photo)
    monkeypatch.setattr("mvseg.verification.picture.COLORS", replace(COLORS, most_px=SIZE // 2))
    assert share_unexplained(found((2,)), photo) == pytest.approx(whole, abs=0.01)


def test_what_is_missing_is_said_once() -> None:
    assert find_missing(found((1, 2, 3)), photo, sure_score=0.3) is None
    share = share_unexplained(found((2,)), photo)
    assert share > 0.5
    missed = find_missing(found((2,)), photo, sure_score=0.3)
    assert missed is not None
    assert (missed.code, missed.values["share"]) == ("leaves_missed", share)
    unknown = find_missing(found((1, 2, 3), score=0.2), photo, sure_score=0.3)
    assert unknown is not None
    assert unknown.code == "species_unknown"
    nothing = replace(found((1,)), instance_ids=torch.full((len(found((1,))),), -1))
    missing = find_missing(nothing, photo, sure_score=0.3)
    assert missing is not None
    assert missing.code == "no_leaves"
    by_hand = replace(found((1, 2, 3)), detection_scores=torch.full((len(IDS),), torch.nan))
    assert find_missing(by_hand, photo, sure_score=0.3) is None


def test_a_run_that_finds_no_leaf_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Unless a person has rejected them all."""
    leafy = write_leafy_scene(tmp_path, num_leaves=1, num_views=3, size=64, span_deg=120)
    nothing = Masks.of(leafy.regions.select(torch.zeros(0, dtype=torch.int64)), origin=Origin.DETECTED)
    see_masks(monkeypatch, FoundMasks.of(Matching(nothing, MatchReport("none"))))
    with warns_of("nothing_detected"):
        known = find_in_photos(open_photos(leafy.scene, RunConfig(reconstruct=None)))
    with warns_of("no_leaves"):
        check_result(shape_leaves(known), known)
    rejected = replace(known, edits=(Fate(1, "reject", "applied"),))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_result(shape_leaves(rejected), rejected)
