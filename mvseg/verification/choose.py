"""The views choose: of everything that the detector proposes, which masks show which leaf.

A detector's score says how much a mask looks like the leaves that it has learned, not whether it is one. So the
excessive set is kept, weak proposals included, and the views decide. Candidates are the instances that the matcher
finds among the sure proposals, and again among many more, each with its surface. The likeliest leaf comes first and
takes its masks; the others are judged by what is left (`leaf_scores.py`). So duplicates, pieces and masks over two
leaves fall by themselves. The paper's idea of an excessive set from which the views choose, with surfaces for maps.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from mvseg.errors import warn
from mvseg.findings.finding import Finding
from mvseg.masks import Masks, Origin
from mvseg.reconstruction.numbers import TUBE
from mvseg.reconstruction.stem.tube_evidence import tube_evidence
from mvseg.reconstruction.surface.leaf_surface import LeafSurface
from mvseg.reconstruction.surface.surface_cache import SurfaceCache
from mvseg.regions import Regions
from mvseg.scene import Cameras
from mvseg.verification.choice import Choice, Statements, choose
from mvseg.verification.evidence import Bools, Drawn, Floats, draw_views
from mvseg.verification.leaf_scores import Candidates
from mvseg.verification.numbers import CHOICE, EVIDENCE, ROUGH
from mvseg.verification.rough_surfaces import fit_roughly, median_parallax


@dataclass(frozen=True, eq=False)
class RejectedCandidate:
    """A candidate that was not chosen: its P, and the masks that would show it, on the CPU, at most one in a view."""

    chance: float
    masks: Masks


@dataclass(frozen=True, eq=False)
class Leaves:
    """Accepted leaves.

    Attributes:
        masks: D' masks on the CPU, by view and instance, with ids from 1 on, the likeliest leaf first; match scores are
            q, and `labels` of proposals their rows. At most one of each leaf in a view, but for those of the user;
            of these, the ones that show no leaf have -1.
        surfaces: {instance id: surface} of those with a credible one.
        probabilities: {instance id: P}.
        rejected: the candidates that were not chosen, the most likely first.
        agreement: share of a leaf's expected area that its masks show; mean over the leaves that have
            a surface, NaN without any. Pieces of leaves, whose ids mix, have little.
    """

    masks: Masks
    surfaces: dict[int, LeafSurface]
    probabilities: dict[int, float]
    rejected: tuple[RejectedCandidate, ...]
    agreement: float = float("nan")


def choose_leaves(
    matched: Masks,
    proposals: Masks,
    *,
    cameras: Cameras,
    more: Sequence[Masks] = (),
    removed: Masks | None = None,
    previous: Tensor | None = None,
    apart: Tensor | None = None,
    drawn: Sequence[Drawn] = (),
    min_probability: float | None = None,
    cache: SurfaceCache | None = None,
) -> Leaves:
    """Choose leaves and their masks from the excessive set.

    Masks that the user corrected or linked are certain: they stay, with their instances, which are leaves; so are masks
    that no detector found. What else lies there goes, and what the user took away does not come back. All other
    candidates are those without edits: an edit about one leaf changes no other, unless they compete for masks. A leaf
    that satisfies all edits about it already keeps its candidate from before the edits.

    Args:
        matched: D masks, matched; `labels` of detected ones are rows of `proposals`.
        proposals: R masks with detection scores, the excessive set; their ids do not matter.
        more: masks of other matchings, of more of the proposals, with such labels, too.
        removed: masks that the user took away; None: nobody edited the masks. Otherwise only the instances of the
            user's masks are candidates here, and `more` has the others.
        previous: (D,) int64, the leaf of each mask before the edits, if they leave that leaf unchanged; otherwise -1.
            None: -1 everywhere.
        apart: (Q, 2) int64, pairs of the D masks that show different leaves, as the user says; None: none do.
        drawn: V views of the proposals alone, where they were drawn before.
        min_probability: P from which a candidate is a leaf; None: where the expected F1 is largest (`least_chance`).

    Returns:
        The leaves. Where the cameras see the plant from one side only, by less than `ROUGH.least_parallax`, surfaces
        are too uncertain to judge by: matching and detection scores do it, and a warning (InputWarning) says so.
    """
    matched, proposals, cameras = matched.to("cpu"), proposals.to("cpu"), cameras.to("cpu")
    proposals = replace(proposals, regions=replace(proposals.regions, labels=torch.arange(len(proposals))))
    previous = torch.full_like(matched.instance_ids, -1) if previous is None else previous.cpu()
    ids, origin, stays = matched.instance_ids, matched.origin, previous > 0
    is_held = matched.is_corrected | matched.is_linked | (origin == Origin.OTHER_VIEWS) | (origin == Origin.GIVEN)
    is_apart = matched.is_linked & ~matched.is_corrected & (ids < 1)  # an edit only says which leaf it does not show
    is_sure = is_held & ~is_apart
    is_added = ~_are_proposals(matched, proposals) | (is_held & ~stays)  # the user's, and what was cut since
    added = matched.select(is_added)
    row_of = matched.regions.labels.clone()
    row_of[is_added] = len(proposals) + torch.arange(len(added))
    table = _mark(Masks.concatenate((proposals, added)), matched, row_of)
    statements = Statements.of(len(table), row_of.numpy(), is_held=is_held, is_sure=is_sure, leaf=previous)
    usable = np.ones(len(table), bool)
    if removed is not None:
        ids = ids.where(torch.isin(ids, ids[is_held & ~stays]) & ~stays, -1)
        others = Masks.concatenate((removed.to("cpu"), matched.select(is_held & is_added)))
        usable[: len(proposals)] = _without(proposals, others)
    tables = [(replace(matched, instance_ids=ids), row_of)]
    tables += [(each.to("cpu"), each.regions.labels.cpu()) for each in more]
    is_edited = removed is not None and len(more) > 0 and more[0].num_instances > 0  # then `matched` may have few ids
    has_shapes = _is_surrounded(more[0].to("cpu") if is_edited else matched, cameras)
    candidates = gather_candidates(tables, cameras if has_shapes else None, table=table, is_held=is_held, cache=cache)
    views = draw_views(table.regions, candidates.surfaces, cameras, first=drawn)
    is_made = ((table.origin == Origin.CORRECTED) | (table.origin == Origin.CUT)).numpy()
    for each in views:
        own = is_made[each.rows]
        usable[each.rows] &= own | ~each.is_shared[:, own].any(1)
    chosen = choose(
        candidates,
        table,
        drawn=views,
        usable=usable,
        statements=statements,
        apart=None if apart is None else row_of[apart].numpy(),
        min_probability=min_probability,
    )
    return _make_leaves(chosen, candidates, table, is_held=statements.is_sure)


def _mark(table: Masks, matched: Masks, row_of: Tensor) -> Masks:
    """The table with what the user said of the matched masks that are in it."""
    origin, is_linked = table.origin.clone(), table.is_linked.clone()
    origin[row_of], is_linked[row_of] = matched.origin, matched.is_linked
    return replace(table, origin=origin, is_linked=is_linked)


def add_beside(masks: Masks, others: Masks, cameras: Cameras) -> Masks:
    """The masks, and after them the others that show something else than these (`EVIDENCE.shared`); by view."""
    both = Masks.concatenate((masks, others))
    is_added = torch.ones(len(both), dtype=torch.bool)
    for each in draw_views(both.regions, (), cameras.to("cpu")):
        is_first = each.rows < len(masks)
        is_added[each.rows] = torch.from_numpy(is_first | ~each.is_shared[:, is_first].any(1))
    kept = both.select(is_added)
    return kept.select(kept.view_index.argsort(stable=True))


def _are_proposals(matched: Masks, proposals: Masks) -> Tensor:
    labels, regions = matched.regions.labels, proposals.regions
    is_there = (labels >= 0) & (labels < len(proposals))
    for row in is_there.nonzero()[:, 0].tolist():
        label = int(labels[row])
        is_there[row] = torch.equal(matched.regions.boxes[row], regions.boxes[label]) and torch.equal(
            matched.regions.crop(row), regions.crop(label)
        )
    return is_there


def _is_surrounded(matched: Masks, cameras: Cameras) -> bool:
    parallax = median_parallax(matched, cameras)
    if parallax < ROUGH.least_parallax:
        warn(Finding("leaves_seen_from_one_side", values={"degrees": parallax}))
    return parallax >= ROUGH.least_parallax


def _without(proposals: Masks, others: Masks) -> Bools:
    """(R,) bool: the proposals that show something else than other masks do, by `EVIDENCE.fits`."""
    stays = np.ones(len(proposals), bool)
    for row in range(len(others)):
        mask = others.regions.placed(row)
        for other in (proposals.view_index == others.view_index[row]).nonzero()[:, 0].tolist():
            stays[other] &= proposals.regions.placed(other).iou(mask) <= EVIDENCE.fits
    return stays


def gather_candidates(
    matched: Sequence[tuple[Masks, Tensor]],
    cameras: Cameras | None,
    *,
    table: Masks,
    is_held: Tensor,
    surfaces: Mapping[int, LeafSurface] | None = None,
    cache: SurfaceCache | None = None,
) -> Candidates:
    """The instances of each matching; those that an earlier one has, too, once.

    Args:
        matched: masks of each matching and (D,) their rows in the table.
        cameras: that surfaces are fitted with; None: no surfaces.
        table: R' masks.
        is_held: (D,) bool, of the masks of the first matching.
        surfaces: {instance id: surface} of the first matching; None: they are fitted here.
    """
    areas = table.regions.areas.double()
    shapes: list[LeafSurface | None] = []
    members: list[Tensor] = []  # rows of the table, of each candidate
    columns, certain = [], []
    for number, (masks, rows) in enumerate(matched):
        ids = masks.instance_ids
        instances = ids[ids > 0].unique().tolist()
        new = [each for each in instances if not _is_there(rows[ids == each], members, areas)]
        is_new = torch.isin(ids, torch.tensor(new, dtype=torch.int64))
        fitted: Mapping[int, LeafSurface] = {}
        if number == 0 and surfaces is not None:
            fitted = surfaces
        elif cameras is not None:
            fitted = fit_roughly(replace(masks, instance_ids=ids.where(is_new, -1)), cameras, cache)
        for each in new:
            own = ids == each
            members.append(rows[own])
            surface = fitted.get(each)
            shapes.append(surface if surface is not None and surface.exists else None)
            columns.append(torch.full((len(table),), torch.nan, dtype=torch.float64))
            columns[-1][rows[own]] = masks.match_scores[own].double()
            certain.append(torch.zeros(len(table), dtype=torch.bool))
            if number == 0:
                certain[-1][rows[own & is_held]] = True
    if not columns:
        nothing = np.zeros((len(table), 0))
        return Candidates((), nothing, nothing.astype(bool), stem=np.zeros(0))
    stem = np.zeros(len(shapes)) if cameras is None else _stem_chances(shapes, members, table.regions, cameras)
    return Candidates(tuple(shapes), torch.stack(columns, 1).numpy(), torch.stack(certain, 1).numpy(), stem=stem)


def _stem_chances(
    surfaces: Sequence[LeafSurface | None], members: Sequence[Tensor], regions: Regions, cameras: Cameras
) -> Floats:
    ids = torch.cat([torch.full((len(rows),), number) for number, rows in enumerate(members, start=1)])
    tubes = tube_evidence(
        regions.select(torch.cat(list(members))),
        ids,
        cameras,
        surfaces={number: each for number, each in enumerate(surfaces, start=1) if each is not None},
        least_aspect=TUBE.least_aspect,
    )
    stem = np.zeros(len(surfaces))
    for number, evidence in tubes.items():
        stem[number - 1] = evidence.probability
    return stem


def _is_there(rows: Tensor, members: Sequence[Tensor], areas: Tensor) -> bool:
    for others in members:
        common, either = areas[rows[torch.isin(rows, others)]].sum(), areas[torch.cat((rows, others)).unique()].sum()
        if common > CHOICE.same * either:
            return True
    return False


def _make_leaves(chosen: Choice, candidates: Candidates, table: Masks, *, is_held: Bools) -> Leaves:
    rows = np.flatnonzero((chosen.leaf >= 0) | is_held)
    rows = rows[np.lexsort((chosen.leaf[rows], table.view_index.numpy()[rows]))]
    ids = np.where(chosen.leaf[rows] >= 0, chosen.leaf[rows] + 1, -1)
    masks = replace(
        table.select(torch.from_numpy(rows)),
        instance_ids=torch.from_numpy(ids),
        match_scores=torch.from_numpy(chosen.q[rows]).float(),
    )
    surfaces = [candidates.surfaces[each] for each in chosen.candidates.tolist()]
    taken = set(chosen.candidates.tolist())
    accepted = [each for each in chosen.steps if each.candidate in taken]
    shares = [each.shown_share for each in accepted if candidates.has_surface[each.candidate]]
    return Leaves(
        masks=masks,
        surfaces={number: each for number, each in enumerate(surfaces, 1) if each is not None and each.is_credible},
        probabilities=dict(enumerate(chosen.chances.tolist(), 1)),
        rejected=tuple(
            RejectedCandidate(each.chance, table.select(torch.from_numpy(each.rows)))
            for each in chosen.steps
            if each.candidate not in taken and len(each.rows)
        ),
        agreement=float(np.round(np.mean(shares), CHOICE.digits)) if shares else float("nan"),
    )
