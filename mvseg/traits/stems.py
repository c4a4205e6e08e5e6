"""Stems of a plant, from the bases of its leaves and from thin parts in its photos."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import combinations
from typing import NamedTuple

import numpy as np
import torch
from scipy.special import expit

from mvseg.arrays import Floats
from mvseg.errors import warn
from mvseg.findings.finding import Finding
from mvseg.formats.photos import Photos
from mvseg.masks import Masks
from mvseg.reconstruction.numbers import AXES
from mvseg.reconstruction.spread_views import spread_views
from mvseg.reconstruction.stem.leaf_bases import (
    BaseAxis,
    LeafBases,
    axes_of_bases,
    choose_ends,
    find_ends,
    project_bases,
)
from mvseg.reconstruction.stem.stem_axis import StemAxis
from mvseg.reconstruction.stem.stem_path import StemPath, find_path
from mvseg.reconstruction.stem.thin_parts import ThinCells, ThinView, find_cells, see_thin, share_of_views
from mvseg.reconstruction.surface.leaf_surface import LeafSurface
from mvseg.scene import Cameras
from mvseg.traits.nodes import Stem, measure_stem

MOST_VIEWS = 20  # limit: photos in which thin parts are looked for
LEAF_GRID = (24, 7)  # limit: points of a leaf from which its petiole may begin
MOST_GAP = 8.5  # chosen: longest step in a petiole that was traced, in cells
PRIOR = 1.4  # chosen: log odds of an axis that enough leaves sit on, before photos are looked at: 0.8
THIN_SHARE = 0.7  # chosen: share of the views that show it as thin, for photos to be as likely without a stem
SLOPE = 10.0  # chosen: log odds for each share above that, of an axis that is seen from end to end
LEAF_SHARE = 0.5  # chosen: min. leaves that sit on a path, of all
UPRIGHT = 0.3  # chosen: length of the mean of the directions that are up in the photos, for them to agree
FAINTEST = 0.25  # chosen: part of an axis that views need not show
UP_LEAVES = 0.8  # chosen: min. share of the leaves on the axis that tells up; two stems in one pot have 0.64
UP_SEEN = 0.8  # chosen: min. part of that axis that enough views see
PARALLEL_DEG = 45.0  # chosen: max. bend where two masks of one stem join
JOINT = 2.0  # chosen: max. gap there, in diameters
WIDER = 3.0  # chosen: width near an end, in that near the other one, from which the mask holds the pot, too
LEAST_STEM = 1.0  # chosen: length of a stem that shows up, in leaves; shorter ones of seedlings lean by 20 degrees


def find_stems(
    surfaces: Mapping[int, LeafSurface],
    masks: Masks,
    cameras: Cameras,
    *,
    frame: Floats | None,
    photos: Photos,
    of_masks: Sequence[MaskAxis] = (),
) -> tuple[Stem, ...]:
    """Find the stems that the leaves of a plant sit on, that of the most leaves first, and their nodes.

    Masks that show stems tell best. Otherwise leaves point back to them; where photos exist, these must show something
    thin there. Where leaves point to no stem, as those that are wider than long, the cheapest path through thin parts
    between them is one. There is none where leaves and views do not agree about one. Where leaves hide most of an axis,
    photos say little for or against it.

    Args:
        surfaces: {instance id: credible surface} of leaves.
        frame: (3, 3) rows east, north, up; None: up is not known.
        of_masks: what masks of stems show, see `axes_of_masks`.
    """
    if not surfaces:
        return ()
    upward = find_upward(cameras) if frame is None else frame[2]
    if stems := _of_masks(of_masks, surfaces, frame, upward):
        return stems
    axes = [each for each in axes_of_bases(surfaces, upward) if frame is None or _rises(each.axis, frame[2])]
    if not photos.exist:
        return _of_bases([(each, float(expit(PRIOR))) for each in axes], frame)
    plant = see_plant(surfaces, masks, cameras, photos=photos)
    chances = [plant.axis_chance(each.axis.points) for each in axes]
    likely = [(axis, chance) for axis, (chance, _) in zip(axes, chances, strict=True) if chance > 0.5]
    carried = sum(len(axis.bases) for axis, _ in likely) / len(surfaces)
    if carried >= AXES.near_share:  # else what is left of several axes may stand in free air
        tells_up = len(axes) == 1 and carried >= UP_LEAVES and chances[0][1] >= UP_SEEN
        return _of_bases(likely, frame, tells_up=tells_up)
    path = find_path(plant.cells, plant.leaves)
    if path is None or (chance := plant.axis_chance(path.points)[0]) <= 0.5:
        return ()
    stems = _of_path(path, surfaces, frame, upward, chance)
    return stems if upward is None else tuple(stem for stem in stems if _rises(stem.axis, upward))


class StemMark(NamedTuple):
    """Statement of the user: the stem drawn nearest to a pixel of a view is one, or is none."""

    view: int
    column: int
    row: int
    is_stem: bool


def judge_stems(stems: Sequence[Stem], marks: Sequence[StemMark], cameras: Cameras) -> tuple[Stem, ...]:
    """The stems; those that the user confirms are certain, those that the user rejects go. Later statements hold."""
    verdicts: dict[int, bool] = {}
    for mark in marks if stems else ():
        gaps = {stem.number: _gap_in_view(stem.axis, mark, cameras) for stem in stems}
        verdicts[min(gaps, key=lambda number: gaps[number])] = mark.is_stem
    judged = (replace(stem, probability=1.0) if stem.number in verdicts else stem for stem in stems)
    return tuple(stem for stem in judged if verdicts.get(stem.number, True))


def _gap_in_view(axis: StemAxis, mark: StemMark, cameras: Cameras) -> float:
    """Distance between a marked pixel and the nearest point of an axis in its view, pixels; inf behind the camera."""
    xy, depth = cameras[[mark.view]].to("cpu").project(torch.from_numpy(axis.points))
    return float((xy[0] - torch.tensor([mark.column, mark.row])).norm(dim=1).where(depth[0] > 0, torch.inf).min())


def find_upward(cameras: Cameras) -> Floats | None:
    """(3,) the direction that is up in most photos, roughly that of the plant; None where these do not agree."""
    mean = -cameras.R[:, 1].mean(0).cpu().numpy()
    return mean / np.linalg.norm(mean) if np.linalg.norm(mean) > UPRIGHT else None


def up_of_stem(stems: Sequence[Stem], surfaces: Mapping[int, LeafSurface], cameras: Cameras) -> Floats | None:
    """(3,) the direction in which the only stem of a plant grows, as long as a leaf or longer, and upwards in the
    photos, if masks or photos show it (`Stem.tells_up`); None without one."""
    upward = find_upward(cameras)
    if len(stems) != 1 or upward is None or not stems[0].tells_up:
        return None
    first, last = stems[0].axis.points[[0, -1]]
    length = float(np.linalg.norm(last - first))
    if length < LEAST_STEM * np.median([surface.length for surface in surfaces.values()]):
        return None
    return (last - first) / length if _rises(stems[0].axis, upward) else None


def _rises(axis: StemAxis, up: Floats) -> bool:
    first, last = axis.points[[0, -1]]
    return bool(2 * ((last - first) @ up) ** 2 > ((last - first) ** 2).sum() and (last - first) @ up > 0)


@dataclass(frozen=True, eq=False)
class SeenPlant:
    """Thin parts of a plant: `cells` that `views` of `see_thin` agree about; `leaves` are (P, 3) points by id."""

    views: tuple[ThinView, ...]
    cells: ThinCells
    leaves: Mapping[int, Floats]

    def axis_chance(self, points: Floats) -> tuple[float, float]:
        """How likely an axis (P, 3) that leaves sit on is a stem, and the share of it that enough views see. Views show
        an axis if they show most of its points, or what is within two cells of these, as thin."""
        shares = share_of_views(self.views, points, 3 * self.cells.size)
        is_seen = np.isfinite(shares)
        shown = float(np.quantile(shares[is_seen], FAINTEST)) if is_seen.any() else THIN_SHARE
        return float(expit(PRIOR + SLOPE * is_seen.mean() * (shown - THIN_SHARE))), float(is_seen.mean())


def see_plant(surfaces: Mapping[int, LeafSurface], masks: Masks, cameras: Cameras, *, photos: Photos) -> SeenPlant:
    """Look for thin parts around the leaves, in some of the photos."""
    leaves = {leaf: surface.points(*LEAF_GRID).reshape(-1, 3).numpy() for leaf, surface in surfaces.items()}
    points = np.concatenate(list(leaves.values()))
    cameras = cameras.to("cpu")
    px_from_world = cameras.px_from_world.numpy()
    views = []
    for view in spread_views(cameras, MOST_VIEWS).tolist():
        is_leaf = masks.regions.label_map(view, masks.instance_ids.clamp(min=0), cameras.sizes[view].tolist()) > 0
        views.append(see_thin(photos(view), is_leaf.cpu().numpy(), px_from_world[view], points))
    axes = np.linalg.svd(points - points.mean(0), full_matrices=False)[2]
    return SeenPlant(tuple(views), find_cells(views, points, axes), leaves)


@dataclass(frozen=True, eq=False)
class MaskAxis:
    """An axis that masks of a stem show; `knows_foot`: it begins where the stem leaves the soil."""

    axis: StemAxis
    knows_foot: bool


def axes_of_masks(stems: Mapping[int, LeafSurface]) -> tuple[MaskAxis, ...]:
    """Axes of the surfaces of stems, by instance id. Masks that were drawn for each internode are one stem: those of
    which an end meets another one's. Warns (InputWarning) of masks that hold the pot, too: the foot of such a stem is
    not known."""
    axes, joined = {stem: StemAxis.of_surface(surface) for stem, surface in stems.items() if surface.exists}, []
    for ids in _join_ends(axes):
        axis = _chain([axes[stem] for stem in ids])
        if has_pot := _is_wider_at_an_end(axis):
            warn(Finding("stem_with_pot", values={"stem": ids[0]}))
        joined.append(MaskAxis(axis, knows_foot=not has_pot))
    return tuple(joined)


def _chain(axes: Sequence[StemAxis]) -> StemAxis:
    """One axis of several that continue each other, along the direction of the whole; where two overlap, the lower."""
    middles = np.array([axis.points.mean(0) for axis in axes])
    ahead = np.linalg.svd(np.concatenate([axis.points for axis in axes]) - middles.mean(0), full_matrices=False)[2][0]
    ordered = [axes[index] for index in np.argsort(middles @ ahead)]
    points, radius, reach = [], [], -np.inf
    for axis in (each if (each.points[-1] - each.points[0]) @ ahead > 0 else each.reverse() for each in ordered):
        is_beyond = axis.points @ ahead > reach
        points.append(axis.points[is_beyond])
        radius.append(axis.radius[is_beyond])
        reach = float((axis.points @ ahead).max())
    return StemAxis(np.concatenate(points), np.concatenate(radius))


def _join_ends(axes: Mapping[int, StemAxis]) -> list[list[int]]:
    """Ids of axes, those in a list that continue each other; each end meets one other end."""
    ends = {(stem, end): axis.points[[-end, end - 1]] for stem, axis in axes.items() for end in (0, 1)}
    thick = {stem: 2 * float(np.median(axis.radius)) for stem, axis in axes.items()}
    pairs = []
    for one, other in combinations(ends, 2):
        (far, near), (beyond, start) = ends[one], ends[other]  # from the far end of the first to that of the other
        ways = np.stack([near - far, beyond - start])
        ways = ways / np.maximum(np.linalg.norm(ways, axis=1, keepdims=True), 1e-12)
        gap = float(np.linalg.norm(start - near))
        is_straight = ways[0] @ ways[1] >= np.cos(np.radians(PARALLEL_DEG))
        if one[0] != other[0] and is_straight and gap <= JOINT * max(thick[one[0]], thick[other[0]]):
            pairs.append((gap, one, other))
    used: set[tuple[int, int]] = set()
    group = {stem: [stem] for stem in axes}
    for _, one, other in sorted(pairs):
        if not {one, other} & used and group[one[0]] is not group[other[0]]:
            used |= {one, other}
            both = group[one[0]] + group[other[0]]
            group |= dict.fromkeys(both, both)
    return [list(each) for each in dict.fromkeys(tuple(sorted(each)) for each in group.values())]


def _is_wider_at_an_end(axis: StemAxis) -> bool:
    first, last = np.array_split(axis.radius, 4)[0], np.array_split(axis.radius, 4)[3]
    return bool(first.max() > WIDER * np.median(last) or last.max() > WIDER * np.median(first))


def _of_masks(
    axes: Sequence[MaskAxis], surfaces: Mapping[int, LeafSurface], frame: Floats | None, upward: Floats | None
) -> tuple[Stem, ...]:
    if not axes:
        return ()
    ends, others = find_ends(surfaces)
    upright = [each.axis.reverse() if _is_reversed(each.axis, upward, ends) else each.axis for each in axes]
    nearer = [choose_ends(ends, others, axis.extend()) for axis in upright]
    gaps = np.array([project_bases(bases, axis.extend())[1] for bases, axis in zip(nearer, upright, strict=True)])
    of_leaf = np.where(gaps.min(0) < AXES.near * float(np.median(ends.lengths)), gaps.argmin(0), -1)
    own = [bases.select(of_leaf == number) for number, bases in enumerate(nearer)]
    ordered = sorted(zip(upright, own, axes, strict=True), key=lambda each: -len(each[1]))
    return tuple(
        measure_stem(axis, bases, frame=frame, source="masks", number=number, knows_foot=each.knows_foot, tells_up=True)
        for number, (axis, bases, each) in enumerate(ordered, start=1)
        if len(bases)
    )


def _is_reversed(axis: StemAxis, upward: Floats | None, leaves: LeafBases) -> bool:
    first, last = axis.points[[0, -1]]
    if upward is not None:
        return bool((last - first) @ upward < 0)
    below, above = (float(np.median(np.linalg.norm(leaves.points - end, axis=1))) for end in (first, last))
    return below < above


def _of_bases(
    axes: Sequence[tuple[BaseAxis, float]], frame: Floats | None, *, tells_up: bool = False
) -> tuple[Stem, ...]:
    measure = partial(measure_stem, frame=frame, source="leaf bases", tells_up=tells_up)
    return tuple(
        measure(each.axis, each.bases, number=number, probability=chance)
        for number, (each, chance) in enumerate(axes, start=1)
    )


def _of_path(
    path: StemPath, surfaces: Mapping[int, LeafSurface], frame: Floats | None, upward: Floats | None, chance: float
) -> tuple[Stem, ...]:
    """The stem of a path, if it has enough leaves; traced petioles tell nodes, else midribs that point back to it."""
    ends, others = find_ends(surfaces)
    rising = (ends.points + others.points).mean(0) / 2 - path.points[0] if upward is None else upward
    line = path.points if (path.points[-1] - path.points[0]) @ rising >= 0 else path.points[::-1]
    axis = StemAxis.along(line)
    traced = petiole_bases(path, surfaces)
    nearer = choose_ends(ends, others, line)
    nearer = nearer.select(~np.isin(nearer.ids, traced.ids))
    _, gap, _ = project_bases(nearer, axis.extend())
    bases = LeafBases.concatenate((traced, nearer.select(gap < AXES.near * np.median(ends.lengths))))
    _, _, along = project_bases(bases, axis.extend())
    num_places = 1 + int((np.diff(np.sort(along)) > 2 * path.cell).sum()) if len(along) else 0
    if len(bases) < LEAF_SHARE * len(surfaces) or num_places < AXES.least_leaves:
        return ()
    return (measure_stem(axis, bases, frame=frame, source="photos", probability=chance),)


def petiole_bases(path: StemPath, surfaces: Mapping[int, LeafSurface]) -> LeafBases:
    """Bases of leaves whose petioles were traced without a long gap: where they join the stem, and their direction."""
    longest = {leaf: np.linalg.norm(np.diff(way, axis=0), axis=1).max(initial=0) for leaf, way in path.petioles.items()}
    ids = [leaf for leaf, step in longest.items() if step <= MOST_GAP * path.cell]
    starts, ahead, near = [], [], []
    for leaf in ids:
        way = path.petioles[leaf]
        middle = surfaces[leaf].points(*LEAF_GRID).reshape(-1, 3).numpy().mean(0)
        along = np.append(0, np.linalg.norm(np.diff(way, axis=0), axis=1).cumsum())
        lever = np.linalg.norm(middle - way[0]) / 4
        begin = np.array([np.interp(min(lever, along[-1]), along, axis) for axis in way.T])
        direction = (begin if along[-1] > lever else middle) - way[0]
        starts.append(way[0])
        ahead.append(direction / max(float(np.linalg.norm(direction)), 1e-300))
        near.append(way[0] + direction)
    points, directions, beside = (np.array(each).reshape(-1, 3) for each in (starts, ahead, near))
    lengths, point_sd = np.array([surfaces[leaf].length for leaf in ids]), np.full(len(ids), path.cell)
    return LeafBases(np.array(ids, np.int64), points, directions, beside, lengths, point_sd, np.zeros(len(ids)))
