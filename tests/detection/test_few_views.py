"""Leaves that one or two photos show: dropped, or kept as they were found."""

from __future__ import annotations

import json
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from blade_scene import as_regions
from found_masks import FoundMasks, open_photos, see_masks
from leafy_scene import LeafyScene, write_leafy_scene
from mvseg.config import RunConfig
from mvseg.detection.config import DetectConfig
from mvseg.detection.few_views import select_by_views
from mvseg.errors import InputError, InputWarning
from mvseg.masks import Masks, Origin
from mvseg.matching.result import Matching, MatchReport
from mvseg.pipeline.find_leaves import find_in_photos
from mvseg.pipeline.finish import finish
from mvseg.results.folder import save_result

SIZE = 40


def detected(*views: dict[int, tuple[int, int, int, int]]) -> Masks:
    """Boxes (xyxy) by instance id, in each view; negative ids are matched to nothing."""
    maps, ids = [], []
    for shown in views:
        labels = np.zeros((SIZE, SIZE), np.int64)
        for number, (instance, (x1, y1, x2, y2)) in enumerate(shown.items(), 1):
            labels[y1:y2, x1:x2] = number
            ids.append(max(instance, -1))
        maps.append(labels)
    regions, _ = as_regions(maps)
    scores = torch.linspace(0.9, 0.4, len(ids))
    return Masks.of(regions, torch.tensor(ids), detection_scores=scores, origin=Origin.DETECTED)


A, B, C = (2, 2, 10, 10), (12, 2, 20, 10), (22, 2, 30, 10)
FOUND = detected({1: A, 2: B, -1: C}, {1: A, 2: B}, {1: A, -1: (23, 2, 31, 10)}, {1: A, -1: (3, 2, 11, 10)})
VERIFIED = detected({1: A}, {1: A}, {1: A}, {1: A})


def test_by_default_what_verification_leaves_is_left() -> None:
    assert select_by_views(VERIFIED, FOUND, min_views=2) is VERIFIED


def test_what_few_photos_show_is_kept_as_it_was_found() -> None:
    with pytest.warns(InputWarning, match="no other view verifies: 4"):
        kept = select_by_views(VERIFIED, FOUND, min_views=1)
    assert kept.instance_ids[:4].tolist() == [1] * 4
    added = kept.select(kept.origin == Origin.FEW_VIEWS)
    assert len(added) == len(kept) - 4
    # the pair keeps a common id, the two others get one each; what lies on a verified mask goes
    assert added.view_index.tolist() == [0, 0, 1, 2]
    assert added.instance_ids.tolist() == [2, 3, 2, 4]
    assert not torch.isnan(added.detection_scores).any()
    chosen = torch.tensor([1, 2, 4, 6])
    assert torch.equal(added.regions.boxes, FOUND.regions.boxes[chosen])
    assert torch.equal(added.detection_scores, FOUND.detection_scores[chosen])


def test_of_two_masks_on_each_other_the_better_one_stays() -> None:
    found = detected({-1: A}, {1: B}, {1: B})
    worse = replace(found.select(torch.tensor([0])), detection_scores=torch.tensor([0.3]))
    both = Masks.concatenate((worse, found))
    with pytest.warns(InputWarning, match="verifies: 1 "):
        kept = select_by_views(found.select(found.instance_ids == 1), both, min_views=1)
    assert kept.detection_scores.tolist() == pytest.approx([0.65, 0.4, 0.9])


def test_more_views_can_be_asked_for() -> None:
    assert select_by_views(FOUND, FOUND, min_views=3).instance_ids.tolist() == [1] * 4
    assert len(select_by_views(FOUND, FOUND, min_views=5)) == 0
    drawn = replace(FOUND, origin=torch.where(FOUND.view_index == 0, int(Origin.CORRECTED), FOUND.origin))
    kept = select_by_views(drawn, FOUND, min_views=5)  # the leaves and masks of a person stay
    assert kept.instance_ids.tolist() == [1, 2, -1, 1, 2, 1, 1]
    with pytest.raises(InputError, match="min_views is 0, expected 1 or more"):
        DetectConfig(min_views=0)


@pytest.fixture(scope="module")
def leafy(tmp_path_factory: pytest.TempPathFactory) -> LeafyScene:
    return write_leafy_scene(tmp_path_factory.mktemp("leafy"), num_leaves=3, num_views=4, size=160, span_deg=180)


@pytest.mark.parametrize("min_views", [1, 2])
def test_a_leaf_in_one_photo_comes_out_marked(
    leafy: LeafyScene, tmp_path: Path, min_views: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    regions = leafy.regions.select((leafy.regions.labels != 3) | (leafy.regions.view_index == 0))
    ids = torch.where(regions.labels == 3, -1, regions.labels)
    scores = torch.full((len(regions),), 0.7)
    found = Masks.of(regions, ids, (ids > 0).float(), detection_scores=scores, origin=Origin.DETECTED)
    config = RunConfig(detect=DetectConfig(min_views=min_views))
    matching = Matching(found, MatchReport("nview", has_probabilities=True))
    see_masks(monkeypatch, FoundMasks.of(matching))
    with pytest.warns(InputWarning, match="no other view verifies: 1") if min_views == 1 else nullcontext():
        result = finish(find_in_photos(open_photos(leafy.scene, config)))
    assert result.surfaces is not None
    assert result.traits is not None
    save_result(result, tmp_path / "out", {})
    entries = json.loads((tmp_path / "out" / "instances.json").read_text())["annotations"]
    marked = [entry for entry in entries if entry.get("from_few_views")]
    assert len(marked) == (min_views == 1)
    for entry in marked:
        assert (entry["image_id"], entry["instance_id"], entry["score"]) == (1, result.matching.num_instances, 0.7)
        leaf = result.traits.leaves[-1]
        assert (leaf.leaf, leaf.method) == (entry["instance_id"], "none")
        assert "seen in one view only" in " ".join(leaf.reasons)
