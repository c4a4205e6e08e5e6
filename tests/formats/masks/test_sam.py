"""Segment Anything's JSON: overlaps stay, and broken masks are named."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mvseg.errors import InputError
from mvseg.formats.masks.sam import read_sam
from mvseg.formats.run_lengths import encode_mask

MASKS = np.random.default_rng(3).random((3, 20, 30)) > 0.4


def entry(mask: np.ndarray) -> dict[str, Any]:
    """The keys of SamAutomaticMaskGenerator."""
    scores = {"predicted_iou": 0.97, "stability_score": 0.96}
    return {"segmentation": encode_mask(mask), "area": int(mask.sum()), "bbox": [0, 0, 30, 20], **scores}


@pytest.mark.parametrize("is_sa_1b", [False, True])
def test_masks_may_overlap(is_sa_1b: bool, tmp_path: Path) -> None:
    entries = [entry(mask) for mask in MASKS]
    image = {"image_id": 7, "width": 30, "height": 20, "file_name": "sa_7.jpg"}
    content = {"image": image, "annotations": entries} if is_sa_1b else entries
    (tmp_path / "sa_7.json").write_text(json.dumps(content))
    found = read_sam(tmp_path / "sa_7.json", 30, 20)
    np.testing.assert_array_equal([each.mask for each in found], MASKS)
    assert (MASKS[0] & MASKS[1]).any()


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ([entry(MASKS[0]), entry(MASKS[1].T)], "a.json: mask 2: its mask is 20 x 30, expected 30 x 20"),
        ([entry(MASKS[0]) | {"segmentation": "x"}], "a.json: mask 1: its segmentation is neither polygons"),
        ({"masks": []}, "a.json: is JSON of another form, expected labelme's"),
        (7, "a.json: is JSON of another form, expected labelme's"),
        ([1], "a.json: is JSON of another form, expected labelme's"),
    ],
)
def test_bad_files_are_named(content: Any, message: str, tmp_path: Path) -> None:
    (tmp_path / "a.json").write_text(json.dumps(content))
    with pytest.raises(InputError, match=message):
        read_sam(tmp_path / "a.json", 30, 20)
