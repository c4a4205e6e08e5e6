"""Whatever a file says, a reader accepts it or raises InputError: no other exception, no crash, no end of memory.

The default run tries a few hundred fixed edits. `make fuzz` tries thousands of new ones for ten minutes
(MVSEG_FUZZ_EXAMPLES for each reader); Hypothesis prints how to repeat a failure, which then goes into PAST_FAILURES.
"""

from __future__ import annotations

import copy
import json
import os
import shutil
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

from fuzz.mutations import byte_edits, edit_bytes, edit_json, json_edits
from fuzz.readers import (
    BOP,
    CALIBRATION,
    COCO,
    CONFIG,
    LABELME,
    METASHAPE,
    RESULT,
    RESULT_RUN,
    RIG,
    RUN,
    TRAIN_CONFIG,
    TRANSFORMS,
    TURNTABLE,
    YOLO_NAMES,
    Reader,
    readers,
    write_files,
)
from mvseg.errors import InputError, InputWarning

EXAMPLES = int(os.environ.get("MVSEG_FUZZ_EXAMPLES", "10"))
IS_LONG = "MVSEG_FUZZ_EXAMPLES" in os.environ
NAMES = [
    "rig", "transforms", "turntable", "bop", "metashape", "calibration", "colmap text", "colmap binary", "label png",
    "photos", "photos of a scene", "label images", "label images in TIFF", "one image per mask", "arrays",
    "labelme", "sam", "yolo", "coco results", "coco", "coco for training", "config", "training config", "safetensors",
    "checkpoint", "result", "run",
]  # fmt: skip
SPARE = 4 << 30  # bytes that a reader may ask for on top of what the tests have


@pytest.fixture(scope="module")
def all_readers(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Reader]:
    found = readers(tmp_path_factory.mktemp("readers") / "models")
    assert list(found) == NAMES
    return found


@pytest.fixture(autouse=True, scope="module")
def little_memory() -> Iterator[None]:
    """What asks for far too much gets a MemoryError, which is no InputError."""
    resource = pytest.importorskip("resource")
    pages = int(Path("/proc/self/statm").read_text().split()[0]) if Path("/proc/self/statm").exists() else 0
    earlier = resource.getrlimit(resource.RLIMIT_AS)
    if pages:
        resource.setrlimit(resource.RLIMIT_AS, (pages * os.sysconf("SC_PAGE_SIZE") + SPARE, earlier[1]))
    yield
    resource.setrlimit(resource.RLIMIT_AS, earlier)


def is_accepted(reader: Reader, folder: Path, files: dict[str, Any]) -> bool:
    """Whether the reader accepts the files; the law is that it can only do so or raise InputError."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    write_files(folder, reader.others | reader.whole | files)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", InputWarning)
        try:
            reader.read(folder)
        except InputError:
            return False
    return True


@pytest.mark.parametrize("name", NAMES)
def test_whole_files_are_accepted(name: str, all_readers: dict[str, Reader], tmp_path: Path) -> None:
    assert is_accepted(all_readers[name], tmp_path / "files", {})


@pytest.mark.parametrize("name", NAMES)
@settings(
    max_examples=EXAMPLES,
    derandomize=not IS_LONG,
    database=None,
    deadline=None,
    print_blob=True,
    phases=[Phase.generate],  # nobody waits for a smaller example
    suppress_health_check=list(HealthCheck),
)
@given(data=st.data())
def test_broken_files_are_refused_or_accepted(
    name: str, all_readers: dict[str, Reader], tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    reader = all_readers[name]
    file = data.draw(st.sampled_from(sorted(reader.whole)), "file")
    whole = reader.whole[file]
    if isinstance(whole, bytes):
        broken = edit_bytes(whole, data.draw(byte_edits, "edits"))
    else:
        broken = edit_json(whole, data.draw(json_edits, "edits"))
        broken = edit_bytes(broken, data.draw(st.just([]) | byte_edits, "bytes"))
    is_accepted(reader, tmp_path_factory.getbasetemp() / "fuzzed", {file: broken})


def with_value(document: Any, *path: Any, value: Any) -> bytes:
    """A JSON document in which one value is another."""
    owner = document = copy.deepcopy(document)
    for key in path[:-1]:
        owner = owner[key]
    owner[path[-1]] = value
    return json.dumps(document).encode()


FIRST = ("annotations", 0)
PAST_FAILURES: list[tuple[str, str, bytes]] = [
    *(
        ("coco for training", "masks.json", with_value(COCO, *FIRST, "segmentation", value=value))
        for value in ([[1e300, 1, 2, 3, 4, 5]], {"size": [1 << 20, 1 << 20], "counts": [1 << 40]}, "x", 3)
    ),
    ("coco for training", "masks.json", with_value(COCO, "images", 0, "file_name", value="../x")),
    ("coco for training", "masks.json", with_value(COCO, *FIRST, "category_id", value=[])),
    ("result", "instances.json", with_value(RESULT, *FIRST, "instance_id", value=2**63)),
    ("result", "instances.json", with_value(RESULT, "images", 0, "name", value="../../x")),
    ("result", "instances.json", with_value(RESULT, "images", 0, "name", value="\0")),
    ("result", "instances.json", with_value(RESULT, *FIRST, "segmentation", "counts", value=[10**30])),
    ("result", "run.json", with_value(RESULT_RUN, "format", value=3)),
    ("result", "run.json", with_value(RESULT_RUN, "edits", value=[3])),
    ("result", "surfaces.npz", b"PK"),
    ("result", "traits.csv", b"plant,leaf\n"),
    ("rig", "cameras.json", with_value(RIG, "views", 0, "K", value=[[1e300, 0, 1], [0, 1e300, 1], [0, 0, 1]])),
    ("rig", "cameras.json", with_value(RIG, "views", 0, "t", value=[1e300, 0, 1])),
    ("calibration", "camera.yaml", CALIBRATION + b"a: &a [x]\nb: *a\n"),
    ("calibration", "camera.yaml", CALIBRATION + b"a: " + b"[" * 20_000),
    ("yolo", "masks/data.yaml", YOLO_NAMES + b"a: &a [x]\nb: *a\n"),
    ("turntable", "turntable.json", with_value(TURNTABLE, "axis", "point", value=[1.7e308, 1.7e308, 0])),
    ("transforms", "transforms.json", with_value(TRANSFORMS, "frames", 0, "transform_matrix", value=[[1e300] * 4] * 3)),
    ("metashape", "cameras.xml", METASHAPE.replace(b"1 0 0 10 0 1 0 0", b"1e300 0 0 1e300 0 1 0 0")),
    ("labelme", "masks/000.json", with_value(LABELME, "shapes", 2, "points", value=[[-1e308, 0], [1.5e308, 1.5e308]])),
    ("bop", "scene_camera.json", with_value(BOP, "0", "cam_t_w2c", value=[1e300, 0, 1])),
    ("config", "run.yaml", CONFIG + b"# \xff"),
    ("config", "run.yaml", b"match: {seed: " + b"1" * 5000 + b"}"),
    ("config", "run.yaml", b"match: " + b"[" * 20_000),
    ("config", "run.yaml", b"a: &a [x]\nb: &b [*a, *a]\n"),
    ("config", "run.yaml", b"match:\n  num_restarts:\n"),
    ("config", "run.yaml", b"coco_crowd:\n"),
    ("config", "run.yaml", b"match:\n"),
    ("training config", "train.yaml", TRAIN_CONFIG + b"epochs:\n"),
    ("training config", "train.yaml", TRAIN_CONFIG + b"scale_range: null\n"),
    ("run", "run.json", b"{}"),
    ("run", "run.json", with_value(RUN, "files", value=[3])),
]


@pytest.mark.parametrize(("name", "file", "content"), PAST_FAILURES, ids=lambda value: str(value)[-40:])
def test_past_failures_are_refused(
    name: str, file: str, content: bytes, all_readers: dict[str, Reader], tmp_path: Path
) -> None:
    assert not is_accepted(all_readers[name], tmp_path / "files", {file: content})
