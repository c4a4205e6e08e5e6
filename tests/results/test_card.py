"""The last lines of a run: what was found, what is in doubt, one next step."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import torch

from mvseg import demo
from mvseg.checks.finding import Finding
from mvseg.masks import Masks
from mvseg.matching.result import Matching, MatchReport
from mvseg.regions import Regions
from mvseg.results.card import make_card
from mvseg.results.result import Instances, Result
from mvseg.scene import Scene
from mvseg.verification.unexplained import Missing

OUT, SCENE = Path("out"), demo.demo_scene()


def test_what_matters_most_is_said_with_what_helps(
    demo_scene: Scene, demo_regions: Regions, demo_truth: torch.Tensor
) -> None:
    result = Result(demo_scene, Matching(Masks.of(demo_regions, demo_truth), MatchReport("nview")))
    sound = make_card(result, OUT, scene=SCENE)
    assert (sound.found, sound.doubt) == ("12 leaves in 9 photos", "")
    assert sound.next_step == "mvseg correct out asks about what is doubtful"
    unsure = replace(result, disagreement="the views hardly agree")
    assert make_card(unsure, OUT, scene=SCENE).doubt == "the views hardly agree"
    assert make_card(unsure, OUT, scene=SCENE).next_step == f"mvseg check {SCENE} says what to do"
    unsure = replace(unsure, missing=Missing("most are missing", "outline some"))
    lacking = make_card(unsure, OUT, scene=SCENE)
    assert (lacking.doubt, lacking.next_step) == ("most are missing", "outline some")
    found = Finding("poses", "features of the photos do not fit", "error", (0, 2, 3, 5))
    wrong = make_card(replace(unsure, contradictions=(found,)), OUT, scene=SCENE, masks=Path("masks"))
    assert wrong.doubt == "the cameras of 000, 002, 003 and 1 more do not fit the others: ids and shapes may be wrong"
    assert wrong.next_step == f"mvseg check {SCENE} --masks masks says what to do"


def test_doubtful_shapes_are_named_and_an_area_has_the_digits_that_are_known(
    demo_scene: Scene, demo_regions: Regions, demo_truth: torch.Tensor
) -> None:
    good, bad = (SimpleNamespace(quality=SimpleNamespace(is_good=is_good)) for is_good in (True, False))
    area = SimpleNamespace(value=8484.2, sd=159.4, exists=True)
    whole = {"total_leaf_area": area, "number_of_leaves": SimpleNamespace(value=9.0)}
    traits = SimpleNamespace(whole=whole, unit="mm")
    shapes = Instances(surfaces={8: bad, 2: bad, 3: good}, traits=traits)  # type: ignore[dict-item,arg-type]
    matching = Matching(Masks.of(demo_regions, demo_truth), MatchReport("nview"))
    card = make_card(Result(demo_scene, matching, instances=shapes), OUT, scene=SCENE)
    assert card.found == "12 leaves in 9 photos, 9 of which count in the plant's traits; total area 8,480 +- 160 mm^2"
    assert card.doubt == "the shapes of leaves 2 and 8 are doubtful: the page says why"
