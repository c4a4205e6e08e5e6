"""What users mix up in Python is one sentence; what they print is one line."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch

from mvseg import (
    DetectConfig,
    MatchConfig,
    ReconstructConfig,
    epipolar_map,
    fit_surfaces,
    load_scene,
    match_regions,
    regions_from_label_maps,
    run_scene,
)
from mvseg.errors import InputError
from mvseg.regions import Regions
from mvseg.scene import Scene


@pytest.mark.parametrize(
    ("call", "sentence"),
    [
        (lambda r, s: match_regions(s.cameras, r), "regions is a Cameras, expected Regions|cameras is a Regions"),
        (lambda r, s: match_regions(r, s), r"cameras is a Scene, expected Cameras \(of a scene: scene.cameras\)"),
        (lambda r, s: fit_surfaces(r, r.labels.numpy(), s.cameras), "instance_ids is a ndarray, expected Tensor"),
        (lambda r, s: epipolar_map(r, s.cameras, view=0, xy=[1, 2]), "xy is a list, expected Tensor"),
        (lambda r, s: match_regions(r, s.cameras, "nview"), r"config is a str, expected MatchConfig \(MatchConfig\("),
        (lambda r, s: run_scene(s), r"folder is a Scene, expected Path | str \(the place of a folder or a file\)"),
        (lambda r, s: regions_from_label_maps([torch.zeros(4, 5)]), r"view 0: .*\(4, 5\) float32, expected an integer"),
        (lambda r, s: regions_from_label_maps([np.zeros((4, 5))]), r"a ndarray \(4, 5\) float64, expected an integer"),
        (lambda r, s: load_scene(None), "folder is a NoneType, expected Path | str"),
    ],
)
def test_arguments_of_another_class_are_refused(
    call: Callable[[Any, Any], object], sentence: str, demo_scene: Scene, demo_regions: Regions
) -> None:
    with pytest.raises(InputError, match=sentence):
        call(demo_regions, demo_scene)


@pytest.mark.parametrize(
    ("make", "sentence"),
    [
        (lambda: MatchConfig(method="nviews"), "match.method is 'nviews', expected one of auto, nview, one-per-view"),  # type: ignore[arg-type]
        (lambda: DetectConfig(crop="on"), "detect.crop is 'on', expected one of auto, off"),  # type: ignore[arg-type]
        (lambda: ReconstructConfig(shape="mesh"), "reconstruct.shape is 'mesh', expected one of surface"),  # type: ignore[arg-type]
    ],
)
def test_a_choice_that_there_is_not_is_refused(make: Callable[[], object], sentence: str) -> None:
    with pytest.raises(InputError, match=sentence):
        make()
