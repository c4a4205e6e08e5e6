"""Heights of bases over one ground on all dates of a plant.

A date counts its heights from the lowest point of its own leaves, as nothing else of the plant is known there. Where
the lowest leaf falls, this ground rises, and all others seem to sink. So one leaf is the reference: its base stays
where it was on the first date, for the stem below a leaf that is open hardly stretches. Where it is gone, another one
that was seen with it takes over, at the height that it had then.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

from mvseg.tracking.dates import Number

Heights = Mapping[int, Mapping[int, Number]]  # {track: {date: height of its base}}


def level_heights(heights: Heights) -> tuple[dict[int, dict[int, Number]], dict[int, int]]:
    """The heights over the ground of the first date, and {date: its reference, a track}.

    The reference is the leaf that the most dates from there on show; of several the lowest. The standard deviation of
    its height is carried into those of the others. A date that shares no leaf with those before it has no heights.
    """
    level: dict[int, dict[int, Number]] = {track: {} for track in heights}
    references: dict[int, int] = {}
    for date in sorted({date for seen in heights.values() for date in seen}):
        here = [track for track, seen in heights.items() if date in seen and (level[track] or not references)]
        if not here:
            continue
        last = next(reversed(references.values()), None)
        reference = last if last in here else min(here, key=lambda track: _rank(heights[track], date))
        its = heights[reference][date]
        known = next(reversed(level[reference].values()), its)
        for track, seen in heights.items():
            if date in seen:
                own, sd = seen[date], seen[date].sd if not references else math.hypot(seen[date].sd, its.sd)
                level[track][date] = replace(own, value=known.value + own.value - its.value, sd=sd)
        level[reference][date], references[date] = known, reference
    return level, references


def _rank(seen: Mapping[int, Number], date: int) -> tuple[int, float]:
    """The least one is shown by the most dates from this one on, and is low."""
    return -sum(other >= date for other in seen), seen[date].value
