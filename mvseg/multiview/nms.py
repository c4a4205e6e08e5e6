"""Stage 6: which cluster does a region proposal belong to (Eqs. 4, 5), and NMS that respects the answer (Sec. 3.2)."""

from __future__ import annotations

import torch
import torchvision
from torch import Tensor, nn

from mvseg.errors import InputError
from mvseg.matching.epipolar import Samples, bin_histogram, binned_pairs, dilate, view_samples
from mvseg.regions import Regions
from mvseg.scene import Cameras

LATTICE = 65_536  # at most about this many pixels of an image measure the area of a band


class EpipolarAssignment(nn.Module):
    """Assigns each proposal to the cluster whose epipolar map it resembles most (Eq. 5). Has no parameters.

    Args:
        max_pixels: masks of more pixels are thinned to a lattice of about this many (see `Regions.pixels`); the masks
            of Mask R-CNN carry no more detail than 28 x 28.
    """

    def __init__(self, max_pixels: int = 1024) -> None:
        super().__init__()
        self.max_pixels = max_pixels

    @torch.no_grad()
    def forward(
        self, proposals: Regions, regions: Regions, instance_ids: Tensor, cameras: Cameras
    ) -> tuple[Tensor, Tensor]:
        """Assign the proposals of all views.

        Args:
            proposals: R masks in V views.
            regions: D regions of the previous iteration.
            instance_ids: (D,) int64, their clusters in [0, K); -1 = none.
            cameras: V cameras.

        Returns:
            (R,) int64 cluster with the largest similarity, -1 where every similarity is 0, and (R,) float32, that
            similarity.
        """
        similarity = ruzicka_similarity(proposals, regions, instance_ids, cameras, max_pixels=self.max_pixels)
        if not similarity.shape[1]:
            nothing = torch.zeros(len(proposals), device=proposals.device)
            return torch.full_like(proposals.view_index, -1), nothing
        best, cluster = similarity.max(1)
        return torch.where(best > 0, cluster, -1), best


def ruzicka_similarity(
    proposals: Regions, regions: Regions, instance_ids: Tensor, cameras: Cameras, *, max_pixels: int | None = None
) -> Tensor:
    """Ruzicka similarity of every proposal's mask with every cluster's epipolar map in its view (Eqs. 4, 5).

    With a map M in [0, 1] and a mask A of 0 and 1, sum min(M, A) is the sum of M over the mask, and
    sum max = sum M + |A| - sum min: no map is ever drawn.

    Args:
        proposals: R masks in V views.
        regions: D regions.
        instance_ids: (D,) int64 in [0, K) or -1.
        cameras: V cameras.
        max_pixels: thins the masks of the proposals; None takes all pixels.

    Returns:
        (R, K) float32 in [0, 1]; 0 where a cluster has no member in another view: its own view's members have no band
        there, and do not count in Eq. 4 (the paper does not say).
    """
    if instance_ids.shape != regions.view_index.shape:
        raise InputError(f"{len(instance_ids)} instance ids for {len(regions)} regions, expected as many")
    cameras = cameras.to(regions.device)
    num_clusters = int(instance_ids.max()) + 1 if len(instance_ids) else 0
    clustered = regions.select(instance_ids >= 0)
    cluster_of = instance_ids[instance_ids >= 0]
    sources, source_members = view_samples(clustered)
    targets, target_members = view_samples(proposals, max_pixels)
    images = [_image_lattice(size, regions.device) for size in cameras.sizes.tolist()]
    on_mask = torch.zeros(len(proposals), num_clusters, device=regions.device)  # sum of bands over the mask
    on_image = torch.zeros(len(cameras), num_clusters, device=regions.device)  # sum of bands over the image
    count = torch.zeros(len(cameras), num_clusters, device=regions.device)  # #_c of Eq. 4
    joint = [_concatenate(source, target) for source, target in zip(sources, targets, strict=True)]
    for pair in binned_pairs(joint, cameras):
        for source, target, side in ((pair.i, pair.j, 0), (pair.j, pair.i, 1)):
            clusters = cluster_of[source_members[source]]
            sent = pair.counts[side][: len(clusters)] > 0
            bands = torch.zeros(num_clusters, pair.bins.num_bins, device=regions.device)
            bands.index_add_(0, clusters, dilate(sent, pair.bins.band_radius(side)))
            count[target] += torch.bincount(clusters, minlength=num_clusters)
            received = pair.counts[1 - side][sources[target].num_regions :]
            on_mask[target_members[target]] += received @ bands.T
            image = bin_histogram(pair.bins, pair.pencil.angles(1 - side, images[target].xy), images[target])
            on_image[target] += (image @ bands.T)[0]
    count = count.clamp(min=1)
    smallest = on_mask / count[proposals.view_index]
    largest = (on_image / count)[proposals.view_index] + proposals.areas[:, None] - smallest
    return smallest / largest.clamp(min=1e-12)


def _concatenate(first: Samples, second: Samples) -> Samples:
    """The regions of both sets, first and then second, in one."""
    return Samples(
        torch.cat((first.xy, second.xy)),
        torch.cat((first.owner, second.owner + first.num_regions)),
        torch.cat((first.weight, second.weight)),
        first.num_regions + second.num_regions,
    )


def _image_lattice(size: list[int], device: torch.device) -> Samples:
    """All pixels of an image as one region, thinned to at most about LATTICE of them."""
    width, height = size
    step = max(1, round((width * height / LATTICE) ** 0.5))
    x = torch.arange(step // 2, width, step, device=device) + 0.5
    y = torch.arange(step // 2, height, step, device=device) + 0.5
    xy = torch.cartesian_prod(x, y)
    weight = torch.full((len(xy),), width * height / len(xy), device=device)
    return Samples(xy, torch.zeros(len(xy), dtype=torch.int64, device=device), weight, 1)


def cluster_aware_nms(boxes: Tensor, scores: Tensor, groups: Tensor, iou_threshold: float = 0.3) -> Tensor:
    """Non-maximum suppression in which boxes of different groups never suppress each other.

    Args:
        boxes: (R, 4) xyxy.
        scores: (R,).
        groups: (R, G) or (R,) integers; two boxes are of one group when all G numbers agree (view, class and cluster).
        iou_threshold: a box goes when its IoU with a better one of its group exceeds this (the paper: 0.3).

    Returns:
        (S,) int64 indices of the boxes kept, best score first. The same as `torchvision.ops.nms` group by group.

    Raises:
        InputError: R differs between the arguments.
    """
    if not len(boxes) == len(scores) == len(groups):
        raise InputError(f"{len(boxes)} boxes with {len(scores)} scores and {len(groups)} groups")
    if not len(boxes):
        return torch.zeros(0, dtype=torch.int64, device=boxes.device)
    _, group = groups.reshape(len(groups), -1).unique(dim=0, return_inverse=True)
    # batched_nms moves the groups apart by adding to the coordinates: in float32 a thousand groups blur the boxes.
    return torchvision.ops.batched_nms(boxes.double(), scores.double(), group, iou_threshold)


def confirmed(
    boxes: Tensor,
    groups: Tensor,
    instance_ids: Tensor,
    match_scores: Tensor,
    *,
    iou_threshold: float = 0.3,
    min_score: float = 0.5,
) -> Tensor:
    """Which boxes stay: those that no better one overlaps, and those that the other views are sure to be another thing.

    Cluster-aware NMS keeps a duplicate as well as a half-hidden leaf when it takes another cluster than the better box.
    Only the half-hidden leaf finds its match in the other views. Not in the paper.

    Args:
        boxes: (S, 4) xyxy, best score first.
        groups: (S, G) integers; only boxes of one group are compared (view and class).
        instance_ids: (S,) int64, -1 = matched to nothing.
        match_scores: (S,) chances that the ids are right.
        iou_threshold: an IoU above this is an overlap.
        min_score: least match score of a box that overlaps a better one; its id must also differ from that one's.

    Returns:
        (S,) bool. A box that goes does not count as a better one for the rest.
    """
    if not len(boxes):
        return torch.ones(0, dtype=torch.bool, device=boxes.device)
    _, group = groups.unique(dim=0, return_inverse=True)
    overlaps = (torchvision.ops.box_iou(boxes, boxes) > iou_threshold) & (group[:, None] == group)
    other = (instance_ids[:, None] != instance_ids) & ((instance_ids >= 0) & (match_scores >= min_score))[:, None]
    refuses = (overlaps & ~other).tril(-1)
    stays = torch.ones(len(boxes), dtype=torch.bool, device=boxes.device)
    for box in refuses.any(1).nonzero()[:, 0].tolist():
        stays[box] = not bool((refuses[box] & stays).any())
    return stays
