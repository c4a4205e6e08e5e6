"""Stems of a plant, from the bases of its leaves and from thin parts in its photos."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
import torch

from mvseg.arrays import Floats
from mvseg.errors import warn
from mvseg.findings.finding import Finding
from mvseg.formats.photos import Photos
from mvseg.masks import Masks
from mvseg.reconstruction.numbers import AXES, TUBE
from mvseg.reconstruction.spread_views import spread_views
from mvseg.reconstruction.stem.fit_tube import apparent_widths, fit_tube, midrib_of
from mvseg.reconstruction.stem.leaf_bases import (
    BaseAxis,
    LeafBases,
    axes_of_bases,
    choose_ends,
    curve_of,
    find_ends,
    project_bases,
)
from mvseg.reconstruction.stem.stem_path import StemPath, find_path
from mvseg.reconstruction.stem.thin_parts import ThinCells, ThinView, find_cells, see_thin, share_of_views
from mvseg.reconstruction.stem.tube import Tube
from mvseg.reconstruction.surface.fit_surfaces import instance_frames, stack_instance
from mvseg.reconstruction.surface.leaf_surface import LeafSurface
from mvseg.reconstruction.surface.mask_errors import learn_mask_errors
from mvseg.scene import Cameras
from mvseg.traits.nodes import Stem, measure_stem

MOST_VIEWS = 20  # limit: photos in which thin parts are looked for
LEAF_GRID = (24, 7)  # limit: points of a leaf from which its petiole may begin
MOST_GAP = 8.5  # chosen: longest step in a petiole that was traced, in cells
SUPPORTED = 0.5  # chosen: min. share of the views that show the axis of leaf bases as thin, where photos exist
LEAF_SHARE = 0.5  # chosen: min. leaves that sit on a path, of all
UPRIGHT = 0.3  # chosen: length of the mean of the directions that are up in the photos, for them to agree
FAINTEST = 0.25  # chosen: part of an axis that views need not show
LEAST_SEEN = 0.3  # chosen: min. part of an axis that enough views see
UP_LEAVES = 0.8  # chosen: min. share of the leaves on the axis that tells up; two stems in one pot have 0.64
UP_SEEN = 0.8  # chosen: min. part of that axis that enough views see
PARALLEL_DEG = 45.0  # chosen: max. bend where two masks of one stem join
JOINT = 2.0  # chosen: max. gap there, in diameters
WIDER = 3.0  # chosen: width of an end of a stem, in its usual width, from which the mask holds the pot, too
LEAST_STEM = 1.0  # chosen: length of a stem that shows up, in leaves; shorter ones of seedlings lean by 20 degrees


def find_stems(
    surfaces: Mapping[int, LeafSurface],
    masks: Masks,
    cameras: Cameras,
    *,
    frame: Floats | None,
    photos: Photos,
    tubes: Sequence[StemTube] = (),
) -> tuple[Stem, ...]:
    """Find the stems that the leaves of a plant sit on, that of the most leaves first, and their nodes.

    Masks that show stems tell best. Otherwise leaves point back to them; where photos exist, these must show something
    thin there. Where leaves point to no stem, as those that are wider than long, the cheapest path through thin parts
    between them is one. There is none where leaves and views do not agree about one.

    Args:
        surfaces: {instance id: credible surface} of leaves.
        frame: (3, 3) rows east, north, up; None: up is not known.
        tubes: fitted to masks of stems, see `join_tubes`.
    """
    if not surfaces:
        return ()
    upward = find_upward(cameras) if frame is None else frame[2]
    if tubes and (found := _of_tubes(tubes, surfaces, frame, upward)):
        return found
    axes = axes_of_bases(surfaces, upward)
    if frame is not None:
        axes = tuple(axis for axis in axes if _rises(axis.tube, frame[2]))
    if not photos.exist:
        return _of_bases(axes, frame)
    plant = see_plant(surfaces, masks, cameras, photos=photos)
    supported = tuple(axis for axis in axes if plant.support(axis.tube.points()) >= SUPPORTED)
    carried = sum(int(axis.is_near.sum()) for axis in supported) / len(surfaces)
    if supported and carried >= AXES.near_share:  # else what is left of several axes may stand in free air
        is_seen = np.isfinite(share_of_views(plant.views, axes[0].tube.points(), 3 * plant.cells.size))
        tells_up = len(axes) == 1 and carried >= UP_LEAVES and is_seen.mean() >= UP_SEEN
        return _of_bases(supported, frame, tells_up=tells_up)
    path = find_path(plant.cells, plant.leaves)
    if path is None or plant.support(path.points) < SUPPORTED:
        return ()
    stems = _of_path(path, surfaces, frame, upward)
    return stems if upward is None else tuple(stem for stem in stems if _rises(stem.tube, upward))


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
    first, last = stems[0].tube.points()[[0, -1]]
    length = float(np.linalg.norm(last - first))
    if length < LEAST_STEM * np.median([surface.length for surface in surfaces.values()]):
        return None
    return (last - first) / length if _rises(stems[0].tube, upward) else None


def _rises(tube: Tube, up: Floats) -> bool:
    first, last = tube.points()[[0, -1]]
    return bool(2 * ((last - first) @ up) ** 2 > ((last - first) ** 2).sum() and (last - first) @ up > 0)


@dataclass(frozen=True, eq=False)
class SeenPlant:
    """Thin parts of a plant: `cells` that `views` of `see_thin` agree about; `leaves` are (P, 3) points by id."""

    views: tuple[ThinView, ...]
    cells: ThinCells
    leaves: Mapping[int, Floats]

    def support(self, points: Floats) -> float:
        """How far the views show an axis (P, 3) as thin: the share of them that show most of its points so, or what is
        within two cells of these; 0 where they hardly see any of it."""
        shares = share_of_views(self.views, points, 3 * self.cells.size)
        is_seen = np.isfinite(shares)
        return float(np.quantile(shares[is_seen], FAINTEST)) if is_seen.mean() > LEAST_SEEN else 0.0


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
class StemTube:
    """A tube that masks of a stem show; `knows_foot`: it begins where the stem leaves the soil."""

    tube: Tube
    knows_foot: bool


def fit_tubes(
    stems: Collection[int], surfaces: Mapping[int, LeafSurface], masks: Masks, cameras: Cameras
) -> dict[int, Tube]:
    """{instance id: tube} of those stems, by id, whose masks show one in two views or more."""
    regions, ids, cameras, tubes = masks.regions.to("cpu"), masks.instance_ids.cpu(), cameras.to("cpu"), {}
    frames = instance_frames(regions, ids, cameras) if stems else []
    offsets = [each.offsets_px[each.offsets_px.isfinite()].numpy() for each in surfaces.values() if each.exists]
    errors = learn_mask_errors([each for each in offsets if len(each) > 1])
    for stem in sorted(stems):
        members = regions.select((ids == stem) & (regions.areas > 0))
        views = members.view_index.unique()
        if stem in surfaces and surfaces[stem].exists and len(views) > 1:
            chosen = views[spread_views(cameras[views], TUBE.most_views)]
            members = members.select(torch.isin(members.view_index, chosen))
            stack = stack_instance(members, cameras, frames, instance=stem)
            start = midrib_of(surfaces[stem].coefficients.numpy())
            tubes[stem] = fit_tube(stack, start, mask_sd_px=0.0 if errors is None else errors.sd_px)
    return {stem: tube for stem, tube in tubes.items() if tube.exists}


def join_tubes(tubes: Mapping[int, Tube], masks: Masks, cameras: Cameras) -> tuple[StemTube, ...]:
    """Join the tubes of stems, by instance id. Masks that were drawn for each internode are one stem: those of which an
    end meets another one's are fitted together. Warns (InputWarning) of masks that hold the pot, too: the foot of such
    a stem is not known."""
    regions, cameras, joined = masks.regions.to("cpu"), cameras.to("cpu"), []
    for ids in _join_ends(tubes):
        of_stem = torch.isin(masks.instance_ids.cpu(), torch.tensor(ids)) & (regions.areas > 0)
        whole = torch.where(of_stem, ids[0], masks.instance_ids.cpu())
        members = regions.select(of_stem)
        if len(members.view_index.unique()) < 2:
            continue
        stack = stack_instance(members, cameras, instance_frames(regions, whole, cameras), instance=ids[0])
        fitted = tubes[ids[0]] if len(ids) == 1 else fit_tube(stack)
        if not fitted.exists or (len(ids) > 1 and float(np.median(fitted.iou)) < SUPPORTED):
            joined += [StemTube(tubes[stem], knows_foot=len(ids) == 1) for stem in ids]
            continue
        has_pot = _is_wider_at_an_end(apparent_widths(stack, fitted.axis)[0])
        if has_pot:
            warn(Finding("stem_with_pot", values={"stem": ids[0]}))
        joined.append(StemTube(fitted, knows_foot=not has_pot))
    return tuple(joined)


def _join_ends(tubes: Mapping[int, Tube]) -> list[list[int]]:
    """Ids of tubes, those in a list that continue each other; each end meets one other end."""
    ends = {(stem, end): tube.points()[[-end, end - 1]] for stem, tube in tubes.items() for end in (0, 1)}
    pairs = []
    for one, other in combinations(ends, 2):
        (far, near), (beyond, start) = ends[one], ends[other]  # from the far end of the first to that of the other
        ways = np.stack([near - far, beyond - start])
        ways = ways / np.maximum(np.linalg.norm(ways, axis=1, keepdims=True), 1e-12)
        gap = float(np.linalg.norm(start - near))
        is_straight = ways[0] @ ways[1] >= np.cos(np.radians(PARALLEL_DEG))
        if one[0] != other[0] and is_straight and gap <= JOINT * max(tubes[one[0]].diameter, tubes[other[0]].diameter):
            pairs.append((gap, one, other))
    used: set[tuple[int, int]] = set()
    group = {stem: [stem] for stem in tubes}
    for _, one, other in sorted(pairs):
        if not {one, other} & used and group[one[0]] is not group[other[0]]:
            used |= {one, other}
            both = group[one[0]] + group[other[0]]
            group |= dict.fromkeys(both, both)
    return [list(each) for each in dict.fromkeys(tuple(sorted(each)) for each in group.values())]


def _is_wider_at_an_end(widths: Floats) -> bool:
    """Whether views show a quarter of a stem, from one of its ends on, far wider than the rest; `widths` (S, M)."""
    of_place = np.array([np.nan if np.isnan(each).all() else np.nanmedian(each) for each in widths.T])
    quarter = len(of_place) // 4
    for side in (of_place, of_place[::-1]):
        end, rest = side[:quarter], side[quarter:]
        if np.isfinite(end).any() and np.isfinite(rest).any() and np.nanmax(end) > WIDER * np.nanmedian(rest):
            return True
    return False


def _of_tubes(
    tubes: Sequence[StemTube], surfaces: Mapping[int, LeafSurface], frame: Floats | None, upward: Floats | None
) -> tuple[Stem, ...]:
    ends, others = find_ends(surfaces)
    size = float(np.median(ends.lengths))
    upright = [each.tube.reverse() if _is_reversed(each.tube, upward, ends) else each.tube for each in tubes]
    nearer = [choose_ends(ends, others, curve_of(tube)) for tube in upright]
    gaps = np.array([project_bases(bases, curve_of(tube))[1] for bases, tube in zip(nearer, upright, strict=True)])
    of_leaf = np.where(gaps.min(0) < AXES.near * size, gaps.argmin(0), -1)
    own = [bases.select(of_leaf == number) for number, bases in enumerate(nearer)]
    ordered = sorted(zip(upright, own, tubes, strict=True), key=lambda each: -len(each[1]))
    return tuple(
        measure_stem(tube, bases, frame=frame, source="masks", number=number, knows_foot=each.knows_foot, tells_up=True)
        for number, (tube, bases, each) in enumerate(ordered, start=1)
        if len(bases)
    )


def _is_reversed(tube: Tube, upward: Floats | None, leaves: LeafBases) -> bool:
    first, last = tube.points()[[0, -1]]
    if upward is not None:
        return bool((last - first) @ upward < 0)
    below, above = (float(np.median(np.linalg.norm(leaves.points - end, axis=1))) for end in (first, last))
    return below < above


def _of_bases(axes: tuple[BaseAxis, ...], frame: Floats | None, *, tells_up: bool = False) -> tuple[Stem, ...]:
    source = "leaf bases"
    return tuple(
        measure_stem(
            axis.tube, axis.bases.select(axis.is_near), frame=frame, source=source, number=number, tells_up=tells_up
        )
        for number, axis in enumerate(axes, start=1)
    )


def _of_path(
    path: StemPath, surfaces: Mapping[int, LeafSurface], frame: Floats | None, upward: Floats | None
) -> tuple[Stem, ...]:
    """The stem of a path, if it has enough leaves; traced petioles tell nodes, else midribs that point back to it."""
    ends, others = find_ends(surfaces)
    rising = (ends.points + others.points).mean(0) / 2 - path.points[0] if upward is None else upward
    line = path.points if (path.points[-1] - path.points[0]) @ rising >= 0 else path.points[::-1]
    tube = Tube.along(line)
    traced = petiole_bases(path, surfaces)
    nearer = choose_ends(ends, others, line)
    nearer = nearer.select(~np.isin(nearer.ids, traced.ids))
    _, gap, _ = project_bases(nearer, curve_of(tube))
    bases = LeafBases.join(traced, nearer.select(gap < AXES.near * np.median(ends.lengths)))
    _, _, along = project_bases(bases, curve_of(tube))
    num_places = 1 + int((np.diff(np.sort(along)) > 2 * path.cell).sum()) if len(along) else 0
    if len(bases) < LEAF_SHARE * len(surfaces) or num_places < AXES.least_leaves:
        return ()
    return (measure_stem(tube, bases, frame=frame, source="photos"),)


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
    num = len(ids)
    return LeafBases(
        ids=np.array(ids, np.int64),
        points=np.array(starts).reshape(num, 3),
        ahead=np.array(ahead).reshape(num, 3),
        near=np.array(near).reshape(num, 3),
        lengths=np.array([surfaces[leaf].length for leaf in ids]),
        point_sd=np.full(num, path.cell),
        angle_sd=np.zeros(num),
    )
