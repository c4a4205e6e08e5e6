"""The fit of leaf patches to the outlines of their masks: reweighted Gauss-Newton, of several leaves at once."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mvseg.arrays import Floats
from mvseg.reconstruction.numbers import FIT
from mvseg.reconstruction.surface.leaf_patch import MIDRIB, PatchSize, measure_patch, patch_grid, patch_prior
from mvseg.reconstruction.surface.mask_errors import MaskErrors, winsorised_mean
from mvseg.reconstruction.surface.mask_stack import MaskStack, places_of_views
from mvseg.reconstruction.surface.outline import Distances, outline_distances

FIRST_HALF, SECOND_HALF = range(5), range(5, 10)  # steps from a rough start (a technical limit)


@dataclass(frozen=True, eq=False)
class PatchFit:
    """A fitted patch, in the world of `masks` (moved and scaled to the leaf).

    Attributes:
        coefficients: (26, 3).
        covariance: (78, 78); NaN where hardly any edge was met, so that masks do not tell the coefficients.
        residual_px: (S,) root mean square distance per view, robustly weighted.
        offsets_px: (S,) by how much the mask of each view is too large; NaN where none of its edges was met.
        spread: how far the areas of other fits that are as good are from this one's, as a share of it.
    """

    coefficients: Floats
    covariance: Floats
    residual_px: Floats
    offsets_px: Floats
    spread: float = 0.0


def approach_patches(masks: MaskStack, starts: Floats, *, steps: range) -> tuple[Floats, Floats]:
    """Move rough patches (L, 26, 3) until their outlines are near those of the masks of L leaves; each ends as it would
    alone.

    `steps` are FIRST_HALF of the way, or the SECOND_HALF, from where the first one ends. Returns the patches, and by
    how much each mask is too large (S,), pixels.
    """
    moved, coefficients = _to_unit_worlds(masks, starts)
    grid = patch_grid(*(FIT.far_grid if steps == FIRST_HALF else FIT.grid))
    offsets = np.zeros(len(masks))
    for step in steps:
        share = step / SECOND_HALF.stop
        reach = FIT.far_reach + (FIT.near_reach - FIT.far_reach) * share
        distances = outline_distances(moved, grid, coefficients, reach=reach, is_imaged=False)
        if step >= FIT.offset_from:
            measured = per_view(distances.px, distances.stack, len(masks))
            offsets = np.concatenate([_believe(each, None) for each in masks.split(measured)])
        scale = FIT.far_scale_px + (FIT.least_scale_px - FIT.far_scale_px) * share
        equations = _weigh(distances, masks, offsets, scale_px=scale)
        coefficients = _step(coefficients, equations, FIT.far_step)
    return _from_unit_worlds(coefficients, starts), offsets


def fit_patches(
    masks: MaskStack, starts: Floats, *, num_steps: int, errors: MaskErrors | None = None
) -> list[PatchFit]:
    """Move patches that are nearly right until their outlines, drawn as the masks are, are theirs.

    Args:
        masks: of L leaves, see `join_stacks`.
        starts: (L, 26, 3) coefficients.
        num_steps: 0 leaves the patches where they are.
        errors: how the masks of this segmenter err, for one leaf; None: they are right on average over the views.
    """
    moved, coefficients = _to_unit_worlds(masks, starts)
    drawn, offsets = np.zeros(len(masks)), np.zeros(len(masks))
    for step in range(num_steps + 1):
        drawn = offsets if errors else drawn
        distances = outline_distances(
            moved, patch_grid(*FIT.grid), coefficients, reach=FIT.near_reach, is_imaged=True, offsets=drawn
        )
        measured = drawn + per_view(distances.px, distances.stack, len(masks))
        offsets = np.concatenate([_believe(each, errors) for each in masks.split(measured)])
        equations = _weigh(distances, masks, offsets - drawn, scale_px=FIT.least_scale_px)
        if step < num_steps:
            coefficients = _step(coefficients, equations, FIT.near_step)
    matrices, scales = _normal_matrices(coefficients, equations, measure_patch(coefficients))[0], measure_patch(starts)
    fitted, rms = _from_unit_worlds(coefficients, starts), masks.split(_rms_per_view(equations, len(masks)))
    fits = []
    for leaf, of_leaf in enumerate(masks.split(measured)):
        own = equations.of_leaf(leaf)
        stack = own.distances.stack - np.searchsorted(masks.leaf, leaf)
        covariance = _covariance(matrices[leaf], own, stack, centre_sd=_centre_sd(of_leaf, errors))
        fits.append(
            PatchFit(
                coefficients=fitted[leaf],
                covariance=covariance * float(scales.length[leaf]) ** 2,
                residual_px=rms[leaf],
                offsets_px=of_leaf - _centre(of_leaf, errors),
            )
        )
    return fits


def _to_unit_worlds(masks: MaskStack, starts: Floats) -> tuple[MaskStack, Floats]:
    centres, scales = starts[:, MIDRIB].mean(1), measure_patch(starts).length
    coefficients = starts.copy()
    coefficients[:, MIDRIB] -= centres[:, None]
    return masks.move_worlds(centres, scales), coefficients / scales[:, None, None]


def _from_unit_worlds(coefficients: Floats, starts: Floats) -> Floats:
    coefficients = coefficients * measure_patch(starts).length[:, None, None]
    coefficients[:, MIDRIB] += starts[:, MIDRIB].mean(1)[:, None]
    return coefficients


@dataclass(frozen=True, eq=False)
class _Equations:
    """Outlines of L patches: N distances, px (N,) without offsets of masks, weights (N,), noise (L,) >= 1."""

    distances: Distances
    px: Floats
    weight: Floats
    noise: Floats

    def of_leaf(self, leaf: int) -> _Equations:
        keep = self.distances.leaf == leaf
        return _Equations(self.distances.select(keep), self.px[keep], self.weight[keep], self.noise[[leaf]])


def _covariance(matrix: Floats, equations: _Equations, stack: NDArray, *, centre_sd: float) -> Floats:
    """(78, 78): the fit's own, contradictions of views, errors that masks may share; NaN where singular."""
    inverse = invert_normal(matrix)
    weight, px = equations.weight, equations.px
    num_views = int(stack.max(initial=0)) + 1
    jacobian = equations.distances.jacobian
    pulls = np.zeros((num_views, len(inverse)))
    np.add.at(pulls, stack, jacobian * (weight * px)[:, None])
    between = inverse @ pulls.T
    growth = inverse @ (jacobian.T @ weight)  # by which everything changes when all masks grow by a pixel
    rms = np.sqrt((weight * px**2).sum() / max(weight.sum(), 1e-12))
    few = num_views / max(num_views - 2, FIT.least_free)
    shared = FIT.centre_factor * few * max(centre_sd, FIT.least_centre_sd)
    fitted = (FIT.sd_factor * max(1.0, rms / FIT.quiet_px)) ** 2 * inverse
    return fitted + between @ between.T + shared**2 * np.outer(growth, growth)


def invert_normal(matrix: Floats) -> Floats:
    """The inverse of a normal matrix (n, n); NaN where it is singular but for rounding.

    Its eigenvalues tell, after its diagonal is scaled to 1: whether elimination stops at a pivot of exactly 0 depends
    on how a processor rounds, and where it does not stop the inverse is noise.
    """
    scale = np.sqrt(np.maximum(np.diag(matrix), 0))
    if not np.isfinite(matrix).all() or not scale.all():
        return np.full_like(matrix, np.nan)
    if np.linalg.eigvalsh(matrix / scale / scale[:, None])[0] < FIT.least_eigenvalue:
        return np.full_like(matrix, np.nan)
    return np.asarray(np.linalg.inv(matrix), dtype=float)


def _weigh(distances: Distances, masks: MaskStack, offsets: Floats, *, scale_px: float) -> _Equations:
    px, leaf = distances.px - offsets[distances.stack], distances.leaf
    spread = np.nan_to_num(per_view(np.abs(px), leaf, distances.num_leaves))
    scale = np.maximum(scale_px, FIT.scale_factor * spread)
    weight = FIT.sample_weight * distances.weight / (1 + (px / scale[leaf]) ** 2)
    weight = weight * _view_weights(px, distances, masks)[distances.stack]
    noise = np.maximum(1.0, FIT.sd_of_median * spread / FIT.clean_px)
    return _Equations(distances=distances, px=px, weight=weight, noise=noise)


def _believe(measured: Floats, errors: MaskErrors | None) -> Floats:
    """(S,) the offset of each view's mask, from the measured ones, NaN for views that show none."""
    share = errors.share if errors else FIT.offset_share
    return np.nan_to_num(share * (measured - _centre(measured, errors)))


def _centre(measured: Floats, errors: MaskErrors | None) -> float:
    """The offset, in pixels, that masks without an error would have measured; `measured` is NaN where nothing was."""
    known = measured[np.isfinite(measured)]
    if not len(known):
        return 0.0
    return errors.centre(known)[0] if errors else winsorised_mean(known)


def _centre_sd(measured: Floats, errors: MaskErrors | None) -> float:
    known = measured[np.isfinite(measured)]
    if not len(known):
        return 0.0
    return errors.centre(known)[1] if errors else float(known.std() / np.sqrt(len(known)))


def _view_weights(px: Floats, distances: Distances, masks: MaskStack) -> Floats:
    """(S,) 1, or less for views whose distances spread more than is usual in the others of the leaf."""
    spreads = np.nan_to_num(per_view(np.abs(px), distances.stack, len(masks)))
    usual = FIT.noisy_view * np.maximum(per_view(spreads, masks.leaf, distances.num_leaves), FIT.usual_px)
    return np.minimum(1.0, (usual[masks.leaf] / np.maximum(spreads, 1e-9)) ** 2)


def per_view(values: Floats, stack: np.ndarray, num_views: int) -> Floats:
    """(S,) medians; NaN for a view without samples."""
    places = places_of_views(stack, num_views)
    counts, view = (places >= 0).sum(1), np.arange(num_views)
    ordered = np.sort(np.append(values, np.nan)[places], 1)  # what is not a number comes last
    if not ordered.size:
        return np.full(num_views, np.nan)
    return np.asarray((ordered[view, np.maximum(counts - 1, 0) // 2] + ordered[view, counts // 2]) / 2)


def _normal_matrices(coefficients: Floats, equations: _Equations, size: PatchSize) -> tuple[Floats, Floats]:
    """(L, 78, 78) and (L, 78): outlines and prior together, about the present coefficients of patches of this size."""
    prior, target = patch_prior(coefficients, size, noise=equations.noise)
    matrices, right = equations.distances.normal_equations(equations.px, equations.weight)
    missing = target[..., None] - prior @ coefficients.reshape(len(prior), -1, 1)
    return matrices + prior.mT @ prior, right + (prior.mT @ missing)[..., 0]


def _step(coefficients: Floats, equations: _Equations, damping_and_cap: tuple[float, float]) -> Floats:
    """One damped Gauss-Newton step; no point of a patch moves by more than `cap` half-widths."""
    damping, cap = damping_and_cap
    size = measure_patch(coefficients)
    matrices, right = _normal_matrices(coefficients, equations, size)
    diagonal = np.einsum("lii->li", matrices)  # a view
    by_vector = diagonal.reshape(len(diagonal), -1, 3).mean(2)  # the same along all axes, however the world is turned
    diagonal += damping * np.repeat(by_vector, 3, axis=1)
    step = np.linalg.solve(matrices, right[..., None]).reshape(coefficients.shape)
    longest = np.linalg.norm(patch_grid(*FIT.grid).basis @ step, axis=-1).max(-1)
    limit = cap * np.maximum(size.half_width, FIT.narrow * size.length)
    return coefficients + step * np.minimum(1.0, limit / np.maximum(longest, 1e-12))[:, None, None]


def _rms_per_view(equations: _Equations, num_views: int) -> Floats:
    distances = equations.distances
    squares = np.bincount(distances.stack, equations.weight * distances.px**2, num_views)
    with np.errstate(invalid="ignore"):
        return np.asarray(np.sqrt(squares / np.bincount(distances.stack, equations.weight, num_views)))
