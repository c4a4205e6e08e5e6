"""JSON files that people write: a fault is one sentence, however many there are."""

from __future__ import annotations

import json
import tracemalloc
from pathlib import Path

import pytest

from mvseg.errors import InputError
from mvseg.formats.coco import CocoFile
from mvseg.formats.json_file import read_json
from mvseg.formats.rig import read_rig
from mvseg.formats.transforms_json import read_transforms
from mvseg.formats.turntable import read_turntable

FAULTS = 20_000


@pytest.mark.parametrize(
    ("content", "key"),
    [
        ({"images": [], "annotations": [{}] * FAULTS}, r"annotations\[0\]\.image_id"),
        ({"images": [3] * FAULTS, "annotations": []}, r"images\[0\]"),
    ],
)
def test_the_first_of_many_faults_is_named(content: object, key: str, tmp_path: Path) -> None:
    path = tmp_path / "masks.json"
    path.write_text(json.dumps(content))
    tracemalloc.start()
    with pytest.raises(InputError, match=rf"masks\.json: {key}: "):
        read_json(path, CocoFile)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 200 * FAULTS  # the file itself; a description of each fault takes 600 bytes


def test_cameras_stop_at_the_first_fault_too(tmp_path: Path) -> None:
    path = tmp_path / "cameras.json"
    path.write_text(json.dumps({"format": "mvseg-rig/1", "views": [1] * FAULTS}))
    with pytest.raises(InputError, match=r"views\[0\]: Input should be a valid dictionary$"):
        read_rig(path)
    path.write_text("[]")
    with pytest.raises(InputError, match=r"cameras.json: Input should be a valid dictionary$"):
        read_rig(path)
    path.write_text(json.dumps({"frames": [1] * FAULTS}))
    with pytest.raises(InputError, match=r"frames\[0\]: Input should be"):
        read_transforms(path)
    axis = {"point": [0, 0, 0], "direction": [0, 0, 1]}
    table = {"format": "mvseg-turntable/1", "axis": axis, "cameras": {}, "views": [1] * FAULTS}
    path.write_text(json.dumps(table))
    with pytest.raises(InputError, match=r"views\[0\]: Input should be"):
        read_turntable(path)


@pytest.mark.parametrize("number", [2**63, -(2**63) - 1, 10**30])
def test_ids_that_no_tensor_holds_are_refused(number: int, tmp_path: Path) -> None:
    path = tmp_path / "masks.json"
    path.write_text(json.dumps({"images": [], "annotations": [{"id": number, "image_id": 1}]}))
    with pytest.raises(InputError, match=r"annotations\[0\]\.id\S*: Input should be (less|greater) than"):
        read_json(path, CocoFile)
