"""The views choose: of all proposals, which masks show which leaf.

A detector's score says how much a mask looks like the leaves that it has learned, not whether it is one. Candidates are
the instances that the matcher finds among the sure proposals, and again among many more, each with its surface. The
likeliest leaf comes first and takes its masks; the others are judged by the remaining masks (`leaf_scores.py`). So
duplicates, pieces and masks over two leaves fall by themselves. The paper's excessive set, with surfaces for maps.

Given masks are proposals, too: they are held to the leaf that the matcher found (`Rows.held`), and another leaf takes
them only with a q of `SURE` or more. So no mask loses its id without getting another.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from mvseg.arrays import Bools, Ints
from mvseg.errors import warn
from mvseg.findings.finding import Finding
from mvseg.formats.photos import ReadPhoto
from mvseg.masks import SURE, Masks, Origin
from mvseg.matching.config import MatchConfig
from mvseg.reconstruction.surface.fit_surfaces import fit_surfaces
from mvseg.reconstruction.surface.leaf_surface import LeafSurface
from mvseg.reconstruction.surface.surface_cache import Cache
from mvseg.scene import Cameras
from mvseg.verification.candidates import EDITED, JOINED, Candidates, Key, gather_candidates
from mvseg.verification.choice import Choice, Rows, choose
from mvseg.verification.evidence import Drawn, draw_views, median_parallax, see
from mvseg.verification.leaf_scores import Pairs, show_chances
from mvseg.verification.match_again import match_again
from mvseg.verification.numbers import CHOICE, EVIDENCE


@dataclass(frozen=True, eq=False)
class RejectedCandidate:
    """A candidate that was not chosen: its P, and the masks that would show it, on the CPU, at most one in a view."""

    chance: float
    masks: Masks


@dataclass(frozen=True, eq=False)
class Leaves:
    """Accepted leaves.

    Attributes:
        masks: D' masks on the CPU with ids from 1 on, by view and leaf, the likeliest leaf first; match scores are q.
            At most one mask per leaf and view, except the user's, which may have id -1. Given masks are all there, in
            their order; only those that moved have q as their match score.
        surfaces: {instance id: surface}, the credible ones.
        probabilities: {instance id: P}.
        rejected: the most likely first.
        keys: {instance id: key of its candidate}.
        agreement: share of a leaf's expected area that its masks show; mean over leaves with a surface, NaN without
            any. Pieces of leaves, whose ids mix, have little.
    """

    masks: Masks
    surfaces: dict[int, LeafSurface]
    probabilities: dict[int, float]
    rejected: tuple[RejectedCandidate, ...]
    keys: dict[int, Key]
    agreement: float = float("nan")


@dataclass(frozen=True, eq=False)
class Edited:
    """Masks after edits.

    Attributes:
        masks: D' masks, matched again.
        keys: D', the candidate that each mask's leaf was before, None without one, and where edits change the leaf.
        stays: (D',) bool, masks of leaves that edits mention, but do not change.
        gone: (N,) int64, proposals that the user took away or changed.
        apart: (Q, 2) int64, pairs of the D' masks that show different leaves, as the user says.
    """

    masks: Masks
    keys: tuple[Key | None, ...]
    stays: Tensor
    gone: Tensor
    apart: Tensor

    @property
    def is_held(self) -> Tensor:
        """(D',) bool: an edit is about the mask, or it follows from one."""
        return self.masks.is_edited | (self.masks.origin == Origin.OTHER_VIEWS)

    @property
    def is_certain(self) -> Tensor:
        """(D',) bool: held masks, except those of which edits only say which leaf they do not show."""
        masks = self.masks
        return self.is_held & ~(masks.is_linked & ~masks.is_corrected & (masks.instance_ids < 1))

    def concerned(self) -> Masks:
        """The masks with the ids of the instances that edits change."""
        ids = self.masks.instance_ids
        is_changed = torch.isin(ids, ids[self.is_held & ~self.stays]) & ~self.stays
        return replace(self.masks, instance_ids=ids.where(is_changed, -1))


@dataclass(frozen=True, eq=False)
class Judges:
    """Means to judge candidates by.

    Attributes:
        cameras: V cameras, on the CPU.
        has_surfaces: whether surfaces judge; otherwise matching and scores do.
        holds: whether masks are held to what they were matched to: given masks.
        photos: of the views, for the colours of candidates; None: they do not count.
        min_probability: P from which a candidate is a leaf; None: where the expected F1 is largest (`least_chance`).
        cache: of surfaces.
    """

    cameras: Cameras
    has_surfaces: bool = True
    holds: bool = False
    photos: ReadPhoto | None = None
    min_probability: float | None = None
    cache: Cache | None = None

    def fit(self, masks: Masks) -> Mapping[int, LeafSurface]:
        """{instance id: surface}. Those of given masks are few, and final; others are fitted roughly."""
        if self.holds:
            return fit_surfaces(masks.regions, masks.instance_ids, self.cameras, cache=self.cache)
        return fit_roughly(masks, self.cameras, self.cache)


def fit_roughly(masks: Masks, cameras: Cameras, cache: Cache | None) -> dict[int, LeafSurface]:
    """{instance id: surface}, fitted to few views."""
    regions, ids = masks.regions, masks.instance_ids
    return fit_surfaces(regions, ids, cameras, most_views=EVIDENCE.rough_views, is_rough=True, cache=cache)


def find_again(matched: Masks, judges: Judges, config: MatchConfig) -> Masks | None:
    """Match given masks (all proposals), matched with `config`, once more where they do not show their own leaf."""
    if not judges.has_surfaces or not matched.num_instances:
        return None
    cameras, candidates = judges.cameras, gather_candidates({"matched": matched}, matched, judges.fit)
    drawn, own = draw_views(matched.regions, candidates.surfaces, cameras), candidates.of_rows("matched")
    evidence, scores = see(drawn, len(matched), candidates.is_credible), np.full(len(matched), CHOICE.given)
    q = show_chances(Pairs(candidates, evidence, scores))
    own_q = np.column_stack((q, np.zeros(len(q))))[np.arange(len(q)), own]
    return match_again(matched, own, q=own_q, cameras=cameras, config=config)


def choose_leaves(
    proposals: Masks,
    matched: Mapping[str, Masks],
    judges: Judges,
    *,
    edited: Edited | None = None,
) -> Leaves:
    """Choose leaves and their masks from the excessive set.

    Masks that the user corrected or linked are certain: they stay, and their instances are leaves. Overlapping
    proposals are dropped; deleted masks are not proposed again. All other candidates are those without edits: an edit
    about one leaf changes no other, unless they compete for masks. A leaf that satisfies all edits about it keeps its
    candidate.

    Warns (InputWarning) where the cameras see the plant from one side only (`EVIDENCE.least_parallax`): surfaces are
    too uncertain to judge proposals of a detector, and matching and detection scores do it.

    Args:
        proposals: R masks; their ids do not matter.
        matched: {source: table of some of the proposals, matched}; "matched" are the sure ones.
    """
    proposals, matched = proposals.to("cpu"), {name: each.to("cpu") for name, each in matched.items()}
    table, row_of = _add_made(proposals, edited)
    is_judged = judges.has_surfaces and (judges.holds or _is_surrounded(matched["matched"], edited, judges.cameras))
    if edited is not None:  # the first name, so that what edits say of a leaf is not the same as what was there before
        matched |= {EDITED: replace(edited.concerned(), proposal=row_of)}
    candidates = gather_candidates(matched, table, judges.fit if is_judged else None)
    views = draw_views(table.regions, candidates.surfaces, judges.cameras, photos=judges.photos)
    terms = Rows.none(len(table), len(candidates)) if edited is None else _say(edited, candidates, table, row_of, views)
    terms = replace(terms, shows=np.where(find_halves(candidates, views), -np.inf, terms.shows))
    if judges.holds:
        terms = _hold(terms, edited, candidates, table, row_of)
    chosen = choose(candidates, table, drawn=views, rows=terms, min_probability=judges.min_probability)
    if judges.holds:
        return _make_given(chosen, candidates, table, row_of.numpy(), terms)
    is_users = np.zeros(len(table), bool)
    if edited is not None:
        is_users[row_of[edited.is_certain]] = True
    return _make_leaves(chosen, candidates, table, is_users)


def _add_made(proposals: Masks, edited: Edited | None) -> tuple[Masks, Tensor]:
    """The proposals, and after them the masks that edits made; and (D',) the row of each mask of the edited table."""
    if edited is None:
        return proposals, torch.arange(len(proposals))
    masks, made = edited.masks, edited.masks.proposal < 0
    row_of = torch.where(made, len(proposals) - 1 + made.cumsum(0), masks.proposal)
    table = Masks.concatenate((proposals, masks.select(made)))
    origin, is_linked = table.origin.clone(), table.is_linked.clone()
    origin[row_of], is_linked[row_of] = masks.origin, masks.is_linked
    return replace(table, origin=origin, is_linked=is_linked), row_of


def _is_surrounded(matched: Masks, edited: Edited | None, cameras: Cameras) -> bool:
    masks = matched if matched.num_instances or edited is None else edited.masks
    parallax = median_parallax(masks, cameras)
    if parallax < EVIDENCE.least_parallax:
        warn(Finding("leaves_seen_from_one_side", values={"degrees": parallax}))
    return parallax >= EVIDENCE.least_parallax


def find_halves(candidates: Candidates, drawn: Sequence[Drawn]) -> Bools:
    """(K,) the candidates that are part of a joined one, by `CHOICE.same`: it stands for them."""
    is_member, is_joined = (~np.isnan(candidates.matched)).astype(float), candidates.source == JOINED
    shared = np.zeros((len(candidates), len(candidates)))
    for each in drawn:
        own = is_member[each.rows]
        shared += own.T @ (each.masks.T @ each.masks).toarray() @ own
    is_part = (shared >= CHOICE.same * shared.diagonal()[:, None])[:, is_joined].any(1)
    return np.asarray(is_part & ~is_joined & (candidates.source != EDITED))


def _say(edited: Edited, candidates: Candidates, table: Masks, row_of: Tensor, drawn: Sequence[Drawn]) -> Rows:
    """The user as a term."""
    masks, held, stays = edited.masks, edited.is_held.numpy(), edited.stays.numpy()
    shows, rows = np.zeros((len(table), len(candidates))), row_of.numpy()
    changed, is_changed = candidates.of_rows(EDITED), candidates.source == EDITED
    certain = edited.is_certain.numpy()
    for mask in np.flatnonzero(held).tolist():
        key = edited.keys[mask]
        candidate = candidates.place_of.get(key, -1) if stays[mask] and key is not None else int(changed[rows[mask]])
        shows[rows[mask], is_changed] = -np.inf
        if certain[mask] and candidate >= 0:
            shows[rows[mask], candidate] = np.inf
    others = Masks.concatenate((table.select(edited.gone), masks.select(edited.is_held & ~edited.stays)))
    is_out = ~_without(table, others)
    is_out[rows[held]] = False
    is_made = ((table.origin == Origin.CORRECTED) | (table.origin == Origin.CUT)).numpy()
    for each in drawn:
        own = is_made[each.rows]
        is_out[each.rows] |= ~own & each.is_shared[:, own].any(1)
    shows[is_out] = -np.inf
    return replace(Rows.none(*shows.shape), shows=shows, apart=row_of[edited.apart].numpy())


def _hold(terms: Rows, edited: Edited | None, candidates: Candidates, table: Masks, row_of: Tensor) -> Rows:
    """The ids of given masks as a term: those of the matcher, and after edits those before them."""
    held = candidates.of_rows("matched" if edited is None else EDITED)
    if edited is not None:
        before = [-1 if key is None else candidates.place_of.get(key, -1) for key in edited.keys]
        rows = row_of.numpy()
        held[rows] = np.where(held[rows] < 0, before, held[rows])
    hold = np.where(table.origin < Origin.OTHER_VIEWS, SURE, 0.0)
    if table.regions.num_views < EVIDENCE.least_views:  # two masks always agree on some surface
        hold = np.where(candidates.match_scores(np.arange(len(table)), held) >= SURE, 1.0, hold)
    is_gone = np.isneginf(terms.shows).all(1)
    return replace(terms, held=np.where(is_gone, -1, held), hold=hold)


def _without(proposals: Masks, others: Masks) -> Bools:
    """(R,) bool: the proposals that show something else than other masks do, by `EVIDENCE.fits`."""
    stays = np.ones(len(proposals), bool)
    for row in range(len(others)):
        mask = others.regions.placed(row)
        for other in (proposals.view_index == others.view_index[row]).nonzero()[:, 0].tolist():
            stays[other] &= proposals.regions.placed(other).iou(mask) <= EVIDENCE.fits
    return stays


def _number_leaves(chosen: Choice, candidates: Candidates, table: Masks, *, rows: Ints, order: Ints) -> Leaves:
    """Leaves with their masks, some rows of the table, and keys alone: numbered in an order (L,) of the chosen ones."""
    number = np.append(np.argsort(order), -2)
    masks = replace(
        table.select(torch.from_numpy(rows)),
        instance_ids=torch.from_numpy(number[chosen.leaf[rows]] + 1),
        match_scores=torch.from_numpy(chosen.q[rows]).float(),
    )
    keys = {place: candidates.keys[index] for place, index in enumerate(chosen.candidates[order].tolist(), 1)}
    return Leaves(masks, surfaces={}, probabilities={}, rejected=(), keys=keys)


def _make_given(chosen: Choice, candidates: Candidates, table: Masks, rows: Ints, terms: Rows) -> Leaves:
    """Leaves of given masks, numbered in the order of their candidates; those that did not move keep their scores."""
    leaves = _number_leaves(chosen, candidates, table, rows=rows, order=np.argsort(chosen.candidates))
    scores = candidates.match_scores(rows, np.append(chosen.candidates, -1)[chosen.leaf[rows]])
    moves = torch.from_numpy(np.isnan(scores) | terms.certain[rows].any(1))
    match_scores = leaves.masks.match_scores.where(moves, torch.from_numpy(scores).float())
    return replace(leaves, masks=replace(leaves.masks, match_scores=match_scores))


def _make_leaves(chosen: Choice, candidates: Candidates, table: Masks, is_users: Bools) -> Leaves:
    rows: Ints = np.flatnonzero((chosen.leaf >= 0) | is_users)
    rows = rows[np.lexsort((chosen.leaf[rows], table.view_index.numpy()[rows]))]
    surfaces = [candidates.surfaces[each] for each in chosen.candidates.tolist()]
    taken = set(chosen.candidates.tolist())
    accepted = [each for each in chosen.steps if each.candidate in taken]
    shares = [each.coverage for each in accepted if candidates.has_surface[each.candidate]]
    return replace(
        _number_leaves(chosen, candidates, table, rows=rows, order=np.arange(len(chosen.candidates))),
        surfaces={number: each for number, each in enumerate(surfaces, 1) if each is not None and each.is_credible},
        probabilities=dict(enumerate(chosen.chances.tolist(), 1)),
        rejected=tuple(
            RejectedCandidate(each.chance, table.select(torch.from_numpy(each.rows)))
            for each in chosen.steps
            if each.candidate not in taken and len(each.rows)
        ),
        agreement=float(np.round(np.mean(shares), CHOICE.digits)) if shares else float("nan"),
    )


def add_beside(masks: Masks, others: Masks, cameras: Cameras) -> Masks:
    """The masks, and after them the others that show something else than these (`EVIDENCE.shared`); by view."""
    both = Masks.concatenate((masks, others))
    is_added = torch.ones(len(both), dtype=torch.bool)
    for each in draw_views(both.regions, (), cameras.to("cpu")):
        is_first = each.rows < len(masks)
        is_added[each.rows] = torch.from_numpy(is_first | ~each.is_shared[:, is_first].any(1))
    kept = both.select(is_added)
    return kept.select(kept.view_index.argsort(stable=True))
