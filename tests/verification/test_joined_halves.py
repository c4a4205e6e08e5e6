"""Two leaves that are halves of one: leaf 1 of three known ones, in two masks that overlap."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
import torch

from mvseg.crop import Crop
from mvseg.evaluation.panoptic import leaf_metrics
from mvseg.masks import Masks, Origin
from mvseg.matching.match import match_masks
from mvseg.pipeline.plant import Plant
from mvseg.regions import stack_regions
from mvseg.results.result import Instances
from mvseg.verification.choose import Judges, fit_roughly
from mvseg.verification.joined_halves import join_halves, share_edge
from three_leaves import CAMERAS, halved_maps, true_maps

TRUE, HALVED = true_maps(), halved_maps((0, 1, 2, 4, 5))  # one view shows one half alone
GREEN = np.array([[20, 20, 20], [60, 160, 60], [50, 110, 40], [90, 150, 40]])


def halves(overlap: int = 7) -> Masks:
    """The masks of leaves 1, 2, 3 and 11, which is half of leaf 1; the two halves overlap, pixels."""
    rows = []
    for view, (truth, labels) in enumerate(zip(TRUE, HALVED, strict=True)):
        for leaf in np.unique(labels[labels > 0]).tolist():
            shown = cv2.dilate((labels == leaf).astype(np.uint8), np.ones((overlap, overlap), np.uint8)) > 0
            rows.append((view, Crop.of(shown & (truth == leaf % 10)), leaf))
    regions = stack_regions(rows, len(CAMERAS))
    score = torch.full((len(rows),), 0.8)
    return Masks.of(regions, regions.labels, score, detection_scores=score, origin=Origin.DETECTED)


def photo(view: int, *, edge: int = 0) -> np.ndarray:
    """Leaves with a texture; `edge`: how much darker the second half of leaf 1 is."""
    noise = np.random.default_rng(view).normal(0, 20, (*TRUE[view].shape, 1))
    shade = cv2.GaussianBlur(noise, (0, 0), 2.0)[..., None] * 3 - edge * (HALVED[view] == 11)[..., None]
    return (GREEN[TRUE[view]] + shade).clip(0, 255).astype(np.uint8)


def fit(masks: Masks) -> dict:
    return fit_roughly(masks, CAMERAS, None)


def test_halves_become_one_leaf_whatever_their_numbers() -> None:
    masks = halves()
    joined = join_halves(masks, photo, fit)
    assert joined is not None
    assert set(joined.instance_ids.tolist()) == {1}
    for row in (joined.proposal < 0).nonzero()[:, 0].tolist():
        whole = torch.from_numpy(TRUE[int(joined.view_index[row])] == 1)
        assert Crop.of(whole).iou(joined.regions.placed(row)) > 0.99
    assert joined.view_index[joined.proposal >= 0].tolist() == [3]
    other = join_halves(replace(masks, instance_ids=12 - masks.instance_ids), photo, fit)
    assert other is not None
    assert torch.equal(
        other.regions.boxes[other.view_index.argsort()], joined.regions.boxes[joined.view_index.argsort()]
    )


@pytest.mark.parametrize(("edge", "overlap"), [(60, 7), (0, 1)])
def test_two_leaves_stay_two_with_an_edge_between_them_or_no_overlap(edge: int, overlap: int) -> None:
    assert join_halves(halves(overlap), lambda view: photo(view, edge=edge), fit) is None


def test_edges_are_the_same_from_both_sides_and_grow_with_the_step() -> None:
    regions = halves().regions
    one, other = (regions.placed(int((regions.labels == leaf).nonzero()[0])) for leaf in (1, 11))
    edges = [share_edge(one, other, photo(0, edge=edge)) for edge in (0, 15, 30, 60)]
    assert edges == sorted(edges)
    assert 0.7 < edges[0] < 1.3 < edges[-1]
    assert share_edge(other, one, photo(0, edge=30)) == pytest.approx(edges[2])
    assert share_edge(one, regions.placed(int((regions.labels == 3).nonzero()[0])), photo(0)) == np.inf


def test_a_joined_leaf_stands_for_its_halves_and_its_masks_are_proposals() -> None:
    masks = halves()
    opened: Any = SimpleNamespace(judges=Judges(CAMERAS, photos=photo))
    matching = match_masks(masks, CAMERAS).with_masks(masks)
    plant = Plant(opened, matching, masks, {"matched": masks}, image_size=1, boxes=torch.zeros(6, 4))
    plant = plant.choose().add_joined()
    assert plant.masks.num_instances == 3
    assert plant.proposals.proposal.tolist() == [*range(len(masks) + 5)]  # five views show both halves
    assert torch.equal(plant.choose().masks.proposal, plant.masks.proposal)
    assert replace(plant, instances=Instances()).add_joined().matched is plant.matched  # surfaces do not judge
    whole = [np.where(labels == 11, 1, labels) for labels in HALVED]
    assert leaf_metrics(plant.masks.regions, plant.masks.instance_ids, whole).mv_pq > 0.95
