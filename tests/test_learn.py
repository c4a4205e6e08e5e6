"""The views teach the detector: which weights stay, and that nothing is lost by trying."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from found_masks import FoundMasks, open_photos, see_masks
from leafy_scene import LeafyScene, write_leafy_scene
from mvseg.config import RunConfig
from mvseg.corrections.file import Corrections, Reject
from mvseg.demo import demo_scene
from mvseg.detection.cached_detections import CachedDetections
from mvseg.detection.numbers import DETECTION
from mvseg.detectors.zoo import weights_path
from mvseg.errors import InputError
from mvseg.masks import Masks, Origin
from mvseg.matching.result import Matching, MatchReport
from mvseg.pipeline import learn as module
from mvseg.pipeline.find_in_photos import find_in_photos
from mvseg.pipeline.finish import shape_leaves
from mvseg.pipeline.learn import learn
from mvseg.pipeline.open_scene import open_scene
from mvseg.pipeline.plant import Plant
from mvseg.results.folder import save_result
from mvseg.results.result import Learned
from mvseg.training.view_labels import ViewLabels, label_views
from warned import warns_of

Patch = pytest.MonkeyPatch


SIZE = 96


@pytest.fixture(scope="module")
def leafy(tmp_path_factory: pytest.TempPathFactory) -> LeafyScene:
    return write_leafy_scene(tmp_path_factory.mktemp("leafy"), num_leaves=4, num_views=4, size=SIZE, span_deg=180)


SEEN: dict[tuple[float, int], Plant] = {}  # by the scores and the number of leaves


def see(leafy: LeafyScene, monkeypatch: Patch, *, score: float = 0.2, leaves: int = 4, **options: Any) -> Plant:
    """Leaves that a detector has found with these scores; the views chose all of them, which is done once."""
    regions = leafy.regions.select(leafy.regions.labels <= leaves)
    ids = regions.labels
    scores = torch.full((len(ids),), score)
    masks = Masks.of(regions, ids, torch.ones(len(ids)), detection_scores=scores, origin=Origin.DETECTED)
    look = FoundMasks.of(Matching(masks, MatchReport("nview", has_probabilities=True)))
    see_masks(monkeypatch, replace(look, longest=SIZE))
    if (score, leaves) not in SEEN:
        SEEN[score, leaves] = find_in_photos(open_photos(leafy.scene, RunConfig(reconstruct=None)))
    plant = SEEN[score, leaves]
    return replace(plant, opened=replace(plant.opened, config=RunConfig(reconstruct=None, **options)))


def teach(monkeypatch: pytest.MonkeyPatch, *growth: float) -> list[ViewLabels]:
    """Each round makes the agreed area so many times as large as it was; the labels that were learned."""
    taught: list[ViewLabels] = []

    def learn_once(plant: Plant, labels: ViewLabels, _: CachedDetections) -> Plant:
        taught.append(labels)
        grown = 0.5 * torch.tensor(growth[: len(taught)]).prod().sqrt()  # the area grows with the square of P
        chances = {each: float(grown) for each in plant.instances.probabilities}
        seen = replace(plant, instances=replace(plant.instances, probabilities=chances))
        return replace(seen, learned=Learned(weights=f"weights {len(taught)}".encode()))

    monkeypatch.setattr(module, "_learn_once", learn_once)
    return taught


def lower(plant: Plant, chance: float = 0.9) -> Plant:
    """So that the agreed area can grow."""
    chances = dict.fromkeys(plant.instances.probabilities, chance)
    return replace(plant, instances=replace(plant.instances, probabilities=chances))


@pytest.mark.parametrize(
    ("rounds", "growth", "tried", "kept"),
    [
        (1, (1.2, 1.2), 1, 1),
        (3, (1.2, 1.2, 1.02), 3, 2),  # the third grows by too little
        (3, (1.02, 1.5), 1, 0),
        (2, (0.5, 9.0), 1, 0),
        (1, (0.0,), 1, 0),
        ("off", (1.2,), 0, 0),
        ("auto", (1.2, 1.2, 1.2), 2, 2),
    ],
)
def test_weights_stay_where_the_agreed_area_grows(
    leafy: LeafyScene, monkeypatch: Patch, tmp_path: Path, rounds: Any, growth: tuple[float, ...], tried: int, kept: int
) -> None:
    plant = lower(see(leafy, monkeypatch, learn=rounds), 0.5)
    taught = teach(monkeypatch, *growth)
    seen = learn(plant, cache=CachedDetections(tmp_path))
    assert len(taught) == tried
    assert seen.learned.rounds == kept
    assert seen.learned.weights == (f"weights {kept}".encode() if kept else None)
    assert len(seen.learned.agreed_area) == tried + 1
    assert seen.rating.agreed_area == pytest.approx(max(seen.learned.agreed_area[: kept + 1]))
    if not kept:
        assert torch.equal(seen.masks.instance_ids, plant.masks.instance_ids)


def test_a_known_species_is_not_learned_unless_somebody_asks(
    leafy: LeafyScene, monkeypatch: Patch, tmp_path: Path
) -> None:
    taught = teach(monkeypatch, 1.0)
    plant = see(leafy, monkeypatch, score=0.6)
    assert learn(plant, cache=CachedDetections(tmp_path)).learned == Learned(agreed_area=(plant.rating.agreed_area,))
    assert not taught
    learn(see(leafy, monkeypatch, score=0.6, learn=1), cache=CachedDetections(tmp_path))
    assert len(taught) == 1
    smaller = replace(plant, image_size=round(SIZE * DETECTION.size_step))
    learn(smaller, cache=CachedDetections(tmp_path))
    assert len(taught) == 2  # the detector sees the leaves best at another size than its own
    learn(replace(plant, agreement=0.6), cache=CachedDetections(tmp_path))
    assert len(taught) == 2  # a dense plant is no new species
    with pytest.raises(InputError, match="learn is 0, expected 1 or more rounds, auto or off"):
        RunConfig(learn=0)


@pytest.mark.slow
@pytest.mark.shared_data
@pytest.mark.parametrize("plant", ["demo_plant", "basil-0729"])
def test_plants_that_the_shipped_detector_knows_are_not_learned(plant: str, shared_data: Path, tmp_path: Path) -> None:
    folder = demo_scene() if plant == "demo_plant" else shared_data / plant
    cache = CachedDetections(tmp_path)
    plant = find_in_photos(open_scene(folder, None, RunConfig(reconstruct=None)), cache=cache)
    assert len(learn(plant, cache=cache).learned.agreed_area) == 1


@pytest.mark.parametrize("reason", ["few", "interrupt", "fails"])
def test_what_was_there_stays_and_one_sentence_says_why(
    leafy: LeafyScene, monkeypatch: Patch, tmp_path: Path, reason: str
) -> None:
    def stop(*_: object) -> Plant:
        raise KeyboardInterrupt if reason == "interrupt" else InputError("it tells several kinds apart")

    plant = see(leafy, monkeypatch, leaves=2 if reason == "few" else 4, learn=2)
    monkeypatch.setattr(module, "_learn_once", stop)
    codes = {"few": "learned_too_few", "interrupt": "learning_interrupted", "fails": "learning_failed"}
    with warns_of(codes[reason]):
        seen = learn(plant, cache=CachedDetections(tmp_path))
    assert seen.rating.agreed_area == plant.rating.agreed_area
    assert seen.learned.weights is None


def test_what_a_person_says_is_learned(leafy: LeafyScene, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    plant = lower(see(leafy, monkeypatch, learn=1))
    x1, y1, x2, y2 = plant.masks.regions.boxes[0].tolist()
    edit = Reject(view=leafy.scene.views[0].name, at=((x1 + x2) / 2, (y1 + y2) / 2), everywhere=True)
    (without,) = (teach(monkeypatch, 1.0),)
    learn(plant, cache=CachedDetections(tmp_path), corrections=Corrections((edit,)))
    assert [labels.num_leaves for labels in without] == [3]


def test_a_result_keeps_its_detector_and_a_round_is_learned_once(
    leafy: LeafyScene, monkeypatch: Patch, tmp_path: Path
) -> None:
    """A run that was cut off goes on from the weights; the next plant can use them."""
    made: list[int] = []
    plant = see(leafy, monkeypatch, learn=1)

    def fine_tune(*_: object) -> bytes:
        made.append(1)
        return b"weights"

    monkeypatch.setattr(module, "_fine_tune", fine_tune)
    monkeypatch.setattr(module, "_describe", lambda *_: "the same")
    monkeypatch.setattr(module, "_at_size", lambda path, _: path.read_bytes())
    monkeypatch.setattr(module, "run_near", lambda *_, **__: plant)
    for _ in range(2):
        seen = learn(lower(plant, 0.5), cache=CachedDetections(tmp_path / "kept"))
        assert seen.learned.weights == b"weights"
    assert len(made) == 1
    save_result(shape_leaves(seen), tmp_path / "out", report=False)
    assert (tmp_path / "out" / "detector.safetensors").read_bytes() == b"weights"
    assert weights_path(str(tmp_path / "out")) == tmp_path / "out" / "detector.safetensors"
    said = json.loads((tmp_path / "out" / "run.json").read_text())["learned"]
    assert said["rounds"] == 1
    assert len(said["agreed_area"]) == 2


def test_weights_that_were_learned_depend_on_the_photos(leafy: LeafyScene, monkeypatch: pytest.MonkeyPatch) -> None:
    plant = see(leafy, monkeypatch)
    chances = plant.instances.probabilities
    labels = label_views(plant.masks, plant.proposals, plant.opened.photos, probabilities=chances)
    first, photos = module._describe(plant, labels), plant.opened.photos
    assert module._describe(plant, labels) == first
    monkeypatch.setattr(type(photos), "sha256", lambda _, view: f"{view} of another day")
    assert module._describe(plant, labels) != first
