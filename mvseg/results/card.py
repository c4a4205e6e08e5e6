"""The card of a result: its outcome, its worst doubt, and the one next step, with a command to paste."""

from __future__ import annotations

import shlex
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mvseg.findings.finding import Finding
from mvseg.findings.sentences import UNSURE_IDS
from mvseg.results.result import Result
from mvseg.traits.leaf import say_number

# Findings that a card may name, the gravest first; errors stand after the first two. Views from one side explain more
# than anything else.
ONE_SIDED = "no_depth", "one_sided"
UNTAUGHT = "species_unknown", "detector_unsure", "leaves_missed", "views_odd_detected"
BY_HAND = "no_leaf_left", "no_leaves"
SIDES = ("leaves_seen_from_one_side",)
SHAPES = ("doubtful_shapes",)


@dataclass(frozen=True)
class Card:
    """The last lines of a run, the field `card` of run.json, and the first lines of the page.

    Attributes:
        summary: how many leaves, in how many photos.
        doubt: the finding that explains most faults; None where there is none.
        next_step: the most helpful step, and the command for it.
    """

    summary: str
    doubt: Finding | None
    next_step: str

    def as_json(self) -> dict[str, str]:
        return {"found": self.summary, "doubt": str(self.doubt or ""), "next_step": self.next_step}


def make_card(result: Result, out: Path) -> Card:
    doubt = _gravest(result)
    return Card(_summarize(result), doubt, _next_step(result, doubt, shlex.quote(str(out))))


def _summarize(result: Result) -> str:
    kinds = {} if result.traits is None else result.traits.rejected
    stems = [leaf for leaf, kind in kinds.items() if kind == "stem"]
    num_photos, num_leaves = len(result.scene.views), result.matching.num_instances - len(stems)
    sentence = _count(num_leaves, "leaf", "leaves") + (f" and {_count(len(stems), 'stem', 'stems')}" if stems else "")
    sentence += f" in {_count(num_photos, 'photo', 'photos')}"
    if result.traits is not None and (counted := int(result.traits.whole["number_of_leaves"].value)) != num_leaves:
        sentence += f", {counted} of which count in the plant's traits"
    if result.learned.rounds:
        rounds = _count(result.learned.rounds, "round", "rounds")
        sentence += f", seen by a detector that learned this plant in {rounds}"
    if result.traits is not None and (area := result.traits.whole["total_leaf_area"]).exists and num_leaves:
        unit = f"{result.traits.unit or 'world unit'}^2"
        sentence += f"; total area {say_number(area.value, area.sd)} {unit}"
        useless = [each for each in result.traits.leaves if each.use == "no" and each.rejection is None]
        out = [each.numbers["area"].value for each in useless]
        if lost := [value for value in out if np.isfinite(value)]:
            sentence += f", without {_count(len(lost), 'leaf', 'leaves')} of {sum(lost):,.4g} {unit} that fit badly"
    return sentence


def _gravest(result: Result) -> Finding | None:
    errors = [each.code for each in result.findings if each.level == "error"]
    order = (*ONE_SIDED, *errors, *BY_HAND, *UNTAUGHT, *UNSURE_IDS, *SIDES, *SHAPES)
    candidates = [each for each in result.findings if each.code in order]
    return min(candidates, key=lambda each: order.index(each.code), default=None)


def _next_step(result: Result, doubt: Finding | None, out: str) -> str:
    if doubt is None and result.surfaces and not result.scene.unit:
        return "lengths are in the unit of the cameras: give --scale and --unit, or film a marker (mvseg target)"
    if doubt is None or doubt.code in SHAPES:
        return f"answer questions about doubtful leaves: mvseg correct {out}"
    if doubt.code in (*ONE_SIDED, *SIDES):
        return "film or photograph it from half round, and begin again: mvseg pose PHOTOS --out NEW_SCENE"
    has_tried = result.learned.rounds > 0 or len(result.learned.agreed_area) > 1
    has_tried |= any(each.code in ("learned_too_few", "learning_failed") for each in result.findings)
    if doubt.code in UNTAUGHT and not has_tried:
        return f"let the views teach the detector this plant: mvseg infer --again {out} --learn 2"
    if doubt.code in (*UNTAUGHT, *BY_HAND):
        return f"outline six leaves in two photos each, and let the detector learn them: mvseg correct {out}"
    return f"compare photos, masks and cameras, view by view: mvseg check {out}"


def _count(number: int, one: str, many: str) -> str:
    return f"{number} {one if number == 1 else many}"
