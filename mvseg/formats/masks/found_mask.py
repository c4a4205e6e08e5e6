"""Result of every mask reader, and the selection by category."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mvseg.errors import InputError, warn
from mvseg.findings.finding import Finding

MANY_PARTS = 4  # chosen: shapes of one leaf from which they are suspicious


@dataclass(frozen=True, eq=False)
class FoundMask:
    """One entry of a file of masks; `label` is its number there.

    Attributes:
        mask: (H, W) bool, in the frame of the photo; None for a box, a line or a point, which show no pixels.
        category: what it shows ("leaf"); "" where the format has no categories.
        num_parts: shapes that it is made of.
    """

    label: int
    mask: np.ndarray | None
    category: str = ""
    num_parts: int = 1


def check_parts(masks: Iterable[FoundMask], source: object) -> None:
    """Raises InputError: most shapes are in masks of many parts: the group that they share is no leaf."""
    counts = [each.num_parts for each in masks]
    if 2 * sum(count for count in counts if count >= MANY_PARTS) > sum(counts):
        what = f"{sum(counts)} shapes are parts of {len(counts)} leaves by their group_id"
        raise InputError(f"{source}: {what}: is it the number of the plant? clear it, or give each leaf its own")


def check_categories(
    counts: Mapping[str, int], wanted: Collection[str], *, categories: Collection[str] = (), source: Path
) -> None:
    """Warn (InputWarning) if masks of several categories are treated alike, and if no mask is of a wanted one (empty:
    all). `counts` are the masks of each category, `categories` those that the file lists, with or without masks. Raises
    InputError if a wanted category is not there; messages name `source`."""
    present = [name for name in dict.fromkeys([*categories, *counts]) if name]
    for name in wanted:
        if name not in present:
            there = ", ".join(present) or "none"
            raise InputError(f"{source}: there is no category '{name}', expected of these: {there}")
    several = [name for name in counts if name and counts[name]]
    names = tuple(f"{counts[name]} {name}" for name in several)
    if several and wanted and not set(several) & set(wanted):
        warn(Finding("no_mask_of_category", str(source), {"wanted": tuple(wanted), "shown": names}))
    if len(several) > 1 and not wanted:
        warn(Finding("several_categories", str(source), {"count": len(several), "shown": names}))
