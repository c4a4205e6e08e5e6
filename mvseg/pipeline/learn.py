"""The views teach the detector: it learns the leaves that they agree about, looks again, and finds the others.

The paper feeds the ids of clusters back into the proposals of the same network (Sec. 3.2); this feeds them back into
its weights. It is self-training (Xie et al., "Self-training with Noisy Student", CVPR 2020) at test time (Sun et al.,
"Test-Time Training with Self-Supervision", ICML 2020), in which calibrated views, not the network, say what is right:
before each round, what a label is, and after it, whether the new weights stay.
"""

from __future__ import annotations

import hashlib
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from mvseg._version import code_hash
from mvseg.corrections.file import Corrections
from mvseg.detection.cached_detections import CachedDetections, describe_photo
from mvseg.detection.numbers import DETECTION
from mvseg.detectors.weights_file import encode_weights, read_weights
from mvseg.detectors.zoo import load_detector, weights_path
from mvseg.errors import InputError, collect_warnings, warn
from mvseg.findings.finding import Finding
from mvseg.pipeline.apply_edits import apply_edits
from mvseg.pipeline.find_in_photos import run_near
from mvseg.pipeline.finish import complete_masks
from mvseg.pipeline.plant import Plant
from mvseg.results.result import Learned
from mvseg.system.file_hash import hash_files
from mvseg.system.running import report_step, timed
from mvseg.training.fine_tune import STEPS, fine_tune
from mvseg.training.view_labels import ViewLabels, label_views
from mvseg.verification.leaf_scores import order_ratings
from mvseg.verification.numbers import CHOICE
from mvseg.verification.picture import is_familiar

ROUNDS = 2  # limit: where nobody says how many; most plants gain nothing from a third one (docs/detector.md)


def learn(
    plant: Plant, *, cache: CachedDetections, corrections: Corrections | None = None, rounds: int | None = None
) -> Plant:
    """Let the detector learn the plant at hand, in the rounds that `RunConfig.learn` asks for.

    A round: labels from the leaves that the views chose, and from the user's edits; the first weights learn these
    (`fine_tune`); the detector looks again, at the same size and at those next to it (`run_near`); the views choose.
    The better one stays, by the agreed area (`rate_pass`), and the next round is at its size. Rounds end when it grows
    by less than `CHOICE.growth`, or with Ctrl-C. Warns (InputWarning) where the views agree about too few leaves.

    Args:
        cache: where the weights lie; rounds that are there already are not learned again.
        rounds: number of rounds that the user asks for on the page. All are learned, and the last weights stay without
            comparison, for the user to judge. None: as many as `RunConfig.learn` says, and `Plant.rating` decides.
    """
    best, areas = plant, [plant.rating.agreed_area]
    try:
        for number in range(1, (_count_rounds(plant) if rounds is None else rounds) + 1):
            with collect_warnings():  # of edits: they are warned of when they are finally applied
                edited = apply_edits(best, corrections)
            chances = edited.instances.probabilities
            photos = plant.opened.photos
            labels = label_views(complete_masks(edited).masks, best.proposals, photos, probabilities=chances)
            if not labels.are_enough:
                warn(Finding("learned_too_few", values={"count": labels.num_leaves, "least": CHOICE.least_leaves}))
                break
            if number == 1 and rounds is None:
                report_step("the detector learns this species from the views; Ctrl-C keeps what is found")
            report_step(f"learning, round {number}: {labels.num_leaves} leaves in {len(labels.leaves)} masks")
            taught = _learn_once(best, labels, cache)
            before, after = best.rating, replace(taught, colors=best.leaf_colors).rating
            areas.append(after.agreed_area)
            if rounds is None and order_ratings([before, after])[0] == 0:
                break
            best = replace(taught, learned=replace(taught.learned, rounds=number))
    except KeyboardInterrupt:
        warn(Finding("learning_interrupted", values={"count": len(areas) - 1}))
    except InputError as error:
        warn(Finding("learning_failed", values={"reason": str(error)}))
    return replace(best, learned=replace(best.learned, agreed_area=tuple(areas)))


def _count_rounds(plant: Plant) -> int:
    """Number of rounds to try. With "auto", none where the detector knows the species: most leaves score well, and its
    own size is the best one. That views hardly agree is no reason: a dense plant that was taught for it lost."""
    opened = plant.opened
    if opened.holds or opened.config.learn == "off":
        return 0
    if opened.config.learn != "auto":
        return opened.config.learn
    return 0 if is_familiar(plant.masks, sure_score=DETECTION.sure_score) and not _is_smaller(plant) else ROUNDS


def _is_smaller(plant: Plant) -> bool:
    detect = plant.opened.config.detect
    _, description = read_weights(weights_path(detect.weights))
    if detect.image_size is not None or description is None:
        return False
    return plant.image_size < min(description.image_size, plant.longest_side) * (1 + DETECTION.size_step) / 2


def _learn_once(plant: Plant, labels: ViewLabels, cache: CachedDetections) -> Plant:
    opened = plant.opened
    with timed("learn"):  # a round begins, also where it was learned before
        path = cache.get(_describe(plant, labels), partial(_fine_tune, plant, labels), _find, kind="learned-")
    config = replace(opened.config, detect=replace(opened.config.detect, weights=str(path)))
    taught = run_near(replace(plant, opened=replace(opened, config=config)), cache=cache)
    learned = Learned(weights=_at_size(path, taught.image_size))
    return replace(taught, opened=opened, learned=learned, colors=None, findings=())


def _find(path: Path) -> Path | None:
    return path if path.is_file() else None


def _at_size(path: Path, size: int) -> bytes:
    weights, description = read_weights(path)
    assert description is not None, "expected weights with a description, as `_fine_tune` writes them"
    return encode_weights(weights, replace(description, image_size=size))


def _fine_tune(plant: Plant, labels: ViewLabels) -> bytes:
    detect = plant.opened.config.detect
    _, description = read_weights(weights_path(detect.weights))
    if description is None or len(description.categories) != 1:
        raise InputError(f"{detect.weights} tells several kinds of objects apart, expected a detector of leaves alone")
    detector = load_detector(detect.weights, image_size=plant.image_size).to(_device())
    learned = fine_tune(detector, plant.opened.photos, labels, boxes=plant.boxes)
    halves = {name: each.half() if each.is_floating_point() else each for name, each in learned.state_dict().items()}
    return encode_weights(halves, replace(description, image_size=plant.image_size))


def _device() -> str:
    return "cuda" if torch.cuda.is_available() else "cpu"


def _describe(plant: Plant, labels: ViewLabels) -> dict[str, Any]:
    shown = [each.regions for each in (labels.leaves, labels.doubtful)]
    tensors = [plant.boxes, *(part for each in shown for part in (each.view_index, each.boxes, each.crops))]
    digest = hashlib.sha256(b"".join(each.cpu().numpy().tobytes() for each in tensors))
    digest.update(np.ascontiguousarray(labels.colors).tobytes())
    return {
        "weights": hash_files(Path(weights_path(plant.opened.config.detect.weights))),
        "labels": digest.hexdigest(),
        "photos": [describe_photo(plant.opened.photos, view) for view in range(len(plant.scene.views))],
        "size": plant.image_size,
        "steps": STEPS,
        "code": code_hash(),
        "torch": torch.__version__,
        "device": _device(),
    }
