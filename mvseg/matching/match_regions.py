"""Stage 5g: region matching in one call: masks and cameras in, instance ids out."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from mvseg.config import MatchConfig
from mvseg.errors import InputError, InputWarning
from mvseg.matching.affinity import Affinity, region_affinity
from mvseg.matching.epipolar import is_coincident
from mvseg.matching.nview.match_nview import match_nview
from mvseg.matching.one_per_view import one_per_view_clusters
from mvseg.matching.symnmf import cluster_affinity
from mvseg.regions import Regions, mask_box, stack_regions
from mvseg.scene import Cameras


@dataclass(frozen=True, eq=False)
class Matching:
    """Which region shows which instance.

    Attributes:
        instance_ids: (D,) int64; regions of one instance share a number in [0, K); -1 = matched to nothing.
        match_scores: (D,) float32 in [0, 1]. Where "nview" was asked for: the chance that the id is right, as fitted on
            simulated plants. Else the mean affinity (Eq. 3) of a region to the members of its cluster in other views.
            0 for a region matched to nothing or alone in its cluster.
        num_instances: K.
        method: what matched: "nview", "one-per-view" (also what nview falls back to when the views do not agree on
            anything, or are two) or "symnmf".
        support: (K,) int64, in how many views each instance has a region whose match score is at least 0.5; None where
            the match scores are no chances.
        merged: (M, 3) int64, masks that seem to cover two instances: region, its instance, the other instance. Nothing
            is changed in the masks (`split_merged` does so). Only "nview" looks for them.
        residual_px: about how far, in pixels, the reprojections of matched regions are off; None where not estimated.
        merged_parts: M (h, w) bool tensors on the CPU, where in the region's box such a mask shows the other instance.
    """

    instance_ids: Tensor
    match_scores: Tensor
    num_instances: int
    method: str
    support: Tensor | None = None
    merged: Tensor = field(default_factory=lambda: torch.zeros(0, 3, dtype=torch.int64))
    residual_px: int | None = None
    merged_parts: tuple[Tensor, ...] = ()


def match_regions(
    regions: Regions, cameras: Cameras, config: MatchConfig | None = None, *, progress: bool = False
) -> Matching:
    """Give every region an instance id by epipolar region matching (Sec. 3.1).

    The weights are the paper's; the clustering is the paper's with `method` "symnmf", and a stronger one by default
    (see `MatchConfig.method`), which also leaves regions unmatched (-1) that belong to nothing.

    Args:
        regions: D regions in V views.
        cameras: V >= 2 cameras.
        config: how; None for the defaults of `MatchConfig`.
        progress: show progress bars.

    Returns:
        The matching, on the device of the regions. Without regions it is empty. Warns (InputWarning) of pairs of views
        at one place, which are skipped, of a scene without regions, and of one whose views agree on little.

    Raises:
        InputError: fewer than two views, regions and cameras of different numbers of views, or a region that is not
            inside the image of its camera.
    """
    config = config or MatchConfig()
    if len(cameras) != regions.num_views:
        raise InputError(f"regions of {regions.num_views} views with {len(cameras)} cameras, expected as many of each")
    if len(cameras) < 2:
        raise InputError("matching needs at least two views, got a single one")
    cameras = cameras.to(regions.device)
    _check_sizes(regions, cameras)
    _warn_of_gaps(regions, cameras)
    affinity = region_affinity(regions, cameras, num_points=config.num_points, seed=config.seed, progress=progress)
    method = choose_method(config)
    if method == "nview":
        found = match_nview(regions, cameras, affinity)
        if found.method != "nview" and len(cameras) > 2 and len(regions):
            message = (
                f"the views agree on little (rays explain {found.explained:.0%} of the masks; 'one-per-view' matched "
                "them): do R and t take world points to the camera, and are the masks those of their photos?"
            )
            warnings.warn(message, InputWarning, stacklevel=2)
        return Matching(
            found.instance_ids,
            found.match_scores,
            len(found.support),
            found.method,
            found.support,
            found.merged,
            found.residual_px,
            found.merged_parts,
        )
    if method == "one-per-view":
        ids = one_per_view_clusters(affinity, regions.view_index, len(cameras))
        scores = mean_affinity(affinity, ids, regions)
    else:
        ids = cluster_affinity(
            affinity,
            regions.num_per_view,
            num_instances=config.num_instances,
            search_range=config.search_range,
            num_restarts=config.num_restarts,
            seed=config.seed,
            progress=progress,
        ).instance_ids
        scores = mean_affinity(affinity, ids, regions)
    merged = torch.zeros(0, 3, dtype=torch.int64, device=ids.device)
    return Matching(ids, scores, int(ids.max()) + 1 if len(ids) else 0, method, merged=merged)


def split_merged(regions: Regions, matching: Matching) -> tuple[Regions, Matching, Tensor]:
    """Cut the masks that cover two instances in two, each part with its own instance.

    Args:
        regions: the D regions that were matched.
        matching: their matching.

    Returns:
        D' >= D regions in the same order, the second part after the first. Their matching, with the match scores of
        the masks, the support of before, and nothing merged. And (D',) int64, the region that each comes from. A mask
        of which one part would be empty stays whole.
    """
    cuts = {row[0]: (row[2], part) for row, part in zip(matching.merged.tolist(), matching.merged_parts, strict=True)}
    source, boxes, crops, ids = [], [], [], []
    for region, (own, box) in enumerate(zip(matching.instance_ids.tolist(), regions.boxes.tolist(), strict=True)):
        mask = regions.crop(region)
        other, part = cuts.get(region, (-1, torch.zeros_like(mask)))
        part = part.to(mask.device) & mask
        halves = [(own, mask & ~part), (other, part)]
        if not all(bool(half.any()) for _, half in halves):
            halves = [(own, mask)]
        for instance, half in halves:
            x1, y1, x2, y2 = mask_box(half) if len(halves) > 1 else (0, 0, mask.shape[1], mask.shape[0])
            source.append(region)
            boxes.append((box[0] + x1, box[1] + y1, box[0] + x2, box[1] + y2))
            crops.append(half[y1:y2, x1:x2].flatten().cpu())
            ids.append(instance)
    index = torch.tensor(source, dtype=torch.int64, device=regions.device)
    views, labels = regions.view_index[index].tolist(), regions.labels[index].tolist()
    matched = replace(
        matching,
        instance_ids=torch.tensor(ids, dtype=torch.int64, device=regions.device),
        match_scores=matching.match_scores[index],
        merged=matching.merged[:0],
        merged_parts=(),
    )
    return stack_regions(views, boxes, crops, labels, regions.num_views).to(regions.device), matched, index


def choose_method(config: MatchConfig) -> str:
    """What "auto" stands for: "symnmf" when the number of instances or a range for it is given, else "nview"."""
    if config.method != "auto":
        return config.method
    return "symnmf" if config.num_instances or config.search_range else "nview"


def mean_affinity(affinity: Affinity, instance_ids: Tensor, regions: Regions) -> Tensor:
    """(D,) float32: mean affinity of each region to the members of its cluster in other views; 0 where it has none."""
    same = (instance_ids[:, None] == instance_ids) & (instance_ids >= 0)
    partners = same & (regions.view_index[:, None] != regions.view_index)
    return (affinity.to_dense() * partners).sum(1) / partners.sum(1).clamp(min=1)


def _check_sizes(regions: Regions, cameras: Cameras) -> None:
    sizes = cameras.sizes[regions.view_index]
    outside = ((regions.boxes[:, :2] < 0) | (regions.boxes[:, 2:] > sizes)).any(1).nonzero()[:, 0]
    if len(outside):
        region = int(outside[0])
        view, box = int(regions.view_index[region]), regions.boxes[region].tolist()
        width, height = cameras.sizes[view].tolist()
        raise InputError(
            f"region {region} of view {view} has the box {box}, expected one inside the {width} x {height} pixels of "
            "its camera: are the masks of another size than the photos?"
        )


def _warn_of_gaps(regions: Regions, cameras: Cameras) -> None:
    if not len(regions):
        warnings.warn("the masks of all views are empty: there is no instance", InputWarning, stacklevel=3)
    for i, j in torch.triu(is_coincident(cameras), diagonal=1).nonzero().tolist():
        message = f"views {i} and {j} were taken from one place: this pair is skipped"
        warnings.warn(message, InputWarning, stacklevel=3)
