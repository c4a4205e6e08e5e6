"""The last lines of a run: what was found, what is in doubt, one next step."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from mvseg.findings.finding import Finding
from mvseg.findings.sentences import SENTENCES, UNSURE_IDS
from mvseg.masks import Masks
from mvseg.matching.result import Matching, MatchReport
from mvseg.regions import Regions
from mvseg.results.card import BY_HAND, ONE_SIDED, SHAPES, SIDES, UNTAUGHT, make_card
from mvseg.results.result import Instances, Learned, Result
from mvseg.scene import Scene

OUT = Path("out")
TEACH = "let the views teach the detector this plant: mvseg infer --again out --learn 2"
ONE = Finding("one_sided", values={"degrees": 17.0})
MISSED = Finding("leaves_missed", values={"share": 0.78})
OFF = Finding("view_off", "view 2 (002)", {"share": 0.1, "px": 30.0}, (2,), "error")
UNSURE = Finding("views_disagree", values={"share": 0.7})


@pytest.fixture
def result(demo_scene: Scene, demo_regions: Regions, demo_truth: torch.Tensor) -> Result:
    return Result(demo_scene, Matching(Masks.of(demo_regions, demo_truth), MatchReport("nview")))


def test_a_sound_result_has_no_doubt(result: Result) -> None:
    card = make_card(result, OUT)
    step = "answer questions about doubtful leaves: mvseg correct out"
    assert card.as_json() == {"found": "12 leaves in 9 photos", "doubt": "", "next_step": step}
    findings = (UNSURE, MISSED, OFF, ONE)
    for number in range(1, 5):
        assert make_card(replace(result, findings=findings[:number]), OUT).doubt == findings[number - 1]
    assert make_card(replace(result, findings=(Finding("unknown_up", level="note"),)), OUT).doubt is None
    card = make_card(replace(result, findings=findings), OUT)
    assert card.as_json()["doubt"].startswith("you walked 17 degrees round the plant")


def test_the_next_step_is_a_command(result: Result) -> None:
    steps = {each.code: make_card(replace(result, findings=(each,)), Path("my out")).next_step
             for each in (OFF, MISSED, UNSURE)}  # fmt: skip
    assert steps["view_off"].endswith(": mvseg check 'my out'")
    assert steps["views_disagree"].endswith(": mvseg check 'my out'")
    assert steps["leaves_missed"].endswith(": mvseg infer --again 'my out' --learn 2")


@pytest.mark.parametrize("learned", [Learned(rounds=1, agreed_area=(3.0, 9.0)), Learned(agreed_area=(3.0, 3.1)), None])
def test_learning_is_not_advised_right_after_it(learned: Learned | None, result: Result) -> None:
    findings = (MISSED, *(() if learned else (Finding("learned_too_few", values={"count": 1, "least": 3}),)))
    after = replace(result, findings=findings, learned=learned or Learned(agreed_area=(3.0,)))
    assert make_card(after, OUT).next_step.endswith("let the detector learn them: mvseg correct out")
    assert make_card(replace(after, learned=Learned(agreed_area=(3.0,)), findings=(MISSED,)), OUT).next_step == TEACH


def test_codes_of_the_card_have_sentences() -> None:
    assert {*ONE_SIDED, *UNTAUGHT, *BY_HAND, *UNSURE_IDS, *SIDES, *SHAPES} <= SENTENCES.keys()


def test_doubtful_shapes_are_named_and_an_area_has_the_digits_that_are_known(result: Result) -> None:
    area = SimpleNamespace(value=8484.2, sd=159.4, exists=True)
    whole = {"total_leaf_area": area, "number_of_leaves": SimpleNamespace(value=9.0)}
    poor = SimpleNamespace(use="no", rejection=None, numbers={"area": SimpleNamespace(value=1200.0)})
    stem = SimpleNamespace(use="no", rejection="stem", numbers={"area": SimpleNamespace(value=math.nan)})
    traits = SimpleNamespace(whole=whole, unit="mm", rejected={7: "stem", 9: "short"}, leaves=[poor, stem])
    measured = replace(
        result,
        instances=Instances(traits=traits),  # type: ignore[arg-type]
        findings=(Finding("doubtful_shapes", values={"count": 2, "total": 12, "leaves": ("2", "8")}, level="note"),),
    )
    card = make_card(measured, OUT)
    assert card.summary == (
        "11 leaves and 1 stem in 9 photos, 9 of which count in the plant's traits; total area 8,480 +- 160 mm^2, "
        "without 1 leaf of 1,200 mm^2 that fit badly"
    )
    assert str(card.doubt) == "the shapes of 2 of 12 leaves are doubtful (2, 8): the page says why"
