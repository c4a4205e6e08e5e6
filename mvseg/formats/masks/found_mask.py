"""What every mask reader returns, and the selection by category."""

from __future__ import annotations

import warnings
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mvseg.errors import InputError, InputWarning
from mvseg.formats.find_views import SHOWN


@dataclass(frozen=True, eq=False)
class FoundMask:
    """One entry of a file of masks.

    Attributes:
        label: its number in the file.
        mask: (H, W) bool, in the frame of the photo; None for a box, a line or a point, which show no pixels.
        category: what it shows ("leaf"); "" where the format has no categories.
    """

    label: int
    mask: np.ndarray | None
    category: str = ""


def check_categories(
    counts: Mapping[str, int], wanted: Collection[str], *, known: Collection[str] = (), source: Path
) -> None:
    """Warn (InputWarning) if masks of several categories are treated alike, and if no mask is of a wanted one.

    Args:
        counts: how many masks each category has.
        wanted: the requested categories; empty for all.
        known: categories that the file lists, with or without masks.
        source: the file or folder; messages name it.

    Raises:
        InputError: a wanted category is not there.
    """
    present = [name for name in dict.fromkeys([*known, *counts]) if name]
    missing = [name for name in wanted if name not in present]
    if missing:
        there = ", ".join(present) or "none"
        raise InputError(f"{source}: there is no category '{missing[0]}', expected of these: {there}")
    several = [name for name in counts if name and counts[name]]
    if several and wanted and not set(several) & set(wanted):
        message = f"none of the masks is of the category {' or '.join(wanted)}, but {_describe(counts, several)}"
        warnings.warn(f"{source}: {message}", InputWarning, stacklevel=4)
    if len(several) > 1 and not wanted:
        shown = _describe(counts, several)
        message = f"masks of {len(several)} categories are taken alike ({shown}); --categories selects some"
        warnings.warn(f"{source}: {message}", InputWarning, stacklevel=4)


def _describe(counts: Mapping[str, int], names: Sequence[str]) -> str:
    """The first categories with their numbers of masks: "12 leaf, 1 pot"."""
    more = f" and {len(names) - SHOWN} more" if len(names) > SHOWN else ""
    return ", ".join(f"{counts[name]} {name}" for name in names[:SHOWN]) + more


def select_masks(masks: Sequence[FoundMask], wanted: Collection[str]) -> tuple[list[FoundMask], Counter[str]]:
    """The wanted entries that show pixels, and how many masks of each category there are; boxes count as ""."""
    counts = Counter(found.category for found in masks if found.mask is not None)
    kept = [found for found in masks if found.mask is not None and (not wanted or found.category in wanted)]
    return kept, counts
