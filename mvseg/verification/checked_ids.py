"""Surfaces check the ids: the views choose among given masks, as they do among what a detector proposes.

Rays and epipolar lines know nothing of shape. A surface that is fitted to an instance's masks in all views says what
each view must show of it. So the instances of given masks are candidates, and those that the matcher finds once more
(`match_again.py`), and `choose` asks which masks show them. Given masks count as proposals with a detection score of
`CHOICE.given`. A mask keeps its id unless another leaf takes it with a q of `SURE` or more, and no mask of its view
stays with that leaf. Not in the paper.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from mvseg.masks import SURE, Masks
from mvseg.matching.config import MatchConfig
from mvseg.reconstruction.surface.leaf_surface import LeafSurface
from mvseg.reconstruction.surface.surface_cache import SurfaceCache
from mvseg.scene import Cameras
from mvseg.verification.choice import choose
from mvseg.verification.choose import gather_candidates
from mvseg.verification.evidence import Bools, Drawn, Floats, Ints, draw_views, see
from mvseg.verification.leaf_scores import Candidates, show_chances
from mvseg.verification.match_again import match_again
from mvseg.verification.numbers import AGAIN, CHOICE


def check_ids(
    masks: Masks,
    surfaces: Mapping[int, LeafSurface],
    *,
    cameras: Cameras,
    config: MatchConfig = MatchConfig(),
    cache: SurfaceCache | None = None,
) -> Masks:
    """Move masks to the instances whose surfaces they show.

    These may be instances that are found among the masks that do not show their own. No mask loses its id without
    getting another. With fewer than `AGAIN.least_views` views, masks that are surely matched stay.

    Args:
        masks: D masks. Those that the user corrected or linked keep their id; corrected ones without any may get one.
        surfaces: {instance id: surface} fitted to them, of every instance that has one.
        config: that the masks were matched with.

    Returns:
        The same masks; those that moved have q as their match score. Instances that lost all their masks leave gaps
        between the ids; new ones have the highest.
    """
    cameras, given = cameras.to("cpu"), torch.full((len(masks),), CHOICE.given)
    table = replace(masks.to("cpu"), detection_scores=given)
    ids = table.instance_ids.numpy()
    names = np.unique(ids[ids > 0])
    leaf = np.where(ids > 0, np.searchsorted(names, ids), -1)
    is_held = table.is_corrected | table.is_linked
    if masks.regions.num_views < AGAIN.least_views:
        is_held = is_held | (table.match_scores >= SURE)
    candidates, drawn = _gather([table], surfaces, cameras, is_held=is_held)
    evidence = see(drawn, len(table), candidates.is_credible)
    q = show_chances(candidates, evidence, given.double().numpy())
    own = np.column_stack((q, np.zeros(len(q))))[np.arange(len(q)), leaf]
    if (again := match_again(table, leaf, q=own, cameras=cameras, config=config)) is not None:
        candidates, drawn = _gather([table, again], surfaces, cameras, is_held=is_held, cache=cache)
    is_apart = (table.is_linked & (table.instance_ids < 1)).numpy()  # an edit only says which leaf they do not show
    chosen = choose(candidates, table, drawn=drawn, usable=~is_apart)
    to = np.append(chosen.candidates, -1)[chosen.leaf]
    is_moved = find_moves(leaf, to, table.view_index.numpy(), q=chosen.q)
    leaf = np.where(is_moved, to, leaf)
    names = np.concatenate((names, table.num_instances + 1 + np.arange(len(candidates) - len(names)), [-1]))
    ids = names[leaf]
    scores = torch.from_numpy(np.where(is_moved, chosen.q, table.match_scores.double().numpy())).float()
    checked = replace(
        table,
        instance_ids=torch.from_numpy(ids),
        match_scores=scores,
        detection_scores=masks.detection_scores.cpu(),
    )
    return replace(checked.to(masks.view_index.device), regions=masks.regions)


def _gather(
    tables: Sequence[Masks],
    surfaces: Mapping[int, LeafSurface],
    cameras: Cameras,
    *,
    is_held: Tensor,
    cache: SurfaceCache | None = None,
) -> tuple[Candidates, tuple[Drawn, ...]]:
    """Candidates: the instances of the first table, by id, with their surfaces, then those of the other tables; and V
    views of all. The tables are of the same D masks with other ids."""
    rows = torch.arange(len(tables[0]))
    candidates = gather_candidates(
        [(each, rows) for each in tables], cameras, table=tables[0], is_held=is_held, surfaces=surfaces, cache=cache
    )
    return candidates, draw_views(tables[0].regions, candidates.surfaces, cameras)


def find_moves(leaf: Ints, to: Ints, views: Ints, *, q: Floats) -> Bools:
    """(D,) which masks move: those that show another leaf by `SURE` or more, unless another mask of their view stays
    with that leaf.

    Args:
        leaf: (D,) the candidate that each mask was matched to; -1 for none.
        to: (D,) the candidate that it was chosen for; -1 for none.
        views: (D,) the view of each.
        q: (D,) how likely it shows `to`.
    """
    is_moved = (to >= 0) & (to != leaf) & (q >= SURE)
    is_rival = (views[:, None] == views) & (to[:, None] == leaf)
    while (is_blocked := is_moved & (is_rival & ~is_moved).any(1)).any():
        is_moved &= ~is_blocked
    return is_moved
