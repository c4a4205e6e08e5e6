"""What a worker does with one scene: only what has not been done with the same inputs and options."""

from __future__ import annotations

import json
import os
import re
import shutil
import threading
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image, ImageOps

from mvseg.batch import work as batch_work
from mvseg.batch.scene_list import BatchScene
from mvseg.batch.status import Status, read_status, scene_state
from mvseg.batch.work import Finished, work_on_scene
from mvseg.config import RunConfig
from mvseg.detection import proposals as proposing
from mvseg.detection.config import DetectConfig
from mvseg.matching.config import MatchConfig
from mvseg.system.atomic import lock_folder
from scene_folders import edit_rig, write_scene

CONFIG = RunConfig(reconstruct=None, report=False)  # ids only: these tests look at no shape and no page


@pytest.fixture
def scene(tmp_path: Path) -> BatchScene:
    folder = write_scene(tmp_path / "plant", 3)
    return BatchScene(name="p", folder=folder, masks=Path("masks"), beside=tmp_path, carried={"plant": "", "time": ""})


def touch(scene: BatchScene, name: str) -> None:
    """The same content at another time."""
    path = scene.folder / name
    os.utime(path, ns=(1, 1))


def repaint(scene: BatchScene) -> None:
    path = scene.folder / "images" / "002.png"
    ImageOps.invert(Image.open(path)).save(path)


def test_what_is_done_is_kept(scene: BatchScene, tmp_path: Path) -> None:
    out = tmp_path / "out"
    first = work_on_scene(out, CONFIG, scene)
    assert not first.is_kept
    status = first.status
    assert (status.state, status.instances, status.masks, status.views) == ("done", 3, 9, 3)
    assert (status.warnings, status.sentence, status.trace) == ([], "", "")
    assert status.seconds > 0
    assert read_status(scene_state(out, "p")) == status
    written = (out / "p" / "run.json").stat().st_mtime_ns
    assert work_on_scene(out, CONFIG, scene) == Finished(status, is_kept=True)
    (scene.folder / "notes.txt").write_text("no input")
    (scene.folder / "masks" / ".DS_Store").touch()
    assert work_on_scene(out, CONFIG, replace(scene, carried={"plant": "b", "time": "2"})).is_kept
    assert (out / "p" / "run.json").stat().st_mtime_ns == written


CHANGES: list[Callable[[BatchScene, Path], object]] = [
    lambda scene, out: edit_rig(scene.folder, unit="cm"),
    lambda scene, out: repaint(scene),
    lambda scene, out: touch(scene, "images/001.png"),  # its content may be another one
    lambda scene, out: touch(scene, "masks/001.png"),
    lambda scene, out: shutil.copy(scene.folder / "masks" / "000.png", scene.folder / "masks" / "001.png"),
    lambda scene, out: (scene.folder / "masks" / "data.yaml").write_text("names: [leaf]"),
    lambda scene, out: (out / "p" / "run.json").unlink(),
    lambda scene, out: (out / "p" / "labels" / "000.png").unlink(),
    lambda scene, out: (out / "p" / "run.json").write_text('{"files": {}}'),
    lambda scene, out: (scene_state(out, "p") / "status.json").write_text('{"state": "don'),
]


def test_what_has_changed_is_done_again(scene: BatchScene, tmp_path: Path) -> None:
    out, is_done = tmp_path / "out", False
    for number, change in enumerate(CHANGES):
        assert work_on_scene(out, CONFIG, scene).is_kept == is_done, number
        change(scene, out)
        again = work_on_scene(out, CONFIG, scene)
        is_done = again.status.state == "done"
        assert not again.is_kept, number
        if not is_done:  # the result itself was changed by hand
            assert re.search("files that are not a result|not written by mvseg", again.status.sentence), number
            shutil.rmtree(out / "p")


def test_other_options_are_done_again(scene: BatchScene, tmp_path: Path) -> None:
    done = [work_on_scene(tmp_path / "out", CONFIG, scene)]
    for config in (replace(CONFIG, match=MatchConfig(seed=3)), replace(CONFIG, unit="cm")):
        done.append(work_on_scene(tmp_path / "out", config, scene))
    assert [each.is_kept for each in done] == [False, False, False]
    assert len({each.status.key for each in done}) == 3
    assert done[2].status.warnings == ["the cameras are in mm: unit cm without a scale only renames it"]


def test_other_code_does_it_again(scene: BatchScene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for code, is_kept in (("one", False), ("one", True), ("other", False)):
        monkeypatch.setattr("mvseg.batch.work.code_hash", lambda code=code: code)
        assert work_on_scene(tmp_path / "out", CONFIG, scene).is_kept == is_kept


@pytest.mark.slow
def test_detections_are_kept_for_other_options_of_later_stages(
    scene: BatchScene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    looked: list[object] = []
    run_heads = proposing.run_heads

    def count(*arguments: object, **options: object) -> object:
        looked.append(arguments)
        return run_heads(*arguments, **options)  # type: ignore[arg-type]

    monkeypatch.setattr(proposing, "run_heads", count)
    out, scene = tmp_path / "out", replace(scene, masks=None)
    config = replace(CONFIG, detect=DetectConfig(min_score=0.05, image_size=800))  # looks at no other size
    assert not work_on_scene(out, config, scene).is_kept
    assert work_on_scene(out, config, scene).is_kept
    assert len(looked) == 3
    assert not work_on_scene(out, replace(config, match=MatchConfig(seed=3)), scene).is_kept
    more = replace(config, detect=DetectConfig(min_score=0.05, image_size=800, num_iterations=0))
    assert not work_on_scene(out, more, scene).is_kept
    assert len(looked) == 3
    repaint(scene)
    assert not work_on_scene(out, config, scene).is_kept
    assert len(looked) == 3 + 1
    assert not work_on_scene(out, replace(CONFIG, detect=DetectConfig(min_score=0.04, image_size=800)), scene).is_kept
    assert len(looked) == 3 + 1 + 3
    kept = sorted((scene_state(out, "p") / "detections").iterdir())
    assert len(kept) == 3  # what other options left is gone


def test_a_failure_is_a_sentence(scene: BatchScene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out = tmp_path / "out"
    work_on_scene(out, CONFIG, scene)
    earlier = (out / "p" / "run.json").read_bytes()
    for error, sentence, has_trace in (
        (ZeroDivisionError("of\nnothing"), "unexpected ZeroDivisionError in test_work.py, line ", True),
        (MemoryError(), "there is not enough memory (no more is known)", False),
        (OSError(28, "No space left on device", "x.png"), "x.png: No space left on device", False),
    ):

        def fail(*_: object, error: Exception = error, **__: object) -> None:
            raise error

        monkeypatch.setattr(batch_work, "solve_scene", fail)
        status = work_on_scene(out, replace(CONFIG, unit="m"), scene).status
        assert (status.state, bool(status.trace)) == ("failed", has_trace)
        assert status.sentence.startswith(sentence)
        assert "\n" not in status.sentence
        assert read_status(scene_state(out, "p")) == status
        assert (out / "p" / "run.json").read_bytes() == earlier
    monkeypatch.undo()
    assert work_on_scene(out, CONFIG, scene).status.state == "done"


def test_a_scene_that_cannot_be_read_fails_each_time(scene: BatchScene, tmp_path: Path) -> None:
    (scene.folder / "cameras.json").write_text("{")
    for _ in range(2):
        finished = work_on_scene(tmp_path / "out", CONFIG, scene)
        assert finished == Finished(finished.status)
        assert finished.status.sentence.startswith(f"{scene.folder / 'cameras.json'}: not a whole JSON file")


def test_a_scene_waits_until_an_earlier_worker_has_let_go_of_it(scene: BatchScene, tmp_path: Path) -> None:
    """A worker of a cluster goes on after the batch that sent it has been killed."""
    out = tmp_path / "out"
    scene_state(out, "p").mkdir(parents=True)
    found: list[Finished] = []
    thread = threading.Thread(target=lambda: found.append(work_on_scene(out, CONFIG, scene)))
    with lock_folder(scene_state(out, "p")):
        thread.start()
        thread.join(0.2)
        assert not (scene_state(out, "p") / "status.json").exists()
    thread.join()
    assert found[0].status.state == "done"


def test_masks_may_lie_beside_the_table(scene: BatchScene, tmp_path: Path) -> None:
    (scene.folder / "masks").rename(tmp_path / "masks")
    assert work_on_scene(tmp_path / "out", CONFIG, scene).status.masks == 9


def test_corrections_of_a_scene(scene: BatchScene, tmp_path: Path) -> None:
    """A row of the table names them; other edits make the scene anew, and a broken file is its failure alone."""
    corrected, path = replace(scene, corrections=Path("mine.json")), scene.folder / "mine.json"
    rows, columns = np.nonzero(np.array(Image.open(scene.folder / "masks" / "000.png")))
    reject = {"op": "reject", "view": "000", "at": [float(columns[0]) + 0.5, float(rows[0]) + 0.5]}
    for edits, num_masks in (([reject], 8), ([], 9)):
        path.write_text(json.dumps({"format": "mvseg-corrections/1", "edits": edits}), encoding="utf-8")
        finished = work_on_scene(tmp_path / "out", CONFIG, corrected)
        assert (finished.is_kept, finished.status.masks) == (False, num_masks)
        assert work_on_scene(tmp_path / "out", CONFIG, corrected).is_kept
    path.write_text('{"format": "mvseg-corrections/1", "edits": [NaN]}', encoding="utf-8")
    assert work_on_scene(tmp_path / "out", CONFIG, corrected).status.sentence.startswith(f"{path}: edit 1: ")
    path.unlink()
    assert "mine.json: no such corrections" in work_on_scene(tmp_path / "out", CONFIG, corrected).status.sentence


def test_it_computes_on_one_thread(scene: BatchScene, tmp_path: Path) -> None:
    torch.set_num_threads(2)
    work_on_scene(tmp_path / "out", CONFIG, scene)
    assert torch.get_num_threads() == 1


def test_a_status_of_another_kind_counts_as_none(tmp_path: Path) -> None:
    (tmp_path / "status.json").write_text('{"state": "happy", "scene": "x"}')
    assert read_status(tmp_path) is None
    assert read_status(tmp_path / "nothing") is None
    assert Status(state="done", scene="x").peak_mb is None
