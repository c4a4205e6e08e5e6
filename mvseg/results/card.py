"""What somebody needs to know after a run: what was found, what is in doubt, and the one next step."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mvseg.results.result import Result

NAMED = 3  # views or leaves that a sentence names


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


def make_card(result: Result, out: Path, *, scene: Path, masks: Path | None = None) -> Card:
    """The card of the result of a scene, and of its masks where they were given, that is written to `out`."""
    check = f"mvseg check {scene}" + (f" --masks {masks}" if masks else "")
    doubt, next_step = _find_doubt(result, out, check)
    return Card(_say_found(result), doubt, next_step)


def _say_found(result: Result) -> str:
    num_photos, num_leaves = len(result.scene.views), result.matching.num_instances
    found = f"{_count(num_leaves, 'leaf', 'leaves')} in {_count(num_photos, 'photo', 'photos')}"
    if result.traits is not None and (counted := int(result.traits.whole["number_of_leaves"].value)) != num_leaves:
        found += f", {counted} of which count in the plant's traits"
    if result.learned.rounds:
        found += f", seen by a detector that learned this plant in {_count(result.learned.rounds, 'round', 'rounds')}"
    if result.traits is not None and (area := result.traits.whole["total_leaf_area"]).exists and num_leaves:
        found += f"; total area {_say_number(area.value, area.sd)} {result.traits.unit or 'world unit'}^2"
    return found


def _find_doubt(result: Result, out: Path, check: str) -> tuple[str, str]:
    """What is most in doubt, and what helps; `check`: the command that compares photos, masks and cameras."""
    correct = f"mvseg correct {out} asks about what is doubtful"
    for finding in result.contradictions:
        if finding.level == "error":
            views = _name([result.scene.views[view].name for view in finding.views])
            wrong = f"the cameras of {views} do not fit the others: ids and shapes may be wrong"
            return wrong if finding.views else finding.what, f"{check} says what to do"
    if result.missing is not None:
        return result.missing.why, result.missing.helps
    if result.disagreement:
        return result.disagreement, f"{check} says what to do"
    surfaces = result.surfaces or {}
    if doubtful := [str(leaf) for leaf, each in sorted(surfaces.items()) if not each.quality.is_good]:
        shapes = "the shape of leaf {} is" if len(doubtful) == 1 else "the shapes of leaves {} are"
        return f"{shapes.format(_name(doubtful))} doubtful: the page says why", correct
    if surfaces and not result.scene.unit:
        return "", "lengths are in the unit of the cameras: give --scale and --unit, or film a marker (mvseg target)"
    return "", correct


def _name(names: Sequence[str]) -> str:
    """The first three in a sentence: "a", "a and b", "a, b, c and 2 more"."""
    shown = [*names[:NAMED], *([f"{len(names) - NAMED} more"] if len(names) > NAMED else [])]
    return " and ".join(filter(None, (", ".join(shown[:-1]), *shown[-1:])))


def _say_number(value: float, sd: float) -> str:
    """With two digits of its standard deviation, if that is known; ASCII, since not every terminal knows more."""
    if not np.isfinite(sd) or sd <= 0:
        return f"{value:,.4g}"
    decimals = 1 - int(np.floor(np.log10(sd)))
    return " +- ".join(f"{round(number, decimals):,.{max(decimals, 0)}f}" for number in (value, sd))


def _count(number: int, one: str, many: str) -> str:
    return f"{number} {one if number == 1 else many}"
