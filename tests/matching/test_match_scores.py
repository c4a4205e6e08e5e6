from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from mvseg.matching.nview.match_scores import IdEvidence, features, match_scores


def evidence(**changes: float) -> IdEvidence:
    """One region with good evidence, with changes."""
    plain = {"score": 0.8, "margin": 0.9, "landing": 0.9, "weight": 0.8, "num_partners": 4, "num_pieces": 1} | changes
    return IdEvidence(**{name: np.array([value]) for name, value in plain.items()}, num_views=5)


def test_a_plain_match_is_nearly_certain() -> None:
    assert 0.97 < match_scores(evidence())[0] < 1


def test_alone_is_zero() -> None:
    assert match_scores(evidence(num_partners=0))[0] == 0


@pytest.mark.parametrize(("name", "worse"), [("score", 0.2), ("margin", 0.05), ("weight", 0.3), ("num_pieces", 2)])
def test_less_evidence_is_less_sure(name: str, worse: float) -> None:
    assert match_scores(evidence(**{name: worse}))[0] < match_scores(evidence())[0]


def test_a_close_rival_means_doubt() -> None:
    """A region of a pair in five views for which another cluster is as good."""
    assert match_scores(evidence(score=0.1, margin=0.0, weight=0.5, num_partners=1))[0] < 0.7


def test_by_hand_and_limited_to_what_the_plants_fill() -> None:
    assert features(evidence())[0].tolist() == [0.8, 0.9, 0.9, 0.8, 1.0, 0.25, 0.0]
    far = features(evidence(score=-3, margin=9, landing=2, weight=-1, num_partners=9, num_pieces=3))[0]
    assert far.tolist() == pytest.approx([-0.2, 1.5, 1, 0, 1, 1 / 9, 1])


def test_regions_do_not_affect_each_other() -> None:
    both = [evidence(), evidence(margin=0.1)]
    names = [field.name for field in dataclasses.fields(IdEvidence) if field.name != "num_views"]
    fields = {name: np.concatenate([getattr(single, name) for single in both]) for name in names}
    joined = IdEvidence(**fields, num_views=5)
    np.testing.assert_allclose(match_scores(joined), np.concatenate([match_scores(single) for single in both]))
