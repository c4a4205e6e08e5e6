"""Masks that cover two instances: found, told apart from sound ones, and parted about where the two meet."""

from __future__ import annotations

import torch
from sklearn.metrics import adjusted_rand_score

from mvseg.matching.affinity import region_affinity
from mvseg.matching.nview.cluster_scores import Costs
from mvseg.matching.nview.label_rows import row_table
from mvseg.matching.nview.match_nview import match_nview
from mvseg.matching.nview.merged_masks import second_part
from mvseg.matching.one_per_view import dense_ids
from synthetic import ball_scene, merged_balls


def test_a_mask_that_covers_two_instances_is_found_and_no_other() -> None:
    scene = ball_scene(6, 8, seed=3)
    regions, numbers, region = merged_balls(scene)
    rest = torch.arange(len(regions)) != region
    found = match_nview(regions, scene.cameras, region_affinity(regions, scene.cameras))
    assert adjusted_rand_score(found.instance_ids[rest], regions.labels[rest]) == 1
    assert len(found.support) == 6
    instances = [int(found.instance_ids[rest][regions.labels[rest] == number][0]) for number in numbers]
    assert found.merged[:, 0].tolist() == [region]
    assert sorted(found.merged[0, 1:].tolist()) == sorted(instances)
    assert found.merged[0, 1] == found.instance_ids[region]
    assert found.merged_parts[0].shape == regions.crop(region).shape


def test_either_ball_is_the_part_that_the_true_image_shows() -> None:
    """From the true ids; the merged mask may have the id of either ball."""
    scene = ball_scene(6, 8, seed=3)
    regions, numbers, region = merged_balls(scene)
    x1, y1, x2, y2 = regions.boxes[region].tolist()
    true = torch.from_numpy(scene.label_maps[int(regions.view_index[region])][y1:y2, x1:x2])
    mask, table = regions.crop(region), row_table(regions, scene.cameras)
    for own, other in (numbers, numbers[::-1]):
        labels = regions.labels.clone()
        labels[region] = own
        ids = dense_ids(labels.numpy())
        second = int(ids[(labels == other).nonzero()[0, 0]])
        part = second_part(regions, table, ids, region, second, Costs())
        assert not part[~mask].any()
        assert ((true == other) == part)[mask].double().mean() > 0.9
