"""What somebody needs to know after a run: what was found, what is in doubt, and the one next step."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mvseg.results.result import Result


@dataclass(frozen=True)
class Card:
    """The last lines of a run, the field `card` of run.json, and the first lines of the page.

    Attributes:
        found: how many leaves, in how many photos.
        doubt: what is probably missing or wrong; "" where nothing is known to be.
        next_step: what helps most.
    """

    found: str
    doubt: str
    next_step: str


def make_card(result: Result, out: Path, *, scene: Path) -> Card:
    """The card of the result of a scene that is written to `out`."""
    doubt, next_step = _find_doubt(result, out, scene)
    return Card(_say_found(result), doubt, next_step)


def _say_found(result: Result) -> str:
    num_photos, num_leaves = len(result.scene.views), result.matching.num_instances
    found = f"{_count(num_leaves, 'leaf', 'leaves')} in {_count(num_photos, 'photo', 'photos')}"
    if result.learned.rounds:
        found += f", seen by a detector that learned this plant in {_count(result.learned.rounds, 'round', 'rounds')}"
    if result.traits is not None and (area := result.traits.whole["total_leaf_area"]).exists and num_leaves:
        deviation = f" +- {area.sd:,.3g}" if np.isfinite(area.sd) else ""
        found += f"; total area {area.value:,.4g}{deviation} {result.traits.unit or 'world unit'}^2"
    return found


def _find_doubt(result: Result, out: Path, scene: Path) -> tuple[str, str]:
    """What is most in doubt, and what helps."""
    correct = f"mvseg correct {out} asks about what is doubtful"
    if result.missing is not None:
        return result.missing.why, result.missing.helps
    if result.disagreement:
        return result.disagreement, f"mvseg check {scene}"
    surfaces = result.surfaces or {}
    if doubtful := sum(not each.quality.is_good for each in surfaces.values()):
        return f"the shape of {doubtful} of {_count(len(surfaces), 'leaf', 'leaves')} is doubtful", correct
    if surfaces and not result.scene.unit:
        return "", "lengths are in the unit of the cameras: give --scale and --unit, or film a marker (mvseg target)"
    return "", correct


def _count(number: int, one: str, many: str) -> str:
    return f"{number} {one if number == 1 else many}"
