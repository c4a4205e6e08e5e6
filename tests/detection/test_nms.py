"""Eqs. 4 and 5 without maps, and NMS by cluster, against maps and loops."""

from __future__ import annotations

import pytest
import torch

from mvseg.detection.assignment import EpipolarAssignment, ruzicka_similarity
from mvseg.detection.nms import backed_by_views, cluster_aware_nms
from mvseg.errors import InputError
from reference import backed_by_views_reference, cluster_aware_nms_reference, epipolar_map_reference, ruzicka_reference
from synthetic import ball_scene


def random_boxes(count: int, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    corner = torch.rand(count, 2, generator=generator) * 60
    boxes = torch.cat((corner, corner + 10 + 30 * torch.rand(count, 2, generator=generator)), 1)
    return boxes, torch.rand(count, generator=generator)


def test_similarity_agrees_with_drawn_maps() -> None:
    scene = ball_scene(4, 4, seed=3, focal=200.0, width=160, height=120)
    ids = scene.regions.labels
    similarity = ruzicka_similarity(scene.regions, scene.regions, ids, cameras=scene.cameras)
    assert similarity.shape == (len(scene.regions), 4)
    for view in (0, 2):
        maps = [epipolar_map_reference(scene.regions.select(ids == k), scene.cameras, view) for k in range(1, 5)]
        for n in (scene.regions.view_index == view).nonzero()[:, 0].tolist():
            mask = scene.regions.mask(n, 160, 120).numpy()
            for k in range(4):
                assert float(similarity[n, k]) == pytest.approx(ruzicka_reference(maps[k], mask), abs=0.02)
    scene = ball_scene(6, 4, seed=3)
    ids = scene.regions.labels
    exact = ruzicka_similarity(scene.regions, scene.regions, ids, cameras=scene.cameras)
    thinned = ruzicka_similarity(scene.regions, scene.regions, ids, cameras=scene.cameras, max_pixels=256)
    torch.testing.assert_close(thinned, exact, atol=0.02, rtol=0)


def test_true_regions_are_assigned_to_their_own_cluster() -> None:
    scene = ball_scene(6, 5, seed=2)
    clusters, similarity = EpipolarAssignment()(
        scene.regions, scene.regions, scene.regions.labels, cameras=scene.cameras
    )
    assert (clusters == scene.regions.labels).float().mean() > 0.9
    assert ((similarity > 0) & (similarity <= 1)).all()


def test_the_clusters_may_be_numbered_in_any_way() -> None:
    scene = ball_scene(5, 4, seed=2)
    permutation = torch.tensor([3, 0, 4, 2, 1])
    ids = scene.regions.labels
    similarity = ruzicka_similarity(scene.regions, scene.regions, ids, cameras=scene.cameras)
    renamed = ruzicka_similarity(scene.regions, scene.regions, permutation[ids - 1] + 1, cameras=scene.cameras)
    torch.testing.assert_close(renamed[:, permutation], similarity, atol=1e-5, rtol=0)


def test_unmatched_regions_make_no_map_and_no_cluster_means_no_assignment() -> None:
    scene = ball_scene(3, 3, seed=2)
    clusters, similarity = EpipolarAssignment()(
        scene.regions, scene.regions, torch.full((len(scene.regions),), -1), cameras=scene.cameras
    )
    assert clusters.unique().tolist() == [-1]
    assert similarity.max() == 0
    only_view_0 = torch.where(scene.regions.view_index == 0, 1, -1)
    clusters, _ = EpipolarAssignment()(scene.regions, scene.regions, only_view_0, cameras=scene.cameras)
    assert (clusters[scene.regions.view_index == 0] == -1).all()  # its only member is in the same view


@pytest.mark.parametrize("iou_threshold", [0.1, 0.3, 0.7])
def test_nms_agrees_with_a_loop(iou_threshold: float) -> None:
    boxes, scores = random_boxes(60)
    groups = torch.randint(-1, 3, (60, 2), generator=torch.Generator().manual_seed(1))
    keep = cluster_aware_nms(boxes, scores, groups, iou_threshold)
    assert keep.tolist() == cluster_aware_nms_reference(boxes, scores, groups, iou_threshold)
    again = cluster_aware_nms(boxes[keep], scores[keep], groups[keep], iou_threshold)
    assert again.tolist() == list(range(len(keep)))  # idempotent


def test_just_past_the_threshold() -> None:
    boxes = torch.tensor([[0.0, 0, 10, 10], [0.0, 5, 10, 15]])  # IoU exactly 1/3
    scores = torch.tensor([0.9, 0.8])
    same = torch.zeros(2, dtype=torch.int64)
    assert cluster_aware_nms(boxes, scores, same, 1 / 3 + 1e-6).tolist() == [0, 1]
    assert cluster_aware_nms(boxes, scores, same, 1 / 3 - 1e-6).tolist() == [0]


def test_a_thousand_groups_do_not_blur_the_boxes() -> None:
    """In float32 torchvision's offsets would move these boxes by pixels: both of each pair must be compared exactly."""
    base = torch.tensor([[1000.0, 1000, 1001, 1001], [1000.25, 1000, 1001.25, 1001]])
    boxes, groups = base.repeat(1500, 1), torch.arange(1500).repeat_interleave(2)
    scores = torch.linspace(1, 0.1, 3000)
    assert len(cluster_aware_nms(boxes, scores, groups, 0.61)) == 3000
    assert len(cluster_aware_nms(boxes, scores, groups, 0.59)) == 1500


def test_nothing_in_nothing_out_and_lengths_must_agree() -> None:
    nothing = torch.zeros(0)
    assert cluster_aware_nms(torch.zeros(0, 4), nothing, nothing.long()).shape == (0,)
    with pytest.raises(InputError, match="2 boxes with 1 scores"):
        cluster_aware_nms(torch.zeros(2, 4), torch.zeros(1), torch.zeros(2))


def test_an_overlap_is_settled_by_the_other_views() -> None:
    box = torch.tensor([[0.0, 0, 10, 10]]).expand(6, 4)
    groups = torch.tensor([[0, 1]] * 5 + [[1, 1]])
    ids = torch.tensor([3, 3, 4, 5, -1, 3])
    scores = torch.tensor([0.2, 0.9, 0.9, 0.4, 0.0, 0.1])
    # the best; the same instance; surely another; not sure; nothing; alone in its view
    assert backed_by_views(box, groups, ids, match_scores=scores).tolist() == [True, False, True, False, False, True]
    apart = box + 20 * torch.arange(6)[:, None]
    assert backed_by_views(apart, groups, ids, match_scores=scores).all()
    assert backed_by_views(box[:0], groups[:0], ids[:0], match_scores=scores[:0]).shape == (0,)


@pytest.mark.parametrize("seed", [0, 1])
def test_backing_agrees_with_a_loop(seed: int) -> None:
    boxes, scores = random_boxes(120, seed)
    generator = torch.Generator().manual_seed(seed)
    groups = torch.randint(2, (120, 2), generator=generator)
    ids = torch.randint(0, 10, (120,), generator=generator)
    ids[ids == 0] = -1
    stays = backed_by_views(boxes, groups, ids, match_scores=scores)
    assert stays.tolist() == backed_by_views_reference(boxes, groups, ids, scores, 0.3, 0.5)
    assert 10 < stays.sum() < 110
    again = backed_by_views(boxes[stays], groups[stays], ids[stays], match_scores=scores[stays])
    assert again.all()  # idempotent
