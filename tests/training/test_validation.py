"""A detector run over samples."""

from __future__ import annotations

from pathlib import Path

import torch

from mvseg.detectors.run import detect
from mvseg.training.data import list_samples, read_sample
from mvseg.training.loop import detect_and_label
from tiny_training import build_tiny, write_photos


def test_detector_is_run_on_the_chosen_samples(tmp_path: Path) -> None:
    samples, model = list_samples(*write_photos(tmp_path, 4)), build_tiny().eval()
    truth, detections = detect_and_label(model, samples, [0, 2])
    assert [annotation["image_id"] for annotation in truth] == [2, 2]  # photo 0 is empty
    expected = []
    for index in (0, 2):
        with torch.no_grad():
            found, _ = detect(model, read_sample(samples.samples[index]).photo / 255)
        expected += [(index, score) for score in found["scores"].tolist()]
    assert {index for index, _ in expected} == {0, 2}
    assert [(annotation["image_id"], annotation["score"]) for annotation in detections] == expected
