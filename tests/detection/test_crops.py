"""Where the plant is in every photo: boxes hold it, follow its laws, and crops give what whole photos give."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from matched import matched
from mvseg.detection.crops import crop_cameras, gain_of_crops, place_crops, plant_boxes
from mvseg.masks import Masks
from mvseg.regions import regions_from_label_maps
from mvseg.scene import Cameras
from mvseg.simulation.cameras import arc_cameras
from mvseg.simulation.growth import grow_plant

CENTERS = torch.tensor([[0.0, 0.0, 60.0], [40.0, 10.0, 90.0], [-20.0, -45.0, 40.0], [0.0, 50.0, 70.0]]).double()
RADIUS = 6.0  # mm


def ball_scene(num_views: int = 6, size: int = 400) -> tuple[Masks, Cameras]:
    """Four balls, as discs in every view, far away from the cameras."""
    cameras = arc_cameras(num_views, grow_plant("ovate", 4, 1), width=size, height=size)
    K = cameras.K.clone()
    K[:, :2, :2] *= 0.5
    cameras = replace(cameras, K=K)
    px, depth = cameras.project(CENTERS)
    rows, columns = np.mgrid[:size, :size] + 0.5
    maps = []
    for view in range(num_views):
        labels = np.zeros((size, size), np.int32)
        for number, (x, y) in enumerate(px[view].tolist(), start=1):
            radius = float(K[view, 0, 0] * RADIUS / depth[view, number - 1])
            labels[(columns - x) ** 2 + (rows - y) ** 2 < radius**2] = number
        maps.append(labels)
    return matched(regions_from_label_maps(maps)).masks, cameras


def test_boxes_hold_the_plant_and_little_else() -> None:
    masks, cameras = ball_scene()
    regions = masks.regions
    boxes = plant_boxes(masks, cameras)
    for view in range(len(cameras)):
        own = regions.boxes[regions.view_index == view]
        x1, y1, x2, y2 = boxes[view].tolist()
        assert x1 <= int(own[:, 0].min())
        assert y1 <= int(own[:, 1].min())
        assert x2 >= int(own[:, 2].max())
        assert y2 >= int(own[:, 3].max())
        longer = int((own[:, 2:].amax(0) - own[:, :2].amin(0)).max())
        assert max(x2 - x1, y2 - y1) <= 1.3 * longer + 4


def test_a_view_that_shows_nothing_has_the_box_of_the_others() -> None:
    masks, cameras = ball_scene()
    regions = masks.regions
    seen = regions.view_index != 2
    boxes = plant_boxes(masks.select(seen), cameras)
    expected = plant_boxes(masks, cameras)
    assert int((boxes - expected).abs().max()) <= 3


def test_doubtful_masks_do_not_widen_the_boxes() -> None:
    masks, cameras = ball_scene()
    regions = masks.regions
    without = regions.labels != 4
    expected = plant_boxes(masks.select(without), cameras)
    for ids, scores in ((4, 0.3), (-1, 0.0)):
        doubtful = replace(
            masks,
            instance_ids=masks.instance_ids.masked_fill(~without, ids),
            match_scores=masks.match_scores.masked_fill(~without, scores),
        )
        assert torch.equal(plant_boxes(doubtful, cameras), expected)
    few = without | (regions.view_index < 2)  # one instance in two views only
    assert torch.equal(plant_boxes(masks.select(few), cameras), expected)


def test_law_views_may_be_permuted_and_the_world_scaled() -> None:
    masks, cameras = ball_scene()
    regions = masks.regions
    boxes = plant_boxes(masks, cameras)
    assert torch.equal(plant_boxes(masks, cameras.scale(0.01)), boxes)
    order = torch.tensor([3, 0, 5, 1, 4, 2])
    place = order.argsort()
    permuted = replace(masks, regions=replace(regions, view_index=place[regions.view_index]))
    assert torch.equal(plant_boxes(permuted, cameras[order]), boxes[order])


def test_without_a_sure_instance_the_photo_is_whole() -> None:
    masks, cameras = ball_scene()
    doubtful = replace(masks, match_scores=torch.full_like(masks.match_scores, 0.2))
    whole = torch.tensor([[0, 0, 400, 400]] * len(cameras))
    assert torch.equal(plant_boxes(doubtful, cameras), whole)


def test_gain_does_not_count_pixels_that_are_not_there() -> None:
    boxes = torch.tensor([[100, 100, 500, 300], [0, 0, 200, 200], [0, 0, 1600, 1000], [0, 0, 100, 50]])
    sizes = torch.tensor([[1600, 1200], [400, 400], [1600, 1000], [1000, 1000]])
    assert gain_of_crops(boxes, sizes, 800).tolist() == pytest.approx([2.0, 1.0, 1.0, 1.25])


def test_what_is_found_in_crops_is_placed_where_it_is() -> None:
    masks, cameras = ball_scene()
    regions = masks.regions
    boxes = plant_boxes(masks, cameras)
    cropped = crop_cameras(cameras, boxes)
    px, _ = cameras.project(CENTERS)
    assert torch.allclose(cropped.project(CENTERS)[0], px - boxes[:, None, :2])
    maps = [regions.label_map(view, regions.labels, (400, 400)).numpy() for view in range(len(cameras))]
    cut = [labels[y1:y2, x1:x2] for labels, (x1, y1, x2, y2) in zip(maps, boxes.tolist(), strict=True)]
    placed = place_crops(Masks.of(regions_from_label_maps(cut)), boxes)
    assert torch.equal(placed.regions.boxes, regions.boxes)
    assert torch.equal(placed.regions.crops, regions.crops)
    ones = torch.cat((CENTERS, torch.ones(4, 1)), 1).numpy()
    seen = cameras.px_from_world.numpy() @ ones.T
    assert np.allclose(seen[:, :2] / seen[:, 2:], px.mT.numpy())
