"""The fit of a tube to the outlines of its masks: reweighted Gauss-Newton, as for leaf patches.

Both sides of the tube, and its two ends, are compared with the edges of the masks along the image normals. Where the
mask ends because another instance or the frame hides the rest, the tube only has to reach its edge. Masks that show a
part of the stem shorten it little: an end inside of a mask counts more than one beyond it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mvseg.arrays import Floats
from mvseg.reconstruction.numbers import ERRORS, FIT, PRIOR, TUBE
from mvseg.reconstruction.stem.tube import AXIS, RADIUS, Tube, axis_slopes, fit_axis, tube_places
from mvseg.reconstruction.surface.find_starts import start_in
from mvseg.reconstruction.surface.fit_patch import invert_normal, per_view
from mvseg.reconstruction.surface.hull import carve_hull
from mvseg.reconstruction.surface.leaf_patch import MIDRIB, patch_grid, spline_basis, unit_vectors
from mvseg.reconstruction.surface.mask_errors import winsorised_mean
from mvseg.reconstruction.surface.mask_stack import MaskStack
from mvseg.reconstruction.surface.outline import OutlineSamples, search_edges
from mvseg.reconstruction.surface.patch_image import Projection, crop_ious, draw_patch

SIZE = 3 * AXIS + RADIUS  # coefficients in all
ENDS = [0, TUBE.rows - 1]  # of the places at which a tube is compared


def fit_tube(masks: MaskStack, start: Floats | None = None, *, mask_sd_px: float = 0.0) -> Tube:
    """Fit a tube to the masks of one stem, in two views or more. The tube is in the world of `masks`; there is none
    where the masks do not tell where it runs.

    Args:
        start: (P, 3) points roughly along the axis, from end to end, as the midrib of a patch; None: the axis is looked
            for in the hull of the masks.
        mask_sd_px: standard deviation of the distance by which the masks of this segmenter are too large, pixels of the
            photos; 0 for exact ones.
    """
    if len(masks) < 2:
        return Tube.none()
    rough = _start_in_hull(masks) if start is None else start
    if rough is None:
        return Tube.none()
    length = float(np.linalg.norm(np.diff(rough, axis=0), axis=1).sum())
    centre = rough.mean(0)
    if not length > 0:
        return Tube.none()
    moved = masks.move_worlds(centre[None], np.array([length]))
    axis = fit_axis((rough - centre) / length)
    state, offsets = _State(axis, np.full(RADIUS, _first_radius(moved, axis))), np.zeros(len(masks))
    for step in range(TUBE.num_steps + 1):
        share = min(1.0, step / TUBE.far_steps)
        reach = FIT.far_reach + (FIT.near_reach - FIT.far_reach) * share
        distances = tube_distances(moved, state.axis, state.radii, reach=reach)
        if step >= TUBE.far_steps // 2:
            sides = distances.is_side
            measured = per_view(distances.px[sides], distances.stack[sides], len(masks))
            offsets = believe_offsets(measured, mask_sd_px / masks.pixel_size)
            distances = distances.without(offsets)
        weight = _weigh(distances, FIT.far_scale_px + (FIT.least_scale_px - FIT.far_scale_px) * share)
        if step < TUBE.num_steps:
            state = _step(state, distances, weight)
    rows, _ = _prior(state)
    normal = (distances.jacobian.T * weight) @ distances.jacobian + rows.T @ rows
    if not np.isfinite(invert_normal(normal)).all():  # the masks do not tell where it runs
        return Tube.none()
    iou = tube_ious(moved, state.axis, state.radii, offsets=offsets)
    return Tube(state.axis * length + centre, state.radii * length, iou)


def believe_offsets(measured: Floats, sd_px: float) -> Floats:
    """(S,) pixels by which the mask of each view is likely too large, from measured offsets (S,), NaN for none: the
    part that is likely where masks differ by this standard deviation."""
    finite = measured[np.isfinite(measured)]
    if not len(finite):
        return np.zeros(len(measured))
    share = sd_px**2 / (sd_px**2 + ERRORS.measured_px**2)
    return np.asarray(np.nan_to_num(share * (measured - winsorised_mean(finite))))


@dataclass(frozen=True, eq=False)
class _State:
    axis: Floats
    radii: Floats


@dataclass(frozen=True, eq=False)
class TubeDistances:
    """N signed distances, positive where the tube has to grow.

    Attributes:
        stack: (N,) place in `MaskStack.views`.
        px: (N,).
        jacobian: (N, 21) how far the outline moves outwards, in pixels, per axis and radius coefficient.
        weight: (N,).
        is_side: (N,) bool; the others are at the ends.
    """

    stack: NDArray[np.int64]
    px: Floats
    jacobian: Floats
    weight: Floats
    is_side: NDArray[np.bool_]

    def without(self, offsets: Floats) -> TubeDistances:
        """The same, as if the mask of each view (S,) were not too large by so many pixels."""
        return replace(self, px=self.px - offsets[self.stack])


@dataclass(frozen=True, eq=False)
class Ribbon:
    """A tube as S views see it, at M places.

    Attributes:
        px: (S, M, 2) of the axis.
        depth: (S, M).
        normals: (S, M, 2) unit, across the image of the axis.
        ahead: (S, M, 2) along it; its length is the pixels per world unit along the axis.
        moves: (S, M, 2, 3) pixels per world unit of the axis.
        per_radius: (S, M) pixels from the axis to the outline per world unit of the radius.
        sine: (S, M) of the angle between axis and line of sight.
    """

    px: Floats
    depth: Floats
    normals: Floats
    ahead: Floats
    moves: Floats
    per_radius: Floats
    sine: Floats


def see_tube(px_from_world: Floats, points: Floats, directions: Floats) -> Ribbon:
    """The images of points (M, 3) of an axis with unit directions (M, 3) in S views (S, 3, 4)."""
    cam = points @ px_from_world[:, :, :3].transpose(0, 2, 1) + px_from_world[:, None, :, 3]
    depth = np.maximum(cam[..., 2], 1e-9)
    px = cam[..., :2] / depth[..., None]
    rows = px_from_world[:, None]
    moves = (rows[:, :, :2, :3] - px[..., None] * rows[:, :, 2:, :3]) / depth[..., None, None]
    ahead = np.einsum("smij,mj->smi", moves, directions)
    length = np.maximum(np.linalg.norm(ahead, axis=2, keepdims=True), 1e-12)
    normals = np.stack([-ahead[..., 1], ahead[..., 0]], 2) / length
    centers = -np.linalg.solve(px_from_world[:, :, :3], px_from_world[:, :, 3:])[..., 0]
    sight = centers[:, None] - points
    sight /= np.maximum(np.linalg.norm(sight, axis=2, keepdims=True), 1e-12)
    across = np.cross(np.broadcast_to(directions, sight.shape), sight)
    sine = np.linalg.norm(across, axis=2)
    across = across / np.maximum(sine, 1e-12)[..., None]
    per_radius = np.abs(np.einsum("smi,smij,smj->sm", normals, moves, across))
    return Ribbon(px, depth, normals, ahead, moves, per_radius, sine)


def tube_distances(masks: MaskStack, axis: Floats, radii: Floats, *, reach: float) -> TubeDistances:
    """How far both sides and both ends of a tube are from the edges of its masks; edges beyond `reach` do not count."""
    u = tube_places(TUBE.rows)
    basis, by_radius = spline_basis(u, AXIS), spline_basis(u, RADIUS)
    ribbon = see_tube(masks.px_from_world, basis @ axis, unit_vectors(axis_slopes(u) @ axis))
    half = (ribbon.per_radius * np.maximum(by_radius @ radii, 0))[..., None] * ribbon.normals
    num = len(u)
    place = np.concatenate([np.arange(num), np.arange(num), ENDS])
    tips, ahead = _tips(ribbon, by_radius @ radii)
    px = np.concatenate([ribbon.px - half, ribbon.px + half, tips], 1).reshape(-1, 2)
    normals = np.concatenate([-ribbon.normals, ribbon.normals, ahead], 1)
    moves = np.einsum("ski,skij->skj", normals, ribbon.moves[:, place])
    wider = np.concatenate([ribbon.per_radius, ribbon.per_radius, _caps(ribbon)], 1)
    by_axis = (basis[place][None, :, :, None] * moves[:, :, None]).reshape(len(px), -1)
    jacobian = np.concatenate([by_axis, (wider[..., None] * by_radius[place]).reshape(len(px), -1)], 1)
    normals = normals.reshape(-1, 2)
    is_end = np.tile(np.arange(len(place)) >= 2 * num, len(masks))
    is_corner = np.tile(np.isin(place, ENDS), len(masks)) & ~is_end  # where sides end, masks are round
    stack, nothing = np.repeat(np.arange(len(masks)), len(place)), np.zeros(len(px))
    samples = OutlineSamples(stack, px, normals, nothing.astype(np.int64), nothing)
    to_edge, hidden = search_edges(masks, samples, masks.blurred, reach=reach, offsets=np.zeros(len(masks)))
    goes_on = masks.look_up(masks.inside, stack, px) & masks.look_up(masks.inside, stack, px + reach * normals)
    to_edge = np.where(is_end & goes_on, reach, to_edge)
    counts = np.isfinite(to_edge) & ~is_corner & ~(hidden & (to_edge < 0))
    weight = ribbon.sine[:, place].ravel() * np.where(is_end, TUBE.end_weight, 1.0)
    weight *= np.where(is_end & (np.nan_to_num(to_edge) < 0), TUBE.shorten, 1.0)
    return TubeDistances(stack[counts], to_edge[counts], jacobian[counts], weight[counts], ~is_end[counts])


def tube_ious(masks: MaskStack, axis: Floats, radii: Floats, *, offsets: Floats) -> Floats:
    """(S,) IoU of a tube and the mask in each view, where nothing else hides them. The tube is drawn too large or small
    by `offsets` (S,) pixels, as the mask of each view is."""
    u = tube_places(TUBE.rows)
    middle = see_tube(masks.px_from_world, spline_basis(u, AXIS) @ axis, unit_vectors(axis_slopes(u) @ axis))
    half = (middle.per_radius * np.maximum(spline_basis(u, RADIUS) @ radii, 0))[..., None] * middle.normals
    px = middle.px.copy()
    px[:, ENDS] = _tips(middle, np.pi / 4 * spline_basis(u, RADIUS) @ radii)[0]  # rectangles of the area of round ends
    ribbon = np.stack([px - half, px, px + half], 2)
    projection = Projection(ribbon, np.repeat(middle.depth[..., None], 3, 2))
    drawn = draw_patch(masks, projection, offsets=offsets, is_blurred=False)
    return crop_ious(masks, drawn >= 0.5)


def _caps(ribbon: Ribbon) -> Floats:
    """(S, 2) pixels by which the round ends reach beyond those of the axis, per world unit of the radius."""
    return np.asarray((ribbon.per_radius * np.sqrt(np.maximum(1 - ribbon.sine**2, 0)))[:, ENDS])


def _tips(ribbon: Ribbon, radius: Floats) -> tuple[Floats, Floats]:
    """(S, 2, 2) where both ends of a tube with radii (M,) end in the images, and unit vectors (S, 2, 2) outwards."""
    ahead = unit_vectors(ribbon.ahead[:, ENDS]) * np.array([[-1.0], [1.0]])
    return ribbon.px[:, ENDS] + (_caps(ribbon) * np.maximum(radius[ENDS], 0))[..., None] * ahead, ahead


def _start_in_hull(masks: MaskStack) -> Floats | None:
    """(P, 3) the middle line of the masks' hull; None where they share no point."""
    turned = masks.turn_world(masks.axes)
    hull = carve_hull(turned)
    for keep in (hull.is_seen, np.ones_like(hull.is_seen)):
        if keep.any() and (starts := start_in(replace(hull, voxels=hull.voxels[keep]))):
            middle = spline_basis(tube_places(TUBE.rows), MIDRIB.stop - MIDRIB.start) @ starts[0][MIDRIB]
            return np.asarray(middle @ masks.axes)
    return None


def midrib_of(coefficients: Floats) -> Floats:
    """(P, 3) points along the midrib of a patch (26, 3): where the fit of a tube may start."""
    grid = patch_grid(*TUBE.patch_grid)
    return np.asarray(grid.points(coefficients)[:, TUBE.patch_grid[1] // 2])


def _first_radius(masks: MaskStack, axis: Floats) -> float:
    """Half the median width of the masks across the axis; at least half a pixel."""
    width, _ = apparent_widths(masks, axis)
    depth, rows = np.maximum(masks.px_from_world[:, 2, 3], 1e-9), masks.px_from_world[:, :2, :3]
    pixel = float(np.median(depth / np.maximum(np.linalg.norm(rows, axis=2).max(1), 1e-12)))
    return float(max(np.nanmedian(width) / 2, pixel / 2)) if np.isfinite(width).any() else pixel


def apparent_widths(masks: MaskStack, axis: Floats) -> tuple[Floats, Floats]:
    """(S, M) widths of the mask in each view around an axis (6, 3), at M places along it: world units, and pixels. NaN
    where nothing of the mask is there, another instance borders or interrupts it, or the view looks along the axis."""
    u = tube_places(TUBE.rows + 2)[1:-1]
    ribbon = see_tube(masks.px_from_world, spline_basis(u, AXIS) @ axis, unit_vectors(axis_slopes(u) @ axis))
    half = max(masks.size) // 2
    steps = np.arange(-half, half + 1.0)
    px = ribbon.px[:, :, None] + steps[:, None] * ribbon.normals[:, :, None]
    stack = np.broadcast_to(np.arange(len(masks))[:, None, None], px.shape[:3])
    place = masks.place_of(stack.ravel(), px.reshape(-1, 2))
    inside = masks.inside.ravel().take(place).reshape(px.shape[:3])
    hidden = masks.others.ravel().take(place).reshape(px.shape[:3]) != 0
    count = inside.sum(2)
    near = np.abs(steps) <= (count / 2 + TUBE.beside_px)[..., None]
    is_good = (count > 0) & ~(hidden & near).any(2) & (ribbon.sine > TUBE.least_sine)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(is_good, count / ribbon.per_radius, np.nan), np.where(is_good, count, np.nan)


def _weigh(distances: TubeDistances, scale_px: float) -> Floats:
    spread = float(np.median(np.abs(distances.px))) if len(distances.px) else 0.0
    scale = max(scale_px, FIT.scale_factor * spread)
    return np.asarray(FIT.sample_weight * distances.weight / (1 + (distances.px / scale) ** 2))


def _prior(state: _State) -> tuple[Floats, Floats]:
    """A (E, 21) and b (E,) about the coefficients: stems bend evenly, places are even, radii change slowly."""
    bend = np.kron(np.diff(np.eye(AXIS), 3, axis=0), np.eye(3)) / TUBE.bend_sd
    u = tube_places(AXIS + 1)
    speeds = np.diff(spline_basis(u, AXIS), axis=0) * AXIS
    ahead = speeds @ state.axis
    length = np.linalg.norm(ahead, axis=1).mean()
    even = (speeds[:, :, None] * unit_vectors(ahead)[:, None]).reshape(AXIS, -1) / (PRIOR.speed_sd * length)
    mean = max(float(np.abs(state.radii).mean()), 1e-9)
    taper = np.diff(np.eye(RADIUS), 1, axis=0) / (TUBE.taper_sd * mean)
    rows = np.zeros((len(bend) + len(even) + len(taper), SIZE))
    rows[: len(bend), : 3 * AXIS] = bend / length
    rows[len(bend) : -len(taper), : 3 * AXIS] = even
    rows[-len(taper) :, 3 * AXIS :] = taper
    target = np.zeros(len(rows))
    target[len(bend) : -len(taper)] = 1 / PRIOR.speed_sd
    return rows, target


def _step(state: _State, distances: TubeDistances, weight: Floats) -> _State:
    """One damped Gauss-Newton step; no point moves by more than a part of the length."""
    rows, target = _prior(state)
    now = np.concatenate([state.axis.ravel(), state.radii])
    pulled = distances.jacobian.T * weight
    matrix = pulled @ distances.jacobian + rows.T @ rows
    right = pulled @ distances.px + rows.T @ (target - rows @ now)
    by_vector = np.diag(matrix)[: 3 * AXIS].reshape(AXIS, 3).mean(1)  # the same along all axes of the world
    matrix[np.diag_indices(SIZE)] += TUBE.damping * np.append(np.repeat(by_vector, 3), np.diag(matrix)[3 * AXIS :])
    step = np.linalg.solve(matrix, right)
    moved = step[: 3 * AXIS].reshape(AXIS, 3)
    longest = float(np.linalg.norm(moved, axis=1).max())
    share = min(1.0, TUBE.most_step / max(longest, 1e-12))
    radii = state.radii + share * step[3 * AXIS :]
    return _State(state.axis + share * moved, np.maximum(radii, TUBE.least_radius * np.abs(state.radii).mean()))
