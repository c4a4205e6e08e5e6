"""Do all views share one world frame? Finds groups of views that agree among themselves only, by the masks.

Views from two separate calibrations may have two scales or two sets of axes. Each view then agrees with its group, so
that no single view stands out; between the groups, masks fit only by chance.
"""

from __future__ import annotations

from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from mvseg.arrays import Floats
from mvseg.checks.numbers import AGREEMENT
from mvseg.checks.poses import PoseAgreement, is_sure, view_agreement
from mvseg.findings.finding import Finding, Level, list_findings


def world_groups(pairs: PoseAgreement) -> tuple[tuple[int, ...], ...]:
    """Groups of two or more views that agree within themselves and not with each other, the largest first. Views that
    agree with none, or have no masks to compare, are in no group. There is a single group where all agree, and none
    where most views agree with none."""
    views = view_agreement(pairs)
    if not views.agree:
        return ()
    members = np.array([view for view in np.flatnonzero(~np.isnan(views.fitting)) if view not in views.off], int)
    return tuple(sorted(_split(pairs, members), key=lambda group: (-len(group), group)))


def group_findings(pairs: PoseAgreement, names: tuple[str, ...]) -> list[Finding]:
    """One finding for each group that the V views, named, fall into, but for the largest; none for one world."""
    groups = world_groups(pairs)
    if len(groups) < 2:
        return []
    members = [np.array(group) for group in groups]
    within = np.concatenate([_upper(pairs.fitting, group) for group in members])
    between = np.concatenate([_block(pairs.fitting, one, other) for one, other in combinations(members, 2)])
    shares = {"within": float(np.nanmean(within)), "between": float(np.nanmean(between))}
    level: Level = "error" if is_sure(pairs) else "warning"
    return list_findings([("separate_worlds", level, group, shares) for group in groups[1:]], names)


def _split(pairs: PoseAgreement, members: NDArray[np.int64]) -> list[tuple[int, ...]]:
    if len(members) >= 2 * AGREEMENT.smallest:
        order = members[_order(pairs, members)]
        cuts = [(order[:cut], order[cut:]) for cut in range(AGREEMENT.smallest, len(order) - AGREEMENT.smallest + 1)]
        one, other = min(cuts, key=lambda cut: _contrast(pairs, *cut))
        if _contrast(pairs, one, other) < AGREEMENT.apart and _is_off(pairs, one, other):
            return [*_split(pairs, np.sort(one)), *_split(pairs, np.sort(other))]
    return [tuple(members.tolist())]


def _order(pairs: PoseAgreement, members: NDArray[np.int64]) -> NDArray[np.int64]:
    """Order members so that those that agree are neighbours, by the Fiedler vector (Shi and Malik 2000)."""
    weight = np.nan_to_num(pairs.fitting[np.ix_(members, members)]).clip(AGREEMENT.chance / 10)
    np.fill_diagonal(weight, 0)
    root = np.sqrt(weight.sum(1))
    second = np.linalg.eigh(np.eye(len(members)) - weight / np.outer(root, root))[1][:, 1]
    return np.argsort(second / root, kind="stable")


def _contrast(pairs: PoseAgreement, one: NDArray[np.int64], other: NDArray[np.int64]) -> float:
    """Share of the masks that fit between two groups over the share within them, corrected for chance; 1 if unknown."""
    between = _block(pairs.fitting, one, other)
    within = np.concatenate((_upper(pairs.fitting, one), _upper(pairs.fitting, other)))
    if np.isnan(between).all() or np.isnan(within).all():
        return 1.0
    chance = AGREEMENT.chance
    return max(float(np.nanmean(between)) - chance, 0.0) / max(float(np.nanmean(within)) - chance, chance)


def _is_off(pairs: PoseAgreement, one: NDArray[np.int64], other: NDArray[np.int64]) -> bool:
    of_groups = [_upper(pairs.offset, one), _upper(pairs.offset, other)]
    within = [np.nanmedian(offsets) for offsets in of_groups if not np.isnan(offsets).all()]
    return bool(np.nanmedian(_block(pairs.offset, one, other)) >= AGREEMENT.offset > min(within))


def _block(values: Floats, one: NDArray[np.int64], other: NDArray[np.int64]) -> Floats:
    return np.asarray(values[np.ix_(one, other)].ravel())


def _upper(values: Floats, members: NDArray[np.int64]) -> Floats:
    return np.asarray(values[np.ix_(members, members)][np.triu_indices(len(members), 1)])
