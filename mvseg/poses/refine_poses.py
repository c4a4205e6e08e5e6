"""Poses that are a few pixels off, refined with the masks as the only evidence.

Every leaf that two views show whole tells by how many pixels their epipolar lines miss (`tangency.py`), and that is
far more than the six unknowns of each pose. Not in the paper.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from mvseg.errors import check_arguments, warn
from mvseg.formats.lens import opencv_distortion
from mvseg.masks import Masks
from mvseg.matching.result import Matching
from mvseg.matching.tangency import (
    Outlines,
    TangencyResiduals,
    find_outlines,
    move_cameras,
    pair_outlines,
    tangency_residuals,
)
from mvseg.poses.numbers import REFINE
from mvseg.regions import Regions
from mvseg.scene import Cameras, Scene

Match = Callable[[Cameras], Matching]


@dataclass(frozen=True, eq=False)
class RefinedPoses:
    """What came of refining the poses with the masks.

    Attributes:
        cameras: V cameras, the given ones unless they are refined.
        is_refined: whether refined poses were taken.
        residual_px: by how many pixels outlines of one leaf miss the same epipolar lines, with the poses as given, and
            with poses refined without that leaf; NaN where no leaf tells.
    """

    cameras: Cameras
    is_refined: bool
    residual_px: tuple[float, float]


@check_arguments
def refine_poses(cameras: Cameras, match: Match) -> RefinedPoses:
    """Match, refine the poses, match with these, and so on until no id changes.

    Poses whose residuals are below `REFINE.least_residual_px` stay. Refined ones are taken when they explain leaves
    that they were not fitted to, in turn a fifth of them, clearly better than the given ones do, and ids are as sure as
    with these. Otherwise the given ones stay as if nothing had been tried. What matching warns of on the way is not
    passed on.

    Args:
        cameras: V cameras, as they are given; the refined ones are on their device.
        match: from cameras to the matched masks, `partial(match_regions, regions)` for example.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        given = matching = match(cameras)
        refined, residual_px = cameras, held_out_residuals(matching.masks, cameras)
        for _ in range(REFINE.rounds):
            if not (residual_px[0] >= REFINE.least_residual_px and residual_px[1] < residual_px[0]):
                break
            refined = fit_poses(adjust(matching.masks, cameras)).to(cameras.device)
            before, matching = matching.masks, match(refined)
            same = torch.equal(before.regions.labels, matching.masks.regions.labels)
            if same and torch.equal(before.instance_ids, matching.masks.instance_ids):
                break
            residual_px = held_out_residuals(matching.masks, cameras)
    is_off = residual_px[0] >= REFINE.least_residual_px
    is_sure = mean_score(matching) >= mean_score(given) - REFINE.loss
    is_better = is_off and is_sure and residual_px[1] <= REFINE.clear * residual_px[0]
    return RefinedPoses(cameras=refined if is_better else cameras, is_refined=is_better, residual_px=residual_px)


def refine_scene(scene: Scene, match: Match) -> tuple[Scene, RefinedPoses]:
    """A scene with refined poses, see `refine_poses`. Warns (InputWarning) of cameras that no rig file can hold."""
    poses = refine_poses(scene.cameras, match)
    odd = [view.name for view in scene.views if opencv_distortion(view.lens) is None]
    if odd and poses.is_refined:
        warn(f"the refined cameras are not written: view {odd[0]} has a lens that no rig file can hold")
    return replace(scene, cameras=poses.cameras), poses


def mean_score(matching: Matching) -> float:
    """Mean match score of the matched masks; 0 without any."""
    is_matched = matching.instance_ids > 0
    return float(matching.match_scores[is_matched].mean()) if is_matched.any() else 0.0


@dataclass(frozen=True, eq=False)
class Adjustment:
    """What poses are fitted to.

    Attributes:
        outlines: N outlines.
        pairs: (Q, 2) int64, those that should end together.
        cameras: V cameras as given, on the CPU.
        world_per_px: (V,) float64, see `move_cameras`.
        unit_px: pixels per unit.
    """

    outlines: Outlines
    pairs: Tensor
    cameras: Cameras
    world_per_px: Tensor
    unit_px: float

    def select(self, index: Tensor) -> Adjustment:
        """The same with some of the outlines only."""
        outlines = self.outlines.select(index)
        return replace(self, outlines=outlines, pairs=pair_outlines(outlines, self.cameras))

    def residuals(self, cameras: Cameras) -> TangencyResiduals:
        """All residuals with these cameras."""
        return tangency_residuals(self.outlines, self.pairs, cameras, world_per_px=self.world_per_px)

    def weights(self, residuals: TangencyResiduals, left_px: Tensor) -> Tensor:
        """(T,) weights by Geman and McClure: what a neighbour hides ends elsewhere, and so does another leaf."""
        sigma = max(REFINE.least_sd * self.unit_px, 1.4826 * float(left_px.abs().median()))
        return residuals.weight / sigma**2 / (1 + (left_px / (REFINE.doubted * sigma)) ** 2) ** 2


def adjust(masks: Masks, cameras: Cameras) -> Adjustment:
    """What poses are fitted to, from the matched masks of V views."""
    cameras, regions = cameras.to("cpu"), masks.regions
    outlines = find_outlines(masks, cameras)
    return Adjustment(
        outlines=outlines,
        pairs=pair_outlines(outlines, cameras),
        cameras=cameras,
        world_per_px=distances(regions.to("cpu"), cameras) / cameras.K[:, 0, 0],
        unit_px=cameras.unit_px,
    )


def distances(regions: Regions, cameras: Cameras) -> Tensor:
    """(V,) float64, world units from each camera to the point that is nearest to the rays through all masks."""
    middle = (regions.boxes[:, :2] + regions.boxes[:, 2:]).double() / 2
    pixels = torch.cat((middle, torch.ones_like(middle[:, :1])), 1)
    rays = (cameras.world_from_px[regions.view_index] @ pixels[..., None])[..., 0]
    return (cameras.centers - cameras.nearest_point(regions.view_index, rays)).norm(dim=1)


def fit_poses(problem: Adjustment) -> Cameras:
    """The cameras with the smallest residuals, by Gauss-Newton with robust weights.

    Beside the poses, how tightly every mask is drawn is unknown (a segmenter's masks are all a little too large or too
    small). What the masks do not tell, as the similarity of the world, stays as given: the poses have a prior there.
    """
    num_views, num_outlines = len(problem.cameras), len(problem.outlines.view)
    sigmas = torch.tensor([REFINE.pose_sd, REFINE.growth_sd], dtype=torch.float64)
    prior = (sigmas * problem.unit_px).repeat_interleave(torch.tensor([6 * num_views, num_outlines])) ** -2
    state, cameras = torch.zeros(len(prior)).double(), problem.cameras
    for _ in range(REFINE.steps):
        residuals = problem.residuals(cameras)
        if not len(residuals.px):
            break
        of_growth = 6 * num_views + residuals.outlines[..., None]
        of_pose = 6 * problem.outlines.view[residuals.outlines][..., None] + torch.arange(6)
        columns = torch.cat((of_pose, of_growth), 2).flatten(1)
        slopes = torch.cat((residuals.by_pose, residuals.by_growth[..., None]), 2).flatten(1)
        left_px = residuals.px + (residuals.by_growth * state[of_growth[..., 0]]).sum(1)
        step = _solve(columns, slopes, left_px, weights=problem.weights(residuals, left_px), prior=prior, state=state)
        state = state + step
        cameras = move_cameras(cameras, step[: 6 * num_views].reshape(-1, 6), problem.world_per_px)
        if step.abs().max() < REFINE.converged * problem.unit_px:
            break
    return cameras


def _solve(columns: Tensor, slopes: Tensor, left: Tensor, *, weights: Tensor, prior: Tensor, state: Tensor) -> Tensor:
    """(P,) one step of Gauss-Newton for T residuals, each with derivatives (T, C) by the unknowns `columns` (T, C).

    No step where the equations are singular but for rounding: lines of sight along a baseline have derivatives beside
    which the prior counts nothing.
    """
    weighted = weights[:, None] * slopes
    normal, right = torch.diag(prior), -prior * state
    products = weighted[:, :, None] * slopes[:, None, :]
    normal.index_put_((columns[:, :, None], columns[:, None, :]), products, accumulate=True)
    right.index_put_((columns,), -weighted * left[:, None], accumulate=True)
    factor, info = torch.linalg.cholesky_ex(normal)
    return torch.zeros_like(right) if info else torch.cholesky_solve(right[:, None], factor)[:, 0]


def held_out_residuals(masks: Masks, cameras: Cameras) -> tuple[float, float]:
    """Pixels; mean over the views of the median residual of their leaves, with the given cameras, and with cameras that
    are refined without these leaves. NaN where there are no residuals."""
    problem, parts = adjust(masks, cameras), []
    fold = problem.outlines.instance % REFINE.folds
    for number in range(REFINE.folds):
        if (fold == number).any():
            looked_at, fitted = problem.select(fold == number), fit_poses(problem.select(fold != number))
            parts.append([_remaining_residuals(looked_at, cameras) for cameras in (problem.cameras, fitted)])
    if not parts:
        return float("nan"), float("nan")
    before, after = (torch.cat(residuals, 1) for residuals in zip(*parts, strict=True))
    return _mean_of_views(before), _mean_of_views(after)


def _remaining_residuals(problem: Adjustment, cameras: Cameras) -> Tensor:
    """(3, T) float64: what is left of each residual when masks may be drawn too tightly, and its two views."""
    residuals = problem.residuals(cameras)
    prior = torch.full((len(problem.outlines.view),), (REFINE.growth_sd * problem.unit_px) ** -2).double()
    growth, left_px = torch.zeros_like(prior), residuals.px
    for _ in range(REFINE.steps if len(residuals.px) else 0):
        weights = problem.weights(residuals, left_px)
        step = _solve(residuals.outlines, residuals.by_growth, left_px, weights=weights, prior=prior, state=growth)
        growth = growth + step
        left_px = residuals.px + (residuals.by_growth * growth[residuals.outlines]).sum(1)
        if step.abs().max() < REFINE.converged * problem.unit_px:
            break
    return torch.cat((left_px.abs()[None], problem.outlines.view[residuals.outlines].T.double()))


def _mean_of_views(residuals: Tensor) -> float:
    px, views = residuals[0], residuals[1:]
    if not len(px):
        return float("nan")
    return float(torch.stack([px[(views == view).any(0)].median() for view in views.unique()]).mean())
