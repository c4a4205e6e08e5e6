"""Which instance does a region proposal belong to (Eqs. 4, 5)?"""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from mvseg.detection.numbers import DETECTION
from mvseg.errors import InputError
from mvseg.matching.epipolar import binned_pairs, dilate, find_spans, span_histogram
from mvseg.matching.samples import Samples, view_runs, view_samples
from mvseg.regions import Regions
from mvseg.scene import Cameras


class EpipolarAssignment(nn.Module):
    """Assigns each proposal to the instance whose epipolar map it resembles most (Eq. 5). Has no parameters.

    Masks of more than 1024 pixels are thinned (see `Regions.thin`); those of Mask R-CNN carry no more detail than
    28 x 28.
    """

    @torch.no_grad()
    def forward(
        self, proposals: Regions, regions: Regions, instance_ids: Tensor, *, cameras: Cameras
    ) -> tuple[Tensor, Tensor]:
        """Assign the proposals of all views.

        Args:
            proposals: R masks in V views.
            regions: D regions of the previous iteration.
            instance_ids: (D,) int64, their ids in [1, K]; -1 = matched to nothing.

        Returns:
            (R,) int64 id of the instance with the largest similarity, -1 where every similarity is 0, and (R,) float32,
            that similarity.
        """
        similarity = ruzicka_similarity(
            proposals, regions, instance_ids, cameras=cameras, max_pixels=DETECTION.mask_pixels
        )
        if not similarity.shape[1]:
            zeros = torch.zeros(len(proposals), device=proposals.device)
            return torch.full_like(proposals.view_index, -1), zeros
        best, column = similarity.max(1)
        return torch.where(best > 0, column + 1, -1), best


def ruzicka_similarity(
    proposals: Regions,
    regions: Regions,
    instance_ids: Tensor,
    *,
    cameras: Cameras,
    max_pixels: float = math.inf,
) -> Tensor:
    """Ruzicka similarity of every proposal's mask with every instance's epipolar map in its view (Eqs. 4, 5).

    With a map M in [0, 1] and a mask A of 0 and 1, sum min(M, A) is the sum of M over the mask, and sum max = sum M +
    |A| - sum min: no map is ever drawn.

    Args:
        instance_ids: (D,) int64 in [1, K] or -1.
        max_pixels: thins the masks of the proposals.

    Returns:
        (R, K) float32 in [0, 1], the first column for id 1; 0 where an instance has no region in another view: those of
        the proposal's own view have no band there, and do not count in Eq. 4 (the paper does not say).

    Raises:
        InputError: the ids are not one per region.
    """
    if instance_ids.shape != regions.view_index.shape:
        raise InputError(f"{len(instance_ids)} instance ids for {len(regions)} regions, expected one per region")
    cameras = cameras.to(regions.device)
    num_clusters = max(int(instance_ids.max()), 0) if len(instance_ids) else 0
    clustered = regions.select(instance_ids > 0)
    cluster_of = instance_ids[instance_ids > 0] - 1
    # Pixels, not runs: what is added up over the few pixels of a thinned mask is too sensitive for those.
    sources, source_members = view_samples(clustered)
    targets, target_members = view_runs(proposals, max_pixels)
    targets = [each.pixels() for each in targets]
    images = [_image_lattice(size, regions.device) for size in cameras.sizes.tolist()]
    on_mask = torch.zeros(len(proposals), num_clusters, device=regions.device)  # sum of bands over the mask
    on_image = torch.zeros(len(cameras), num_clusters, device=regions.device)  # sum of bands over the image
    count = torch.zeros(len(cameras), num_clusters, device=regions.device)  # #_c of Eq. 4
    joint = [_concatenate(source, target) for source, target in zip(sources, targets, strict=True)]
    for pair in binned_pairs(joint, cameras):
        for source, target, side in ((pair.i, pair.j, 0), (pair.j, pair.i, 1)):
            clusters = cluster_of[source_members[source]]
            sent = pair.pixels[side][: len(clusters)]
            bands = torch.zeros(num_clusters, pair.bins.num_bins, device=regions.device)
            bands.index_add_(0, clusters, dilate(sent, pair.bins.band_radius(side)))
            count[target] += torch.bincount(clusters, minlength=num_clusters)
            received = pair.pixels[1 - side][sources[target].num_regions :]
            on_mask[target_members[target]] += received @ bands.T
            image = span_histogram(pair.bins, find_spans(pair.pencil, 1 - side, images[target]))
            on_image[target] += (image @ bands.T)[0]
    count = count.clamp(min=1)
    sum_min = on_mask / count[proposals.view_index]
    sum_max = (on_image / count)[proposals.view_index] + proposals.areas[:, None] - sum_min
    return sum_min / sum_max.clamp(min=1e-12)


def _concatenate(first: Samples, second: Samples) -> Samples:
    return Samples(
        xy=torch.cat((first.xy.T, second.xy.T), 1).T,
        owner=torch.cat((first.owner, second.owner + first.num_regions)),
        weight=torch.cat((first.weight, second.weight)),
        num_regions=first.num_regions + second.num_regions,
    )


def _image_lattice(size: list[int], device: torch.device) -> Samples:
    """All pixels of an image as one region, thinned to at most about `DETECTION.band_pixels` of them."""
    width, height = size
    crop = torch.ones(width * height, dtype=torch.bool, device=device)
    box = torch.tensor([[0, 0, width, height]], device=device)
    nothing = torch.zeros(1, dtype=torch.int64, device=device)
    image = Regions(view_index=nothing, boxes=box, crops=crop, num_views=1, labels=nothing)
    return view_runs(image, DETECTION.band_pixels)[0][0].pixels()
