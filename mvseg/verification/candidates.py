"""Candidates: sets of proposals that may be one leaf, each with its surface and a key of its own."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mvseg.arrays import Bools, Floats, Ints
from mvseg.masks import Masks
from mvseg.reconstruction.stem.slenderness import stem_chances
from mvseg.reconstruction.surface.leaf_surface import LeafSurface
from mvseg.verification.numbers import CHOICE

EDITED, JOINED = "edited", "joined"  # definition: sources of candidates: edits made them, or two halves
Fit = Callable[[Masks], Mapping[int, LeafSurface]]
Key = tuple[int, ...]  # of a candidate: the rows of its masks, which never move in the table of proposals


@dataclass(frozen=True, eq=False)
class Candidates:
    """K candidates.

    Attributes:
        surfaces: K, None where the masks of one agree on none.
        matched: (D, K) match score of each mask that the matcher gave to the candidate, NaN for the others.
        stem: (K,) probability that it is a stem, see `stem_chances`; 0 without a surface.
        source: (K,) str, name of the matching that it comes from.
    """

    surfaces: tuple[LeafSurface | None, ...]
    matched: Floats
    stem: Floats
    source: NDArray[np.str_]

    def __len__(self) -> int:
        return len(self.surfaces)

    @cached_property
    def keys(self) -> tuple[Key, ...]:
        """K names, which do not depend on any other candidate."""
        return tuple(tuple(np.flatnonzero(column).tolist()) for column in ~np.isnan(self.matched.T))

    @cached_property
    def place_of(self) -> dict[Key, int]:
        """{key: index}."""
        return {key: index for index, key in enumerate(self.keys)}

    def match_scores(self, rows: Ints, of: Ints) -> Floats:
        """(N,) match score of N masks, by their rows, for a candidate each; NaN where the matcher gave none."""
        return np.asarray(np.append(self.matched, np.full((len(self.matched), 1), np.nan), 1)[rows, of])

    @cached_property
    def has_surface(self) -> Bools:
        """(K,) bool."""
        return np.array([each is not None for each in self.surfaces], bool)

    @cached_property
    def is_credible(self) -> Bools:
        """(K,) those whose surface may hide others."""
        return np.array([each is not None and each.is_credible for each in self.surfaces], bool)

    @cached_property
    def lengths(self) -> Floats:
        """(K,) lengths of the surfaces, world units; NaN for none."""
        return np.array([np.nan if each is None else each.length for each in self.surfaces], float)

    @cached_property
    def fits(self) -> Floats:
        """(K,) median IoU of the surfaces with the masks that they were fitted to; 0.5 for none."""
        return np.array([0.5 if each is None else float(each.iou.nanmedian()) for each in self.surfaces], float)

    def of_rows(self, source: str) -> Ints:
        """(D,) the candidate of one matching that has each mask, -1 for none."""
        own = np.full(len(self.matched), -1)
        for index in np.flatnonzero(self.source == source).tolist():
            own[~np.isnan(self.matched[:, index])] = index
        return own


def gather_candidates(matched: Mapping[str, Masks], table: Masks, fit: Fit | None) -> Candidates:
    """The instances of each matching, once each: of two that are nearly the same (`CHOICE.same`) the first one stays,
    by the name of its source.

    Args:
        matched: {source: masks}; their `proposal` is their row in the `table`.
        fit: {instance id: surface} to instances of masks; None: no surfaces.
    """
    areas = table.regions.areas.double()
    shapes: list[LeafSurface | None] = []
    members: list[Tensor] = []  # rows of the table, of each candidate
    source = list[str]()
    scores = np.full((len(table), sum(each.num_instances for each in matched.values())), np.nan)
    for name, masks in sorted(matched.items()):
        ids, rows = masks.instance_ids, masks.proposal
        new = [each for each in ids[ids > 0].unique().tolist() if not _is_there(rows[ids == each], members, areas)]
        is_new = torch.isin(ids, torch.tensor(new, dtype=torch.int64))
        fitted = {} if fit is None else fit(replace(masks, instance_ids=ids.where(is_new, -1)))
        for each in new:
            surface = fitted.get(each)
            shapes.append(surface if surface is not None and surface.exists else None)
            members.append(rows[ids == each])
            scores[members[-1].numpy(), len(source)] = masks.match_scores[ids == each]
            source.append(name)
    chances = stem_chances({number: each for number, each in enumerate(shapes) if each is not None})
    stem = np.array([chances.get(number, 0.0) for number in range(len(shapes))])
    return Candidates(tuple(shapes), scores[:, : len(source)], stem, np.array(source, str))


def _is_there(rows: Tensor, members: Sequence[Tensor], areas: Tensor) -> bool:
    for others in members:
        common, either = areas[rows[torch.isin(rows, others)]].sum(), areas[torch.cat((rows, others)).unique()].sum()
        if common > CHOICE.same * either:
            return True
    return False
