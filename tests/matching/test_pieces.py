"""A second mask of one photo in one cluster: a piece of the leaf, or a stranger."""

from __future__ import annotations

import numpy as np
import torch

from mvseg.matching.links import Links
from mvseg.matching.match import match_regions
from mvseg.regions import Regions, regions_from_label_maps
from mvseg.scene import Scene
from synthetic import ball_scene

STEP = 25  # every so many masks, each of another leaf and view; all 108 take a minute


def test_a_leaf_that_one_photo_shows_joins_no_other(
    demo_scene: Scene, demo_regions: Regions, demo_truth: torch.Tensor
) -> None:
    """All masks of a leaf but one are taken away: that one stays alone, or its score says that it is a guess."""
    misled = []
    for row in range(0, len(demo_regions), STEP):
        keep = demo_truth != demo_truth[row]
        keep[row] = True
        matching = match_regions(demo_regions.select(keep.nonzero()[:, 0]), demo_scene.cameras)
        lone = int(keep[:row].sum())
        if matching.instance_ids[lone] > 0 and matching.match_scores[lone] > 0.3:
            misled.append(row)
    assert not misled


def test_pieces_stay_where_masks_are_often_in_pieces() -> None:
    """Each ball cut in two, in two of eight photos: one id for both parts."""
    scene = ball_scene(5, 8, seed=2)
    maps = [labels.astype(np.int64) for labels in scene.label_maps]
    for labels in maps[::4]:
        for ball in np.unique(labels[labels > 0]):
            _, columns = np.nonzero(labels == ball)
            right = (labels == ball) & (np.arange(labels.shape[1]) > columns.mean() + 1)
            labels[right] = ball + 100
    regions = regions_from_label_maps(maps)
    truth, ids = regions.labels % 100, match_regions(regions, scene.cameras).instance_ids
    together = ids[:, None] == ids
    assert torch.equal(together, truth[:, None] == truth)


def test_what_a_person_joined_stays(demo_scene: Scene, demo_regions: Regions, demo_truth: torch.Tensor) -> None:
    row = 18
    keep = demo_truth != demo_truth[row]
    keep[row] = True
    chosen, lone = demo_regions.select(keep.nonzero()[:, 0]), int(keep[:row].sum())
    neighbour = int(((chosen.view_index == chosen.view_index[lone]).nonzero()[:, 0] != lone).nonzero()[0, 0])
    first = int((chosen.view_index == chosen.view_index[lone]).nonzero()[neighbour, 0])
    ids = match_regions(chosen, demo_scene.cameras, links=Links.of([(lone, first)])).instance_ids
    assert ids[lone] == ids[first] > 0
