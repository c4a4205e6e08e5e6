"""The last lines of a run: what was found, what is in doubt, one next step."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import torch

from mvseg import demo
from mvseg.masks import Masks
from mvseg.matching.result import Matching, MatchReport
from mvseg.regions import Regions
from mvseg.results.card import make_card
from mvseg.results.result import Result
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
    assert make_card(unsure, OUT, scene=SCENE).next_step == f"mvseg check {SCENE}"
    lacking = make_card(replace(unsure, missing=Missing("most are missing", "outline some")), OUT, scene=SCENE)
    assert (lacking.doubt, lacking.next_step) == ("most are missing", "outline some")
