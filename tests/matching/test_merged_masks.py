"""Masks that cover two instances: found, told apart from sound ones, and split about where the two meet."""

from __future__ import annotations

import numpy as np
import torch

from mvseg.evaluation.id_metrics import matching_metrics
from mvseg.matching.affinity import region_affinity
from mvseg.matching.nview.cluster_scores import ClusterScores
from mvseg.matching.nview.match_nview import match_nview
from mvseg.matching.nview.merged_masks import second_part
from mvseg.matching.nview.plane_sweep import sweep_planes
from mvseg.matching.partition import Clusters
from mvseg.matching.view_graph import ViewGraph
from synthetic import ball_scene, merged_balls


def test_a_mask_that_covers_two_instances_is_found_and_no_other() -> None:
    scene = ball_scene(6, 8, seed=3)
    regions, numbers, region = merged_balls(scene)
    rest = torch.arange(len(regions)) != region
    matching = match_nview(regions, scene.cameras, ViewGraph.of(region_affinity(regions, scene.cameras), regions))
    assert matching_metrics(regions.labels[rest], matching.instance_ids[rest]).ari == 1
    assert matching.num_instances == 6
    instances = [int(matching.instance_ids[rest][regions.labels[rest] == number][0]) for number in numbers]
    (merged,) = matching.merged
    assert merged.region == region
    assert sorted((merged.own, merged.other)) == sorted(instances)
    assert merged.own == matching.instance_ids[region]
    assert merged.part.shape == regions.crop(region).shape


def test_either_ball_is_the_part_that_the_true_image_shows() -> None:
    """From the true ids; the merged mask may have the id of either ball."""
    scene = ball_scene(6, 8, seed=3)
    regions, numbers, region = merged_balls(scene)
    x1, y1, x2, y2 = regions.boxes[region].tolist()
    true = torch.from_numpy(scene.label_maps[int(regions.view_index[region])][y1:y2, x1:x2])
    mask, sweep = regions.crop(region), sweep_planes(regions, scene.cameras)
    no_weights = ViewGraph(np.zeros((len(regions), len(regions))), sweep.view_index, sweep.num_views)
    scores = ClusterScores(sweep, no_weights)
    for own, other in (numbers, numbers[::-1]):
        labels = regions.labels.clone()
        labels[region] = own
        clusters = Clusters.of(labels.numpy())
        second = int(clusters.ids[(labels == other).nonzero()[0, 0]])
        part = second_part(scores, clusters, regions, region=region, second=second)
        assert not part[~mask].any()
        assert ((true == other) == part)[mask].double().mean() > 0.9
