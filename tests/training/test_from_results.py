"""Results as training samples: what is a label, what is ignored, and what is refused."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from PIL import Image

from mvseg.crop import Crop
from mvseg.demo import demo_scene
from mvseg.errors import InputError
from mvseg.formats.label_png import read_labels
from mvseg.formats.scene_folder import load_scene
from mvseg.masks import Masks, Origin
from mvseg.matching.result import Matching, MatchReport
from mvseg.regions import stack_regions
from mvseg.results.folder import save_result
from mvseg.results.result import Instances, Result
from mvseg.training.data import list_results, read_sample
from scene_folders import edit_rig
from tiny_training import make_config

KINDS = (  # instance id, match score, origin
    (1, 0.9, Origin.DETECTED),
    (2, 0.2, Origin.DETECTED),
    (-1, 0.9, Origin.DETECTED),
    (3, 0.9, Origin.OTHER_VIEWS),
    (3, 0.1, Origin.CORRECTED),
    (4, 0.9, Origin.DETECTED),
)
PROBABILITIES = {1: 0.9, 2: 0.9, 3: 0.2, 4: 0.3}


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    return shutil.copytree(demo_scene(), tmp_path / "scene")


@pytest.fixture
def result(scene: Path, tmp_path: Path) -> Path:
    return write_squares(tmp_path / "out", scene, lefts=range(0, 240, 40))


def write_squares(folder: Path, scene: Path, *, lefts: Sequence[int], kinds: Sequence[Any] = KINDS) -> Path:
    """A result with a mask of each kind in the first photo of the shipped plant, and none in the others."""
    pixels = torch.ones(20, 20, dtype=torch.bool)
    regions = stack_regions([(0, Crop((left, 10, left + 20, 30), pixels), 0) for left in lefts], 9)
    ids, scores, origins = (torch.tensor([kind[column] for kind in kinds]) for column in range(3))
    masks = replace(Masks.of(regions, ids, scores), origin=origins)
    matching = Matching(masks, MatchReport("nview", has_probabilities=True))
    known = Instances(probabilities={each: PROBABILITIES[each] for each in ids[ids > 0].tolist()})
    save_result(Result(scene=load_scene(scene), matching=matching, instances=known), folder, report=False)
    return folder


def test_sure_and_corrected_masks_are_labels_and_others_are_ignored(result: Path) -> None:
    samples = list_results(result)
    assert [sample.name for sample in samples.samples] == [f"out/00{view}.jpg" for view in range(9)]
    labelled = read_sample(samples.samples[0])
    assert labelled.classes.tolist() == [1, 1]
    is_label = (labelled.layers > 0).any(0)[20]
    assert [bool(is_label[40 * n + 5]) for n in range(6)] == [True, False, False, False, True, False]
    assert [bool(labelled.ignore[20, 40 * n + 5]) for n in range(6)] == [False, True, True, True, False, True]
    assert len(read_sample(samples.samples[1]).classes) == 0
    assert len(list_results(result.parent)) == 9  # of a folder that holds results


def test_a_doubtful_mask_hides_no_part_of_a_sure_one(scene: Path, tmp_path: Path) -> None:
    result = write_squares(tmp_path / "out", scene, lefts=(0, 10), kinds=KINDS[:2])  # the first one ends at 20
    labelled = read_sample(list_results(result).samples[0])
    assert bool((labelled.layers[:, 20, :20] == 1).any(0).all())
    assert labelled.ignore[20, :40].tolist() == [False] * 20 + [True] * 10 + [False] * 10


def test_masks_of_photos_with_a_lens_are_those_of_the_photo(scene: Path, tmp_path: Path) -> None:
    edit_rig(scene, 0, distortion=[-0.3, 0.1, 0.0, 0.0, 0.0])
    sample = list_results(write_squares(tmp_path / "out", scene, lefts=(40,), kinds=KINDS[:1])).samples[0]
    labelled = read_sample(sample)
    saved = read_labels(tmp_path / "out" / "labels" / "000.png") == 1
    assert bool(((labelled.layers > 0).any(0).numpy() == saved).all())
    assert saved[10:30, 40:60].mean() < 0.9  # moved by the lens


def test_what_cannot_be_learned_from_is_named(result: Path, scene: Path, tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match="holds no result"):
        list_results(tmp_path / "empty")
    unsure = write_squares(tmp_path / "unsure", scene, lefts=(0,), kinds=KINDS[1:2])
    with pytest.raises(InputError, match="no mask that is sure enough"):
        list_results(unsure)
    (scene / "images" / "001.jpg").unlink()
    with pytest.raises(InputError, match=r"its photo \S+001\.jpg is gone"):
        list_results(result)
    (result / "instances.json").write_text("{")
    with pytest.raises(InputError, match="not a whole JSON file"):
        list_results(result)


def test_changed_photos_and_nothing_to_learn_from_are_refused(result: Path, scene: Path) -> None:
    photo = scene / "images" / "000.jpg"
    Image.open(photo).resize((320, 480)).save(photo)
    with pytest.raises(InputError, match="its COCO entry says 640 x 480"):
        read_sample(list_results(result).samples[0])
    assert make_config(Path(), Path(), photos=None, labels=None, from_results=result).from_results == result
    with pytest.raises(InputError, match="neither photos nor from_results"):
        make_config(Path(), Path(), photos=None, labels=None)
