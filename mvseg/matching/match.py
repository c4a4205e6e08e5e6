"""Region matching in one call: masks and cameras in, instance ids out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from types import MappingProxyType

import torch
from torch import Tensor

from mvseg.errors import InputError, check_arguments, warn
from mvseg.findings.finding import Finding, list_some
from mvseg.masks import Masks
from mvseg.matching.affinity import Affinity, region_affinity
from mvseg.matching.config import MatchConfig
from mvseg.matching.links import NO_LINKS, Links
from mvseg.matching.numbers import NVIEW
from mvseg.matching.nview.match_nview import match_nview
from mvseg.matching.one_per_view import one_per_view_clusters
from mvseg.matching.partition import Clusters
from mvseg.matching.pencil import is_coincident
from mvseg.matching.result import Matching, MatchReport
from mvseg.matching.symnmf import cluster_weights
from mvseg.matching.view_graph import ViewGraph, first_without_links
from mvseg.regions import Regions
from mvseg.scene import Cameras
from mvseg.system.threads import on_one_thread

MATCHED = "instance_ids", "match_scores"  # columns of `Masks` that matching fills


@check_arguments
def match_regions(
    regions: Regions,
    cameras: Cameras,
    config: MatchConfig = MatchConfig(),
    *,
    residual_px: int | None = None,
    links: Links | None = None,
) -> Matching:
    """Give every region an instance id by epipolar region matching (Sec. 3.1).

    The weights are the paper's; the clustering is the paper's with `method` "symnmf", and a more accurate one by
    default (see `MatchConfig.method`), which also leaves regions that fit no instance unmatched (-1).

    Args:
        residual_px: the reprojection error, one of 1, 2, 4 and 8 pixels, where an earlier matching of these views has
            found it (`MatchReport.residual_px`); None: it is estimated. Only "nview" makes use of it.
        links: regions that show one instance, or different ones; these ids hold, and links that the views agree with
            change nothing.

    Returns:
        The matching, on the device of the regions; empty without regions. Warns (InputWarning) about pairs of views
        that share a camera centre (they are skipped), a scene without regions, and views that do not agree.

    Raises:
        InputError: fewer than two views, regions and cameras of different numbers of views, cameras that are all at
            one place, a region that reaches beyond the image of its camera, another `residual_px`, or links that
            contradict each other.
    """
    matching = _match(regions, cameras, config, residual_px=residual_px, links=NO_LINKS if links is None else links)
    if (disagreement := find_disagreement(matching)) is not None:
        warn(disagreement)
    return matching


@on_one_thread()
def _match(
    regions: Regions, cameras: Cameras, config: MatchConfig, *, residual_px: int | None, links: Links
) -> Matching:
    links.components(len(regions))  # raises where links contradict each other, before anything takes time
    if residual_px is not None and residual_px not in NVIEW.dilations:
        raise InputError(f"residual_px is {residual_px}, expected one of {', '.join(map(str, NVIEW.dilations))}")
    cameras = cameras.to(regions.device)
    check_views(regions, cameras)
    check_baselines(cameras)
    _check_sizes(regions, cameras)
    _warn_of_gaps(regions, cameras)
    affinity = region_affinity(regions, cameras, num_points=config.num_points, seed=config.seed)
    graph = ViewGraph.of(affinity, regions, links)
    if config.resolved_method == "nview":
        return match_nview(regions, cameras, graph, residual_px=residual_px)
    if config.resolved_method == "one-per-view":
        clusters = first_without_links(graph, lambda graph, _: one_per_view_clusters(graph)).drop_singletons()
    else:
        clusters = first_without_links(graph, partial(_factorise, regions, config=config))
    return matching_of_ids(clusters.instance_ids().to(regions.device), regions, affinity, method=config.resolved_method)


def match_masks(
    masks: Masks,
    cameras: Cameras,
    config: MatchConfig = MatchConfig(),
    *,
    links: Links = NO_LINKS,
    num_instances: Mapping[int, int] = MappingProxyType({}),
    residual_px: int | None = None,
) -> Matching:
    """Match the masks of a table, class by class; other columns than `MATCHED` stay.

    Args:
        links: of their rows; those between masks of different classes have no effect.
        num_instances: {class: number of instances}, where an earlier matching has found it; "symnmf" only.

    Returns:
        The matching; instances of different classes have different ids. Its method is that of the config where it is
        not the same for all classes. Warns as `match_regions` does, but leaves `find_disagreement` to the caller.
    """
    parts, rows = [], []
    for label in masks.classes.unique().tolist() or [1]:
        rows.append((masks.classes == label).nonzero()[:, 0])
        options = replace(config, num_instances=num_instances.get(label) or config.num_instances)
        regions, of_class = masks.regions.select(rows[-1]), links.select(rows[-1])
        parts.append(_match(regions, cameras, options, residual_px=residual_px, links=of_class))
    joined = Masks.concatenate([part.masks for part in parts]).select(torch.cat(rows).argsort())
    filled = replace(masks, **{name: getattr(joined, name) for name in MATCHED})
    report = MatchReport.join([part.report for part in parts], [int((part.instance_ids > 0).sum()) for part in parts])
    if any(part.report.method != report.method for part in parts):
        report = replace(report, method=config.resolved_method)
    return Matching(filled, report)


def _factorise(regions: Regions, graph: ViewGraph, _: Clusters | None, *, config: MatchConfig) -> Clusters:
    weights = torch.from_numpy(graph.contract()).float().to(regions.device)
    clustering = cluster_weights(weights, regions.num_per_view, config)
    return graph.part(Clusters.of(clustering.instance_ids.cpu().numpy()[graph.node]))


def matching_of_ids(instance_ids: Tensor, regions: Regions, graph: Affinity, *, method: str) -> Matching:
    """The matching for ids in [1, K] or -1 from a graph; the score of a region is its mean affinity to the members of
    its cluster in other views, 0 where it has none."""
    is_same = (instance_ids[:, None] == instance_ids) & (instance_ids > 0)
    is_partner = is_same & (regions.view_index[:, None] != regions.view_index)
    scores = (graph.to_dense() * is_partner).sum(1) / is_partner.sum(1).clamp(min=1)
    return Matching(Masks.of(regions, instance_ids, scores), MatchReport(method=method))


def check_views(regions: Regions, cameras: Cameras) -> None:
    """Raises InputError: fewer than two views, or regions and cameras of different numbers of views."""
    if len(cameras) != regions.num_views:
        raise InputError(f"regions of {regions.num_views} views with {len(cameras)} cameras, expected equal numbers")
    if len(cameras) < 2:
        raise InputError("matching needs at least two views, got a single view")


def check_baselines(cameras: Cameras) -> None:
    """Raises InputError: the cameras are all at one place, where depth cannot be seen."""
    if len(cameras) > 1 and bool(is_coincident(cameras).all()):
        expected = "expected photos from different places: do R and t map world points to the camera?"
        raise InputError(f"all {len(cameras)} cameras are at one place, {expected}")


def _check_sizes(regions: Regions, cameras: Cameras) -> None:
    sizes = cameras.sizes[regions.view_index]
    outside = ((regions.boxes[:, :2] < 0) | (regions.boxes[:, 2:] > sizes)).any(1).nonzero()[:, 0]
    if len(outside):
        region = int(outside[0])
        view, box = int(regions.view_index[region]), regions.boxes[region].tolist()
        width, height = cameras.sizes[view].tolist()
        inside = f"one inside the {width} x {height} pixels of its camera"
        mend = "are the masks and the photos of different sizes?"
        raise InputError(f"region {region} of view {view} has the box {box}, expected {inside}: {mend}")


def _warn_of_gaps(regions: Regions, cameras: Cameras) -> None:
    if not len(regions):
        warn(Finding("no_masks"))
    elif bool((2 * regions.boxes[:, 2:] <= cameras.sizes[regions.view_index]).all()):
        warn(Finding("masks_of_half_size"))
    if pairs := torch.triu(is_coincident(cameras), diagonal=1).nonzero().tolist():
        warn(Finding("centres_shared", "views {} and {}".format(*pairs[0]), {"count": len(pairs)}))


def find_disagreement(matching: Matching, names: Sequence[str] = (), *, is_detected: bool = False) -> Finding | None:
    """The finding where the views disagree about the masks; None elsewhere, and with fewer than three views.

    Views disagree where ids are likely to be wrong, where no reprojection error that is tried is large enough, or where
    some views explain far less than the others (`benchmarks/confidence.py` counts how often something is wrong then).

    Args:
        matching: of "nview"; there is no finding for other methods.
        names: of the views; (): their indices.
        is_detected: a detector found the masks in these photos: the user has none to add or to mend.
    """
    report, regions, is_matched = matching.report, matching.masks.regions, matching.instance_ids > 0
    if report.explained is None or report.view_explained is None or regions.num_views < 3 or not len(regions):
        return None
    share = float(matching.match_scores[is_matched].mean()) if is_matched.any() else 0.0
    is_capped, odd = report.residual_px == NVIEW.dilations[-1], odd_views(report.view_explained)
    if share >= NVIEW.trusted and not is_capped and not odd:
        return None
    called = tuple(names) or tuple(f"view {view}" for view in range(regions.num_views))
    odd_ones = list_some([called[view] for view in odd])
    if is_detected and share < NVIEW.trusted:
        return Finding("detector_unsure", values={"share": share})
    if is_detected and odd:
        return Finding("views_odd_detected", odd_ones, views=tuple(odd))
    num_per_view = regions.num_per_view
    most, sparse = int(num_per_view.max()), num_per_view <= num_per_view.max() / 2
    if int(sparse.sum()) > len(sparse) / 2 and not is_detected:  # then rays find nothing whatever the poses are
        counts = {"count": int(sparse.sum()), "total": len(sparse), "most": most, "share": share}
        return Finding("views_sparse", called[int(num_per_view.argmax())], counts)
    if few := [view for view in odd if num_per_view[view] <= num_per_view.median() / 2]:
        counts = {"count": int(num_per_view[few[0]]), "usual": int(num_per_view.median()), "share": share}
        return Finding("view_sparse", called[few[0]], counts, (few[0],))
    others = is_matched & ~torch.isin(regions.view_index, torch.tensor(odd).to(regions.view_index))
    if odd and others.any() and float(matching.match_scores[others].mean()) >= NVIEW.trusted:  # they agree
        return Finding("views_odd", odd_ones, {"share": share}, tuple(odd))
    if share >= NVIEW.trusted:
        return Finding("rough_masks", values={"px": NVIEW.dilations[-1]})
    return Finding("views_disagree", values={"share": share})


def odd_views(view_explained: Tensor) -> list[int]:
    """The views that explain far less than the median of the others does: most likely their poses are wrong.
    `view_explained` (V,) is that of `Matching`; none with fewer than four views, or where no view explains anything."""
    if len(view_explained) < NVIEW.min_views:
        return []
    return (view_explained < NVIEW.alike * view_explained.nanmedian()).nonzero()[:, 0].tolist()
