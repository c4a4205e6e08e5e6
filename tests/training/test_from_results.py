"""Results as training samples: what is a label, what is ignored, and what is refused."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mvseg.demo import demo_scene
from mvseg.errors import InputError
from mvseg.formats.coco import encode_mask
from mvseg.training.data import read_sample
from mvseg.training.from_results import list_results
from tiny_training import make_config

WIDTH, HEIGHT = 640, 480


def square(left: int) -> Any:
    mask = np.zeros((HEIGHT, WIDTH), np.uint8)
    mask[10:30, left : left + 20] = 1
    return encode_mask(mask)


@pytest.fixture
def result(tmp_path: Path) -> Path:
    """One photo of the shipped plant with a mask of each kind, and one without masks."""
    scene, folder = tmp_path / "scene", tmp_path / "out"
    shutil.copytree(demo_scene(), scene)
    folder.mkdir()
    images = [
        {"id": n + 1, "file_name": f"00{n}.jpg", "name": f"00{n}", "width": WIDTH, "height": HEIGHT} for n in range(2)
    ]
    kinds: list[dict[str, Any]] = [
        {"instance_id": 1, "match_score": 0.9},
        {"instance_id": 2, "match_score": 0.2},
        {"instance_id": -1, "match_score": 0.9},
        {"instance_id": 3, "match_score": 0.9, "from_other_views": True},
        {"instance_id": 3, "match_score": 0.1, "corrected": "outline"},
    ]
    masks = [
        {"id": n + 1, "image_id": 1, "category_id": 1, "segmentation": square(40 * n), **kind}
        for n, kind in enumerate(kinds)
    ]
    (folder / "instances.json").write_text(json.dumps({"images": images, "annotations": masks}))
    (folder / "run.json").write_text(json.dumps({"config": {"scene": str(scene)}}))
    return folder


def change(result: Path, **changes: Any) -> None:
    content = json.loads((result / "instances.json").read_text())
    (result / "instances.json").write_text(json.dumps(content | changes))


def test_sure_and_corrected_masks_are_labels_and_others_are_ignored(result: Path) -> None:
    samples = list_results(result)
    assert [sample.name for sample in samples.samples] == ["out/000.jpg", "out/001.jpg"]
    labelled = read_sample(samples.samples[0])
    assert labelled.classes.tolist() == [1, 1]
    is_label = (labelled.layers > 0).any(0)[20]
    assert [bool(is_label[40 * n + 5]) for n in range(5)] == [True, False, False, False, True]
    assert [bool(labelled.ignore[20, 40 * n + 5]) for n in range(5)] == [False, True, True, True, False]
    assert len(read_sample(samples.samples[1]).classes) == 0
    assert len(list_results(result.parent)) == 2  # of a folder that holds results


def test_a_doubtful_mask_hides_no_part_of_a_sure_one(result: Path) -> None:
    masks = json.loads((result / "instances.json").read_text())["annotations"]
    masks[1]["segmentation"] = square(10)  # the first one ends at 20
    change(result, annotations=masks)
    labelled = read_sample(list_results(result).samples[0])
    assert bool((labelled.layers[:, 20, :20] == 1).any(0).all())
    assert labelled.ignore[20, :40].tolist() == [False] * 20 + [True] * 10 + [False] * 10


def test_what_cannot_be_learned_from_is_named(result: Path, tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match="holds no result"):
        list_results(tmp_path / "empty")
    (tmp_path / "scene" / "images" / "001.jpg").unlink()
    with pytest.raises(InputError, match=r"its photo 001\.jpg is not in"):
        list_results(result)
    shutil.rmtree(tmp_path / "scene")
    with pytest.raises(InputError, match=r"its scene .* is gone"):
        list_results(result)
    change(result, annotations=[])
    with pytest.raises(InputError, match="no mask that is sure enough"):
        list_results(result)
    change(result, annotations=[{"image_id": 1}])
    with pytest.raises(InputError, match="no result of this version"):
        list_results(result)


def test_changed_photos_are_refused(result: Path) -> None:
    images = json.loads((result / "instances.json").read_text())["images"]
    change(result, images=[image | {"width": 320} for image in images])
    with pytest.raises(InputError, match="its COCO entry says 320 x 480"):
        read_sample(list_results(result).samples[0])


def test_something_must_be_learned_from(result: Path) -> None:
    assert make_config(Path(), Path(), photos=None, labels=None, from_results=result).from_results == result
    with pytest.raises(InputError, match="neither photos nor from_results"):
        make_config(Path(), Path(), photos=None, labels=None)
