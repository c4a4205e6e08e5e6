from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from mvseg.matching.nview.match_scores import IdEvidence, features, match_scores, scene_features


def evidence(**changes: float) -> IdEvidence:
    """One region with good evidence, with changes."""
    plain = {"score": 0.8, "margin": 0.9, "coverage": 0.9, "weight": 0.8, "num_partners": 4, "num_fragments": 1}
    plain = plain | {"agreement": 1.0} | changes
    return IdEvidence(**{name: np.array([value]) for name, value in plain.items()}, num_views=5)


def test_a_plain_match_is_nearly_certain_and_alone_is_zero() -> None:
    assert 0.97 < match_scores(evidence())[0] < 1
    assert match_scores(evidence(num_partners=0))[0] == 0


@pytest.mark.parametrize(("name", "worse"), [("score", 0.2), ("margin", 0.05), ("weight", 0.3), ("num_fragments", 2)])
def test_less_evidence_is_less_sure(name: str, worse: float) -> None:
    assert match_scores(evidence(**{name: worse}))[0] < match_scores(evidence())[0]


def test_a_close_rival_means_doubt() -> None:
    """A region of a pair in five views for which another cluster is as good."""
    assert match_scores(evidence(score=0.1, margin=0.0, weight=0.5, num_partners=1))[0] < 0.7


def test_by_hand_and_limited_to_what_the_plants_fill() -> None:
    assert features(evidence())[0].tolist() == [1, 0.8, 0.9, 0.9, 0.8, 1.0, 0.25, 0.0]
    far = features(evidence(score=-3, margin=9, coverage=2, weight=-1, num_partners=9, num_fragments=3))[0]
    assert far.tolist() == pytest.approx([1, -0.2, 1.5, 1, 0, 1, 1 / 9, 1])


def join(*regions: IdEvidence) -> IdEvidence:
    """One scene of all these regions."""
    names = [field.name for field in dataclasses.fields(IdEvidence) if field.name != "num_views"]
    fields = {name: np.concatenate([getattr(single, name) for single in regions]) for name in names}
    return IdEvidence(**fields, num_views=5)


def test_a_region_is_believed_less_among_unsure_ones() -> None:
    doubtful = [evidence(score=0.1, margin=0.0, weight=0.4)] * 3
    among_sure, among_doubtful = (match_scores(join(evidence(), *others))[0] for others in ([evidence()], doubtful))
    assert among_doubtful < among_sure - 0.1
    alone = evidence(num_partners=0, agreement=0.0, score=0.0, margin=-1.0)
    assert match_scores(join(evidence(), alone)).tolist() == pytest.approx([match_scores(evidence())[0], 0])
    assert match_scores(join(alone, alone)).tolist() == [0, 0]
    assert match_scores(evidence(agreement=0.4))[0] < match_scores(evidence())[0] - 0.02


def test_the_scene_by_hand() -> None:
    first = scene_features(evidence())[0]
    odds = np.exp(1.24 + 1.20 * 0.8 + 2.96 * 0.9 - 0.69 * 0.9 + 1.26 * 0.8 - 0.90 - 1.59 / 4)
    assert first.tolist() == pytest.approx([1, np.log(odds), np.log(odds), np.log(odds) ** 2, 1.0])
    pair = scene_features(join(evidence(), evidence(num_partners=1, agreement=0.5)))
    np.testing.assert_allclose(pair[:, 3], pair[:, 1] * pair[0, 2])
    np.testing.assert_allclose(pair[:, 4], 0.75)
