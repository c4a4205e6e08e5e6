"""Region matching in one call: masks and cameras in, instance ids out."""

from __future__ import annotations

import warnings

import torch
from torch import Tensor

from mvseg.errors import InputError, InputWarning
from mvseg.matching.affinity import Affinity, region_affinity
from mvseg.matching.config import MatchConfig
from mvseg.matching.epipolar import is_coincident
from mvseg.matching.nview.match_nview import WIDENINGS, match_nview
from mvseg.matching.one_per_view import one_per_view_clusters
from mvseg.matching.result import Matching
from mvseg.matching.symnmf import cluster_affinity
from mvseg.regions import Regions
from mvseg.scene import Cameras

AGREEING = 0.45  # mean score from which the views agree: the least of 24 sound development scenes was 0.52


def match_regions(
    regions: Regions, cameras: Cameras, config: MatchConfig = MatchConfig(), *, progress: bool = False
) -> Matching:
    """Give every region an instance id by epipolar region matching (Sec. 3.1).

    The weights are the paper's; the clustering is the paper's with `method` "symnmf", and a more accurate one by
    default (see `MatchConfig.method`), which also leaves regions that fit no instance unmatched (-1).

    Args:
        regions: D regions in V views.
        cameras: V >= 2 cameras.
        config: method and options.
        progress: show progress bars.

    Returns:
        The matching, on the device of the regions; empty without regions. Warns (InputWarning) about pairs of views
        that share a camera centre (they are skipped), a scene without regions, and views that do not agree.

    Raises:
        InputError: fewer than two views, regions and cameras of different numbers of views, cameras that are all at
            one place, or a region that reaches beyond the image of its camera.
    """
    cameras = cameras.to(regions.device)
    check_views(regions, cameras)
    check_baselines(cameras)
    _check_sizes(regions, cameras)
    _warn_of_gaps(regions, cameras)
    affinity = region_affinity(regions, cameras, num_points=config.num_points, seed=config.seed, progress=progress)
    method = config.resolved_method
    if method == "nview":
        matching = match_nview(regions, cameras, affinity, progress=progress)
        if len(cameras) > 2 and len(regions):
            _warn_of_disagreement(matching, regions)
        return matching
    if method == "one-per-view":
        ids = one_per_view_clusters(affinity, regions.view_index, len(cameras))
        return matching_of_ids(ids, regions, affinity, method=method)
    return match_graph(affinity, regions, config, method=method, progress=progress)


def match_graph(
    graph: Affinity, regions: Regions, config: MatchConfig, *, method: str, progress: bool = False
) -> Matching:
    """Cluster any graph of the regions with SymNMF, |k| by Eq. 7.

    Args:
        graph: of D regions.
        regions: whose numbers per view set the default range for the number of instances.
        config: num_instances, search_range, num_restarts and seed are used; the rest concerns the epipolar weights.
        method: the `Matching.method` of the result.
        progress: show a progress bar.
    """
    clustering = cluster_affinity(
        graph,
        regions.num_per_view,
        num_instances=config.num_instances,
        search_range=config.search_range,
        num_restarts=config.num_restarts,
        seed=config.seed,
        progress=progress,
    )
    return matching_of_ids(clustering.instance_ids, regions, graph, method=method)


def matching_of_ids(instance_ids: Tensor, regions: Regions, graph: Affinity, *, method: str) -> Matching:
    """The matching for ids in [1, K] or -1 from a graph; the scores are mean weights within clusters."""
    return Matching(
        instance_ids=instance_ids,
        match_scores=mean_affinity(graph, instance_ids, regions),
        num_instances=max(int(instance_ids.max()), 0) if len(instance_ids) else 0,
        method=method,
    )


def mean_affinity(affinity: Affinity, instance_ids: Tensor, regions: Regions) -> Tensor:
    """(D,) float32: mean affinity of each region to the members of its cluster in other views; 0 where it has none."""
    is_same = (instance_ids[:, None] == instance_ids) & (instance_ids > 0)
    is_partner = is_same & (regions.view_index[:, None] != regions.view_index)
    return (affinity.to_dense() * is_partner).sum(1) / is_partner.sum(1).clamp(min=1)


def check_views(regions: Regions, cameras: Cameras) -> None:
    """Raises InputError: fewer than two views, or regions and cameras of different numbers of views."""
    if len(cameras) != regions.num_views:
        raise InputError(f"regions of {regions.num_views} views with {len(cameras)} cameras, expected equal numbers")
    if len(cameras) < 2:
        raise InputError("matching needs at least two views, got a single view")


def check_baselines(cameras: Cameras) -> None:
    """Raises InputError: the cameras are all at one place, where depth cannot be seen."""
    if len(cameras) > 1 and bool(is_coincident(cameras).all()):
        raise InputError(
            f"all {len(cameras)} cameras are at one place, expected photos from different places: do R and t map world "
            "points to the camera?"
        )


def _check_sizes(regions: Regions, cameras: Cameras) -> None:
    sizes = cameras.sizes[regions.view_index]
    outside = ((regions.boxes[:, :2] < 0) | (regions.boxes[:, 2:] > sizes)).any(1).nonzero()[:, 0]
    if len(outside):
        region = int(outside[0])
        view, box = int(regions.view_index[region]), regions.boxes[region].tolist()
        width, height = cameras.sizes[view].tolist()
        raise InputError(
            f"region {region} of view {view} has the box {box}, expected one inside the {width} x {height} pixels of "
            "its camera: are the masks and the photos of different sizes?"
        )


def _warn_of_gaps(regions: Regions, cameras: Cameras) -> None:
    if not len(regions):
        warnings.warn("the masks of all views are empty: there are no instances", InputWarning, stacklevel=3)
    pairs = torch.triu(is_coincident(cameras), diagonal=1).nonzero().tolist()
    if pairs:
        first = "views {} and {} share a camera centre".format(*pairs[0])
        skipped = "this pair is skipped" if len(pairs) == 1 else f"so do {len(pairs) - 1} more pairs; all are skipped"
        warnings.warn(f"{first}: {skipped}", InputWarning, stacklevel=3)


def _warn_of_disagreement(matching: Matching, regions: Regions) -> None:
    """Sound poses never did so on 24 development scenes, with true and with degraded masks. Cameras of the next photo
    did so in 9 of 12, cameras of the next but one in 3 of 12: the others agree well enough to pass. The residual alone
    does not tell: it is large where many masks are missing, too."""
    assert matching.explained is not None
    assert matching.residual_px is not None
    if matching.method == "nview" and matching.explained >= AGREEING:
        return
    facts = f"rays explain {matching.explained:.0%} of the masks"
    if matching.residual_px == WIDENINGS[-1]:
        facts += f" at a reprojection error of {matching.residual_px} pixels or more"
    if matching.method != "nview":
        facts += f"; '{matching.method}' matched them"
    question = "do R and t map world points to the camera, and does each mask belong to its photo?"
    richest, sparse = int(regions.num_per_view.max()), regions.num_per_view <= regions.num_per_view.max() / 2
    if int(sparse.sum()) > len(sparse) / 2:  # then rays find nothing whatever the poses are
        view = int(regions.num_per_view.argmax())
        counts = f"{int(sparse.sum())} of {len(sparse)} views have at most half of the {richest} masks of view {view}"
        question = f"{counts}: are masks missing there?"
    warnings.warn(f"the views hardly agree ({facts}), and ids may be wrong: {question}", InputWarning, stacklevel=3)
