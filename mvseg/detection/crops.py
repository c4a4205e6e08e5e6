"""Where the plant is in every photo, once its leaves are matched: a second pass sees it larger. Not in the paper."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from mvseg.detection.numbers import DETECTION
from mvseg.masks import SURE, Masks
from mvseg.reconstruction.triangulate import triangulate
from mvseg.scene import Cameras


def boxes_for_second_pass(masks: Masks, cameras: Cameras, *, longest: int) -> Tensor | None:
    """`plant_boxes`, if a detector that scales larger images down to a longer side of `longest` pixels sees the plant
    at least `DETECTION.least_gain` times as large in them, in most views; else None."""
    boxes = plant_boxes(masks, cameras)
    gain = gain_of_crops(boxes, cameras.sizes, longest)
    return boxes if float(gain.median()) >= DETECTION.least_gain else None


def plant_boxes(masks: Masks, cameras: Cameras) -> Tensor:
    """The box of the plant in each view: all instances that are surely matched, wherever they were found or not.

    An instance is a ball around the point that its masks' boxes are centred on. A view's box holds the balls, and the
    masks of these instances in that view.

    Returns:
        (V, 4) int64 xyxy, half-open, with a margin, inside the photos. The whole photo where no instance is sure.
    """
    width, height = cameras.sizes.T
    frames = torch.stack((torch.zeros_like(width), torch.zeros_like(width), width, height), 1)
    regions = masks.regions
    is_sure = (masks.instance_ids > 0) & (masks.match_scores >= SURE)
    points, radii, of_plant = [], [], torch.zeros_like(is_sure)
    for instance in masks.instance_ids[is_sure].unique().tolist():
        members = (is_sure & (masks.instance_ids == instance)).nonzero()[:, 0]
        views = regions.view_index[members]
        if len(views) < max(2, min(DETECTION.plant_views, len(cameras))):
            continue
        boxes = regions.boxes[members].double()
        in_view = cameras[views]
        point = triangulate(in_view.px_from_world.numpy(), ((boxes[:, :2] + boxes[:, 2:]) / 2).numpy())
        _, depth = in_view.project(torch.from_numpy(point)[None])
        of_plant[members] = True
        if not bool((depth > 0).all()):
            continue
        half = (boxes[:, 2:] - boxes[:, :2]).amax(1) / 2
        points.append(torch.from_numpy(point))
        radii.append((half * depth[:, 0] / in_view.K[:, 0, 0]).median())
    if not points:
        return frames
    px, depth = cameras.project(torch.stack(points))
    reach = (cameras.K[:, :1, 0] * torch.stack(radii) / depth)[..., None]
    is_ahead = (depth > 0)[..., None]
    low = torch.where(is_ahead, px - reach, torch.inf).amin(1)
    high = torch.where(is_ahead, px + reach, -torch.inf).amax(1)
    for view in range(len(cameras)):
        own = regions.boxes[of_plant & (regions.view_index == view)].double()
        low[view] = torch.cat((low[view][None], own[:, :2])).amin(0)
        high[view] = torch.cat((high[view][None], own[:, 2:])).amax(0)
    margin = DETECTION.plant_margin * (high - low).amax(1, keepdim=True)
    low, high = (low - margin).floor().clamp(min=0), torch.minimum((high + margin).ceil(), cameras.sizes.double())
    is_seen = ((high - low) >= 1).all(1, keepdim=True)  # else the plant is outside the photo
    return torch.where(is_seen, torch.cat((low, high), 1).nan_to_num(0, 0, 0), frames).long()


def gain_of_crops(boxes: Tensor, sizes: Tensor, longest: int) -> Tensor:
    """(V,) float64, how many times larger a detector sees crops (V, 4) xyxy than whole photos (V, 2), if it only scales
    larger images down, to a longer side of `longest` pixels."""
    crops = (boxes[:, 2:] - boxes[:, :2]).amax(1)
    of_crop, of_photo = (longest / side.double().clamp(min=longest) for side in (crops, sizes.amax(1)))
    return of_crop / of_photo


def crop_cameras(cameras: Cameras, boxes: Tensor) -> Cameras:
    """The cameras of photos that were cut to (V, 4) int64 boxes, xyxy."""
    K = cameras.K.clone()
    K[:, :2, 2] -= boxes[:, :2]
    return replace(cameras, K=K, sizes=boxes[:, 2:] - boxes[:, :2])


def place_crops(masks: Masks, boxes: Tensor) -> Masks:
    """Place masks of crops (V, 4) int64 xyxy in the frames of the photos."""
    offset = boxes[masks.view_index, :2].repeat(1, 2)
    return replace(masks, regions=replace(masks.regions, boxes=masks.regions.boxes + offset))
