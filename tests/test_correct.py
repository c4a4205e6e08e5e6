"""`mvseg correct`: a result is served to its own page only, every edit is saved, and what it changes is shown."""

from __future__ import annotations

import http.client
import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import numpy as np
import pytest
import torch

from mvseg.cli import main
from mvseg.config import RunConfig
from mvseg.corrections.file import FORMAT, Corrections, Outline, Reject, load_corrections, name_edits, parse_corrections
from mvseg.corrections.rough_outline import refine_outline
from mvseg.corrections.same_scene import mark_photos, with_marks
from mvseg.detectors.zoo import weights_path
from mvseg.errors import InputError, warn
from mvseg.findings.finding import Finding
from mvseg.masks import Masks, Origin
from mvseg.matching.config import MatchConfig
from mvseg.matching.result import Matching, MatchReport
from mvseg.pipeline.finish import shape_leaves
from mvseg.pipeline.plant import Plant, match_given
from mvseg.pipeline.run_scene import run_scene
from mvseg.reconstruction.config import ReconstructConfig
from mvseg.regions import name_regions, regions_from_label_maps
from mvseg.results.folder import BEFORE_EDITS_FILE
from mvseg.results.result import Instances, Result
from mvseg.runs.one_scene import run_one_scene
from mvseg.runs.recorded_run import read_recorded
from mvseg.runs.request import RunRequest
from mvseg.scene import Scene, View
from mvseg.server import open_result
from mvseg.server.correction_server import Corrector
from mvseg.server.leaf_news import tell_drawn, tell_vanished
from mvseg.server.local_server import CorrectionServer
from mvseg.server.open_result import OpenResult, as_sentence, keep_numbers, open_alone
from mvseg.server.saved_edits import CHANGED
from mvseg.system.file_hash import hash_files
from mvseg.system.running import Cancelled
from room_scene import room_cameras
from scene_folders import write_scene
from served_result import (
    WAIT,
    Lesson,
    SlowLook,
    ask,
    save,
    save_text,
    serve,
    text_of,
    wait_for_news,
    wait_until_computed,
)

Said, Patch = pytest.CaptureFixture[str], pytest.MonkeyPatch


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A result of three balls in four views, ids only."""
    place = tmp_path_factory.mktemp("correct")
    scene = write_scene(place / "balls")
    run_one_scene(RunRequest(scene, scene / "masks", place / "result", RunConfig(reconstruct=None)))
    return place / "result"


@pytest.fixture
def served(folder: Path) -> Iterator[CorrectionServer]:
    (folder / "corrections.json").unlink(missing_ok=True)
    with serve(folder) as server:
        yield server


def middle(opened: OpenResult, row: int) -> tuple[str, list[float]]:
    """A view's name and a point inside one of its masks."""
    regions = opened.saved_result.regions
    rows, columns = np.nonzero(regions.crop(row).numpy())
    x, y = regions.boxes[row, :2].tolist()
    at = [float(x + columns[len(rows) // 2] + 0.5), float(y + rows[len(rows) // 2] + 0.5)]
    return opened.scene.views[int(regions.view_index[row])].name, at


def test_an_edit_is_saved_computed_and_shown(served: CorrectionServer, folder: Path) -> None:
    before = wait_until_computed(served)
    view, at = middle(served.corrector.opened, 0)
    edits = [{"op": "reject", "view": view, "at": at}, {"op": "reject", "view": view, "at": [0.5, 0.5]}]
    status, answer = save(served, edits)
    assert (status, answer["saved"]) == (200, 2)
    assert json.loads((folder / "corrections.json").read_text())["edits"] == edits
    after = wait_until_computed(served)
    assert after["number"] > before["number"]
    assert after["update"]["numMasks"] == before["update"]["numMasks"] - 1
    assert after["outcomes"][0] == ""
    assert "nothing" in after["outcomes"][1]
    save(served, [])
    assert wait_until_computed(served)["update"] == before["update"]


def test_edits_that_another_page_has_changed_are_not_saved_over(served: CorrectionServer, folder: Path) -> None:
    view, at = middle(served.corrector.opened, 0)
    first, second = ([{"op": op, "view": view, "at": at}] for op in ("reject", "confirm"))
    base = name_edits(())
    status, answer = ask(served, "PUT", f"edits?base={base}", text_of(first))
    assert status == 200
    assert ask(served, "PUT", f"edits?base={base}", text_of(first)) == (200, answer)  # its answer was lost
    for place in (f"edits?base={base}", "edits", "edits?base="):
        status, refusal = ask(served, "PUT", place, text_of(second))
        assert status == 409
        assert refusal["problem"] == "Another page has changed the edits since this one was loaded."
    assert json.loads((folder / "corrections.json").read_text())["edits"] == first
    assert ask(served, "PUT", f"edits?base={answer['revision']}", text_of(second))[0] == 200


def test_a_file_that_another_program_has_changed_is_not_saved_over(served: CorrectionServer, folder: Path) -> None:
    view, at = middle(served.corrector.opened, 0)
    mine, theirs = ([{"op": op, "view": view, "at": at}] for op in ("reject", "confirm"))
    state = wait_until_computed(served)
    assert not state["isChanged"]
    (folder / "corrections.json").write_bytes(text_of(theirs))
    assert ask(served, "GET", f"state?after={state['number']}")[1]["isChanged"]
    status, refusal = save(served, mine)
    assert (status, refusal["problem"]) == (409, CHANGED)
    assert ask(served, "POST", "whole")[1]["problem"] == CHANGED
    assert json.loads((folder / "corrections.json").read_text())["edits"] == theirs
    _, page = ask(served, "GET", "")  # a reload goes on from there
    assert json.loads(page.split('id="data">')[1].split("</script>")[0])["correct"]["edits"] == theirs
    assert wait_until_computed(served)["outcomes"] == [""]
    (folder / "corrections.json").write_text("{")
    assert ask(served, "GET", "")[0] == 200
    state = wait_until_computed(served)
    assert "not a whole JSON file" in state["problem"]
    assert save(served, mine)[0] == 409
    (folder / "corrections.json").unlink()
    assert not ask(served, "GET", "state")[1]["isChanged"]


def test_numbers_go_to_most_pixels_and_new_leaves_get_new_ones() -> None:
    maps = [np.kron(np.array([[1, 0, 2], [0, 0, 0], [3, 3, 0]]), np.ones((4, 4), int)) for _ in range(3)]
    masks = Masks.of(regions_from_label_maps(maps))
    first = replace(masks, instance_ids=masks.regions.labels.clone())
    scene = Scene("maps", tuple(View(name, Path(name)) for name in "abc"), room_cameras(3))

    def keep(masks: Masks, shown: Masks | None = None) -> list[int]:
        instances = Instances(probabilities={int(id): float(id) for id in masks.instance_ids.unique() if id > 0})
        result = Result(scene=scene, matching=Matching(masks, MatchReport("test")), instances=instances)
        kept = keep_numbers(result, plant, shown)
        for old, new in zip(masks.instance_ids.tolist(), kept.masks.instance_ids.tolist(), strict=True):
            assert old < 0 or kept.instances.probabilities[new] == old
        return kept.masks.instance_ids.tolist()

    plant: dict[str, int] = {}
    assert keep(first) == first.instance_ids.tolist()
    left = first.select(first.instance_ids != 1)
    assert keep(left) == left.instance_ids.tolist()
    merged = replace(first, instance_ids=first.instance_ids.clamp(max=2))
    assert keep(merged) == torch.where(first.instance_ids == 1, 1, 3).tolist()  # the third is the larger one
    apart = replace(first, instance_ids=torch.arange(1, 10))
    assert len(set(keep(apart))) == 9
    assert max(keep(apart)) == 10  # 2 was given, and is nobody's any more
    for labels in maps:  # as another detector sees them
        labels[0, 0] = labels[0, 8] = labels[8, 0] = 0
    regions = regions_from_label_maps(maps)
    others = Masks.of(regions, 4 - regions.labels)
    plant = {}
    assert keep(first) == first.instance_ids.tolist()
    assert keep(others, shown=first) == regions.labels.tolist()
    assert set(keep(others)) == {*regions.labels.tolist()}


def test_a_page_that_knows_all_waits_for_news(served: CorrectionServer) -> None:
    number = wait_until_computed(served)["number"]
    told = threading.Event()
    waiting = threading.Thread(target=lambda: (ask(served, "GET", f"state?after={number}"), told.set()))
    waiting.start()
    assert not told.wait(0.3)
    save(served, [])
    assert told.wait(WAIT)
    waiting.join()


def test_edits_and_undo_end_where_a_fresh_run_does_bit_for_bit(tmp_path: Path) -> None:
    scene, config = write_scene(tmp_path / "balls", 3), RunConfig(reconstruct=ReconstructConfig(), report=False)
    run_one_scene(RunRequest(scene, scene / "masks", tmp_path / "result", config))
    opened = OpenResult(tmp_path / "result")
    one, other = middle(opened, 1), middle(opened, 5)
    reject, unlike = Reject(view=one[0], at=one[1]), Reject(view=other[0], at=other[1], everywhere=True)
    marks = mark_photos(opened.photos)
    both, half, none = (
        with_marks(Corrections(each), opened.scene, marks) for each in ((reject, unlike), (unlike,), ())
    )
    fresh = run_scene(scene, scene / "masks", config, corrections=half)
    for corrections, expected in ((both, None), (half, fresh), (none, opened.saved_result)):
        shown = opened.recompute(corrections, lambda: False)[0]
        assert len(shown.surfaces or {}) == 2 + (corrections is none)
        assert expected is None or surfaces_by_masks(shown) == surfaces_by_masks(expected)
    with pytest.raises(Cancelled):
        opened.recompute(corrections, lambda: True)


def surfaces_by_masks(result: Result) -> dict[tuple[str, ...], bytes]:
    """{names of a leaf's masks: its surface}: the page keeps the numbers that the result has had."""
    masks, surfaces = result.masks, result.surfaces or {}
    return {
        tuple(sorted(name_regions(masks.regions.select(masks.instance_ids == leaf)))): b"".join(
            each.numpy().tobytes() for each in (surface.coefficients, surface.covariance, surface.iou)
        )
        for leaf, surface in surfaces.items()
    }


def test_what_the_run_warned_of_is_not_said_again(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    opened = OpenResult(folder)
    cut_off, more = (Finding("shape_cut_off", values={"count": count}) for count in (2, 3))
    opened.run = replace(opened.run, record=opened.run.record.model_copy(update={"findings": (cut_off.as_json(),)}))

    def shape(plant: Plant, **_: object) -> Result:
        warn(more)
        for photo in ("1", "2"):
            warn(Finding("dark_photo", photo))
        return shape_leaves(plant)

    monkeypatch.setattr("mvseg.server.open_result.shape_leaves", shape)
    assert opened.recompute(Corrections(), lambda: False)[2] == [
        as_sentence(Finding("dark_photo", photo)) for photo in ("1", "2")
    ]


def test_it_opens_with_what_the_run_knew_before_edits(folder: Path, tmp_path: Path, monkeypatch: Patch) -> None:
    """And computes it where anything has changed: the photos, torch, or the file."""
    place, computed = tmp_path / "result", list[Any]()
    shutil.copytree(folder, place)
    monkeypatch.setattr(open_result, "match_given", lambda opened: computed.append(opened) or match_given(opened))
    plant, said = OpenResult(place)._plant_before
    anew = match_given(OpenResult(place).opened)
    assert (computed, said) == ([], [])
    assert torch.equal(plant.masks.instance_ids, anew.masks.instance_ids)
    assert torch.equal(plant.masks.regions.crops, anew.masks.regions.crops)
    assert plant.disagreement == anew.disagreement
    with monkeypatch.context() as patch:
        patch.setattr(torch, "__version__", "0.0")
        assert len(OpenResult(place)._plant_before[0].masks) == len(plant.masks)
    opened = OpenResult(place)
    opened._changes.append(Finding("input_changed", "masks"))
    assert len(opened._plant_before[0].masks) == len(plant.masks)
    (place / BEFORE_EDITS_FILE).write_bytes(b"another")
    assert len(OpenResult(place)._plant_before[0].masks) == len(plant.masks)
    assert len(computed) == 3


def test_only_its_own_page_is_answered(served: CorrectionServer) -> None:
    status, page = ask(served, "GET", "")
    assert status == 200
    assert "connect-src 'self'" in page
    host = urlsplit(served.address).netloc
    assert ask(served, "GET", "state", Origin=f"http://{host}")[0] == 200
    for place, headers in (
        ("/", {}), ("/state", {}), ("/wrong/", {}), ("/wrong/state?after=0", {}),
        ("state", {"Host": "leaf.example"}), ("state", {"Host": f"localhost:{served.server_port}"}),
        ("state", {"Origin": "https://leaf.example"}), ("state", {"Origin": "null"}),
    ):  # fmt: skip
        status, answer = ask(served, "GET", place, **headers)
        assert status == 403, (place, headers)
        assert served.token not in answer["problem"]
    assert ask(served, "PUT", "edits", text_of([]), Origin="http://127.0.0.1:1")[0] == 403
    assert ask(served, "GET", "../run.json")[0] == 404
    with socket.create_connection(served.server_address) as raw:
        raw.sendall(f"GET http://[ HTTP/1.1\r\nHost: {host}\r\n\r\n".encode())
        assert raw.recv(12) == b"HTTP/1.1 403"
    assert served.server_address[0] == "127.0.0.1"


@pytest.mark.parametrize(
    "body",
    [b"", b"{", b"[" * 100_000, b"\xff\xfe", b"null", b'{"format": "mvseg-corrections/1", "edits": [NaN]}',
     b'{"format": "mvseg-corrections/1", "edits": [{"op": "reject", "view": "0", "at": [1e999, 1]}]}',
     b'{"format": "mvseg-corrections/1", "edits": [{"op": "<script>"}]}', b"9" * 10_000],
)  # fmt: skip
def test_a_hostile_body_gets_a_sentence_and_changes_nothing(
    served: CorrectionServer, folder: Path, body: bytes
) -> None:
    save(served, [])
    before = (folder / "corrections.json").read_bytes()
    for status, answer in (save_text(served, body), ask(served, "POST", "outline", body)):
        assert status == 400
        assert answer["problem"]
        assert "Traceback" not in answer["problem"]
    assert (folder / "corrections.json").read_bytes() == before


def test_a_body_that_is_too_large_is_not_read(served: CorrectionServer) -> None:
    status, answer = ask(served, "PUT", "edits", b"{}", Content_Length=str(10**12))
    assert status == 413
    assert "64 MiB" in answer["problem"]


def test_an_edit_that_cannot_be_saved_says_so(served: CorrectionServer, folder: Path, monkeypatch: Patch) -> None:
    def refuse(*_: object) -> None:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr("mvseg.server.saved_edits.write_corrections", refuse)
    status, answer = save(served, [])
    assert status == 500
    assert answer["problem"] == f"{folder}: the edit could not be saved (Permission denied)"


def test_the_newest_edits_win(folder: Path) -> None:
    """Edits that come while others are computed stop these, and nobody waits for them."""
    corrector = Corrector(OpenResult(folder))
    seen: list[int] = []
    base = name_edits(())

    def recompute(corrections: Corrections, is_old: Any) -> Any:
        seen.append(len(corrections.edits))
        if len(seen) == 1:
            corrector.save(text_of([{"op": "reject", "view": "x", "at": [1, number]} for number in range(3)]), base)
        if is_old():
            raise Cancelled
        corrector.close()
        raise InputError("stop")

    corrector.opened.recompute = recompute  # type: ignore[method-assign]
    corrector.compute()
    assert seen == [0, 3]
    assert corrector.page_state.problem == "stop"
    (folder / "corrections.json").unlink()


def test_what_takes_long_is_told_step_by_step(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    look, told, state = SlowLook(monkeypatch), ["", "detection: view 1 of 2", "detection: view 2 of 2"], {"number": 0}
    with serve(folder) as server:
        for step, go_on in zip(told[1:], look.go_on, strict=True):
            while (state := wait_for_news(server, state))["doing"] != step:
                assert state["doing"] in told
            assert (state["isComputing"], state["update"]) == (True, None)
            go_on.set()
        state = wait_until_computed(server)
    assert state["doing"] == ""
    assert state["update"]


def test_a_second_process_is_told(folder: Path) -> None:
    message = "another mvseg correct has this result open"
    with open_alone(folder), pytest.raises(InputError, match=message), open_alone(folder):
        pass
    with open_alone(folder):
        pass


def test_results_that_cannot_be_corrected(folder: Path, tmp_path: Path) -> None:
    run = json.loads((folder / "run.json").read_text())

    def problem_of(change: dict[str, Any], **config: Any) -> str:
        (tmp_path / "run.json").write_text(json.dumps(run | {"config": run["config"] | config} | change))
        with pytest.raises(InputError) as caught:
            OpenResult(tmp_path)
        return str(caught.value)

    assert "the scene of this result is gone" in problem_of({}, scene=str(tmp_path / "nowhere"))
    assert "the masks of this result are gone" in problem_of({}, masks=str(tmp_path / "nowhere"))
    for options in ({"sparkle": 1}, {"match": {"sparkle": 1}}, {"match": {"method": 7}}):
        assert "options that this version does not have" in problem_of({"mvseg": "9.9"}, **options)
    assert "does not say which scene" in problem_of({"config": {}})
    assert "run.json: config: " in problem_of({"config": []})
    (tmp_path / "run.json").write_text("{")
    with pytest.raises(InputError, match="not a whole JSON file"):
        OpenResult(tmp_path)
    earlier = run["config"] | {"corrections": "corrections.json"}  # a run with corrections can be corrected again
    (tmp_path / "run.json").write_text(json.dumps(run | {"code": "other", "mvseg": "0.0", "config": earlier}))
    notice = OpenResult(tmp_path).notice
    assert notice.startswith("What you see is computed anew. This result was made by other code (mvseg 0.0;")
    assert OpenResult(folder).opened.config.match == MatchConfig()


GONE_SAID = [
    "its poses were refined by the masks, and will be those of the scene",
    "made with another min. number of photos",
    "masks of two leaves were cut in two, and will stay whole",
    "its colours were corrected by a colour card, and will be those of the photos",
]
USUAL = {"refine_poses": False, "split_merged": False, "detect": {"min_views": 2}}  # as everybody had them
OTHER = {"refine_poses": True, "split_merged": True, "detect": {"min_views": 1}, "color_card": "find"}


@pytest.mark.parametrize("options", [USUAL, OTHER])
def test_a_result_made_with_options_that_are_gone(
    options: dict[str, Any], folder: Path, tmp_path: Path, capsys: Said
) -> None:
    out = shutil.copytree(folder, tmp_path / "result")
    run = json.loads((out / "run.json").read_text())
    traits = {"unit": "mm", "up": None, "colors": [{"views": "*", "photo": "card.png"}]}
    (out / "run.json").write_text(json.dumps(run | {"config": run["config"] | options, "traits": traits}))
    assert main(["infer", "--again", str(out), "--out", str(tmp_path / "new"), "--quiet"]) == 0
    said = capsys.readouterr().err
    assert [each for each in GONE_SAID if each in said] == (GONE_SAID if options is OTHER else [])


def test_a_folder_that_cannot_be_written_to(folder: Path, monkeypatch: Patch, capsys: Said) -> None:
    monkeypatch.setattr(os, "access", lambda *_: False)  # whoever runs the tests
    assert main(["correct", str(folder), "--no_browser"]) == 2
    said = capsys.readouterr().err
    assert f"{folder}: cannot be written to, so corrections would be lost; expected a copy of your own" in said


def test_saved_corrections_that_are_broken_are_not_written_over(folder: Path) -> None:
    path = folder / "corrections.json"
    path.write_text('{"format": "mvseg-corrections/1", "edits": [NaN]}', encoding="utf-8")
    with pytest.raises(InputError, match="edit 1: Input should be a valid dictionary"):
        Corrector(OpenResult(folder))
    assert "NaN" in path.read_text(encoding="utf-8")
    path.unlink()


def test_photos_that_are_gone(tmp_path: Path) -> None:
    scene = write_scene(tmp_path / "balls")
    run_one_scene(RunRequest(scene, scene / "masks", tmp_path / "out", RunConfig(reconstruct=None)))
    shutil.rmtree(scene / "images")
    with pytest.raises(InputError, match="the photos of this result are gone"):
        OpenResult(tmp_path / "out")


# Ctrl-C, also where a shell has told its background jobs to ignore it
STARTED = """
import signal, sys
signal.signal(signal.SIGINT, signal.default_int_handler)
from mvseg.cli import main

sys.exit(main())
"""


@pytest.mark.slow
def test_a_process_keeps_what_was_saved_and_ends_on_ctrl_c_with_one_sentence(folder: Path, capsys: Said) -> None:
    """As a person starts it. Edits are on the disk before it answers, so no kill can take them; a second process is
    refused; and Ctrl-C may come while it computes, which torch answers by an abort."""
    command = [sys.executable, "-c", STARTED, "correct", str(folder), "--no_browser"]
    saved = folder / "corrections.json"
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            address = urlsplit(process.stdout.readline().strip())
            assert main(["correct", str(folder), "--no_browser"]) == 2
            assert "another mvseg correct has this result open" in capsys.readouterr().err
            edits = [{"op": "same", "at": [["0", 1.5, 2.5], ["1", 3.0, 4.0]]}]
            connection = http.client.HTTPConnection(address.netloc, timeout=WAIT)
            connection.request("PUT", f"{address.path}edits?base={name_edits(())}", text_of(edits))
            assert connection.getresponse().status == 200
            connection.close()
            assert len(load_corrections(saved).edits) == 1
            process.send_signal(signal.SIGINT)
            said, complaint = process.communicate(timeout=WAIT)
        finally:
            process.kill()
    assert (process.returncode, complaint) == (0, "")
    assert said.splitlines()[-1].endswith(f"mvseg infer --again {folder} --corrections {saved}")
    saved.unlink()


@pytest.mark.slow
def test_the_whole_result_keeps_the_options_and_the_edits(tmp_path: Path) -> None:
    scene, out = write_scene(tmp_path / "my balls"), tmp_path / "my result"
    voxels = replace(RunConfig().reconstruct, shape="voxels", voxel_budget=8000)
    run_one_scene(RunRequest(scene, scene / "masks", out, RunConfig(reconstruct=voxels, scale=0.1, unit="cm")))
    before = json.loads((out / "run.json").read_text())["config"]
    with serve(out) as server:
        view, at = middle(server.corrector.opened, 0)
        save(server, [{"op": "confirm", "view": view, "at": at}])
        assert ask(server, "POST", "whole") == (200, {})
        assert all(text in ask(server, "GET", "")[1] for text in ('"plantTraits":[{', '"before":"3 leaves in 4 photos'))
    run = json.loads((out / "run.json").read_text())
    assert [each["fate"] for each in run["corrections"]] == ["applied"]
    after = run["config"]
    assert {name: each for name, each in after.items() if before[name] != each}.keys() == {"corrections", "from_here"}
    assert len(load_corrections(out / "corrections.json").edits) == 1


def test_edits_that_come_while_the_whole_result_is_made_are_kept(
    served: CorrectionServer, folder: Path, monkeypatch: Patch
) -> None:
    """Those of the page and those of another program; and one run is made at a time. The run is imitated: it replaces
    the folder by one with the edits that it found at its start."""
    path, (view, at) = folder / "corrections.json", middle(served.corrector.opened, 0)
    first, second = ([{"op": op, "view": view, "at": at}] for op in ("confirm", "reject"))
    theirs = first + second

    def run_while(happens: Callable[[], object]) -> tuple[int, Any]:
        def run(_: object, tell: Callable[[str], None]) -> tuple[int, str]:
            tell("50%: half of it")
            assert ask(served, "GET", "state")[1]["making"] == "50%: half of it"
            happens()
            status, answer = ask(served, "POST", "whole")
            assert (status, answer["problem"]) == (409, "The whole result is being made already.")
            return 0, ""

        monkeypatch.setattr("mvseg.server.correction_server.run_command", run)
        return ask(served, "POST", "whole")

    def save_into_the_old_folder() -> None:
        found = path.read_bytes()
        save(served, second)
        path.write_bytes(found)

    save(served, first)
    assert run_while(save_into_the_old_folder) == (200, {})
    assert json.loads(path.read_text())["edits"] == second
    assert run_while(lambda: path.write_bytes(text_of(theirs))) == (200, {})
    assert json.loads(path.read_text())["edits"] == theirs
    assert ask(served, "GET", "state")[1]["isChanged"]


def test_a_detector_learns_beside_the_page(served: CorrectionServer, folder: Path, monkeypatch: Patch) -> None:
    """What is edited meanwhile is saved, and computed afterwards; the whole result is found by what was learned; and
    it can be undone."""
    lesson, (view, at) = Lesson(monkeypatch), middle(served.corrector.opened, 0)
    runs: list[list[str]] = []

    def run(words: list[str], _: object) -> tuple[int, str]:
        runs.append([Path(word).read_text() if word.endswith(".safetensors") else word for word in words[:5]])
        return 0, ""

    monkeypatch.setattr("mvseg.server.correction_server.run_command", run)
    monkeypatch.setattr(OpenResult, "reopened", lambda opened: opened)
    before = wait_until_computed(served)
    assert before["learning"] == {"now": "", "isLearned": False, "seconds": 90 + 4 * 6}
    assert ask(served, "POST", "learn")[0] == 200
    state = before
    while state["learning"]["now"] != "learning: step 30 of 75":
        state = wait_for_news(served, state)
    assert not state["update"]
    assert save(served, [{"op": "reject", "view": view, "at": at}])[0] == 200
    assert len(load_corrections(folder / "corrections.json").edits) == 1
    for place in ("learn", "unlearn", "whole"):
        status, refusal = ask(served, "POST", place)
        assert (status, refusal["problem"]) == (409, "The detector is learning: wait until it is done, or cancel it.")
    lesson.go_on.set()
    while not state["learning"]["isLearned"] or state["isComputing"]:
        state = wait_for_news(served, state)
    assert state["update"]["numMasks"] == before["update"]["numMasks"] - 1
    assert state["learning"]["now"] == ""
    assert [len(each.edits) for each in lesson.learned_from] == [0]
    assert ask(served, "POST", "whole")[0] == 200
    assert ask(served, "POST", "unlearn")[0] == 200
    (folder / "detector.safetensors").write_text("learned")  # as that run would have
    state = wait_until_computed(served)
    assert not state["learning"]["isLearned"]
    assert state["number"] > before["number"]
    assert ask(served, "POST", "whole")[0] == 200
    (folder / "detector.safetensors").unlink()
    assert ask(served, "POST", "whole")[0] == 200
    assert [run[:1] for run in runs] == [["infer"]] * 3
    assert [run[3:] for run in runs] == [
        ["--detector", "learned"],
        ["--learn", "off"],
        ["--corrections", str(folder / "corrections.json")],
    ]


def test_learning_that_is_cancelled_or_fails_changes_nothing(served: CorrectionServer, monkeypatch: Patch) -> None:
    assert ask(served, "GET", "state")[1]["learning"] is None  # its masks were given
    status, refusal = ask(served, "POST", "learn")
    assert (status, refusal["problem"]) == (409, "No detector found these masks, so there is none that could learn.")
    lesson = Lesson(monkeypatch)
    state = wait_until_computed(served)
    ask(served, "POST", "learn")
    while not lesson.learned_from:
        state = wait_for_news(served, state)
    before = state["number"]
    assert ask(served, "POST", "cancel")[0] == 200
    while not state["number"] > before or state["learning"]["now"]:
        state = wait_for_news(served, state)
    assert (state["update"], state["problem"], state["learning"]["isLearned"]) == (None, "", False)

    def fail(*_: object) -> None:
        raise InputError("the views agree about 2 leaves.")

    monkeypatch.setattr(OpenResult, "learn", fail)
    ask(served, "POST", "learn")
    while not state["problem"]:
        state = wait_for_news(served, state)
    assert (state["problem"], state["learning"]["now"]) == ("the views agree about 2 leaves.", "")
    assert not state["isComputing"]


def test_a_leaf_that_goes_with_an_edit_of_another_is_named(served: CorrectionServer) -> None:
    """One that the edit names goes without a word, and so does one when edits are undone."""
    opened = served.corrector.opened
    shown, (view, at) = opened.saved_result, middle(opened, 0)
    edits = parse_corrections({"format": FORMAT, "edits": [{"op": "reject", "view": view, "at": at}]}).edits
    ids = shown.masks.instance_ids
    own = int(ids[0])
    other = next(each for each in ids.tolist() if each not in (-1, own))

    def without(leaf: int) -> Result:
        return replace(shown, matching=shown.matching.with_masks(shown.masks.select(ids != leaf)))

    assert tell_vanished(shown, without(own), new=edits) == []
    assert tell_vanished(shown, without(other), new=()) == []
    assert tell_vanished(shown, without(other), new=edits) == [
        f"Leaf {other} ({int((ids == other).sum())} masks) went with your last edit: undo it if that is wrong."
    ]


@pytest.mark.parametrize(
    ("drawn", "stays", "apart", "end"),
    [
        ("ab", "abc", 30, "drawn in 2 photos, found in 1 of 2 others."),
        ("ab", "ab", 6, "they are 6 degrees apart. All photos are within 6 degrees: outline it in more of them."),
        ("ab", "ab", 40, "others: its shape fits no other photo. Outline it in a photo 20 to 60 degrees away, too."),
        ("a", "a", 30, "of 3 others: one photo tells no shape. Outline it in a photo 20 to 60 degrees away, too."),
    ],
)
def test_outlines_say_where_their_leaf_was_found_or_why_not(drawn: str, stays: str, apart: int, end: str) -> None:
    maps = [np.kron([[int(name in stays), 0], [0, 2]], np.ones((4, 4), int)) for name in "abcd"]
    masks = Masks.of(regions_from_label_maps(maps))
    is_drawn = (masks.regions.labels == 1) & torch.tensor(["abcd"[view] in drawn for view in masks.view_index.tolist()])
    origin = torch.where(is_drawn, int(Origin.CORRECTED), int(Origin.DETECTED))
    masks = replace(masks, instance_ids=masks.regions.labels.clone(), origin=origin)
    scene = Scene("maps", tuple(View(name, Path(name)) for name in "abcd"), room_cameras(4))
    result = Result(scene=scene, matching=Matching(masks, MatchReport("test")), instances=Instances())
    new = [Outline(view=name, polygon=((0, 0), (4, 0), (4, 4))) for name in drawn]
    (said,) = tell_drawn(result, new=new, angles=np.full((4, 4), apart))
    assert said.startswith("Leaf 1: drawn in ")
    assert said.endswith(end)
    assert tell_drawn(result, new=[], angles=np.full((4, 4), apart)) == []


def test_inputs_that_changed_or_moved_since(tmp_path: Path, monkeypatch: Patch, capsys: Said) -> None:
    scene, elsewhere = write_scene(tmp_path / "here" / "balls"), tmp_path / "there"
    monkeypatch.chdir(tmp_path / "here")
    run_one_scene(RunRequest(Path("balls"), Path("masks"), Path("out"), RunConfig(reconstruct=None)))
    monkeypatch.chdir(tmp_path)
    run = OpenResult(tmp_path / "here" / "out").run
    assert (run.scene, run.masks, run.changes) == (scene, scene / "masks", ())
    (tmp_path / "here").rename(elsewhere)
    assert OpenResult(elsewhere / "out").run.masks == elsewhere / "balls" / "masks"
    assert OpenResult(elsewhere / "out").notice == ""
    first, second, *_ = sorted((elsewhere / "balls" / "masks").iterdir())
    first.write_bytes(second.read_bytes())
    assert f"{first.parent}: has changed since this result was made." in OpenResult(elsewhere / "out").notice
    photos = elsewhere / "balls" / "images"
    shutil.copy(photos / "002.png", photos / "001.png")
    capsys.readouterr()
    assert main(["infer", "--again", str(elsewhere / "out"), "--quiet"]) == 0  # in place
    said = capsys.readouterr()
    assert f"{photos}: 1 of 4 photos have changed since this result was made (001.png)" in said.err
    assert said.out.endswith("(in place of an earlier result)\n")
    assert OpenResult(elsewhere / "out").notice == ""


@pytest.mark.skipif(sys.platform == "win32", reason="pipes")
def test_a_strangers_result_makes_nobody_read_other_files(tmp_path: Path) -> None:
    """A device has no end, and a pipe that nobody writes to never answers."""
    scene, out = write_scene(tmp_path / "balls"), tmp_path / "out"
    run_one_scene(RunRequest(scene, Path("masks"), out, RunConfig(reconstruct=None)))
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "private.txt").write_text("mine")
    run = json.loads((out / "run.json").read_text())
    run["inputs"] |= {str(path): "0" for path in ("/dev/zero", tmp_path / "pipe", tmp_path / "private.txt", "/")}
    run["photo_sha256"] |= {"../../private.txt": "0", "/dev/zero": "0"}
    inside = tmp_path / "balls" / "private"  # of the scene, too
    inside.mkdir()
    os.mkfifo(inside / "pipe")
    run["inputs"] |= {str(inside): "0"}
    (out / "run.json").write_text(json.dumps(run))
    changes = read_recorded(out).changes
    not_read = {Finding("input_not_read", str(each)) for each in (inside, tmp_path / "private.txt", "/")}
    assert not_read | {Finding("input_gone", "/dev/zero")} <= {*changes}
    (gone,) = [each for each in changes if each.code == "photos_gone"]
    assert (gone.values["count"], gone.values["total"]) == (2, 6)
    run["config"] |= {"scene": "/proc", "from_here": {}}
    (out / "run.json").write_text(json.dumps(run))
    with pytest.raises(InputError, match="/proc: is no scene any more"):
        read_recorded(out)


def test_weights_that_ship_may_lie_elsewhere(folder: Path, tmp_path: Path) -> None:
    """A result of another installation of the same version; other weights count as a change."""
    out = shutil.copytree(folder, tmp_path / "out")
    run = json.loads((out / "run.json").read_text())
    run["config"]["detect"] = {"weights": "leaf-lite"}
    for sha256, codes in ((hash_files(weights_path("leaf-lite")), []), ("0" * 64, ["input_gone"])):
        changed = run | {"inputs": run["inputs"] | {"/elsewhere/weights.safetensors": sha256}}
        (out / "run.json").write_text(json.dumps(changed))
        assert [each.code for each in read_recorded(out).changes] == codes


def test_a_rough_box_becomes_the_outline_of_what_is_inside() -> None:
    photo = np.full((200, 300, 3), (90, 70, 50), np.uint8)
    rows, columns = np.mgrid[:200, :300] + 0.5
    disc = (rows - 90) ** 2 + (columns - 160) ** 2 < 40**2
    photo[disc] = (40, 160, 60)
    noise = np.random.default_rng(0).integers(-8, 9, photo.shape)
    photo = np.clip(photo + noise, 0, 255).astype(np.uint8)
    box = np.array([[108.0, 40], [212, 40], [212, 142], [108, 142]])
    outline = refine_outline(photo, box)
    assert np.abs(np.hypot(*(outline - (160, 90)).T) - 40).max() < 3
    np.testing.assert_array_equal(outline, refine_outline(photo, box))
    for bad in (box + 1000, np.zeros((3, 2)), np.array([[-50.0, -50], [400, -50], [400, 300], [-50, 300]])):
        with pytest.raises(InputError, match="expected one around a leaf"):
            refine_outline(photo, bad)


def test_an_outline_is_asked_for_by_the_page(served: CorrectionServer) -> None:
    regions = served.corrector.opened.saved_result.regions
    view, _ = middle(served.corrector.opened, 0)
    x1, y1, x2, y2 = (regions.boxes[0] + regions.boxes.new_tensor([-4, -4, 4, 4])).tolist()
    rough = [[x1, y1], [x2, y1], [x2, y2], [x1, y2]]
    status, answer = ask(served, "POST", "outline", json.dumps({"view": view, "polygon": rough}).encode())
    assert status == 200
    middles = np.array(answer["polygon"]).mean(0) - ((x1 + x2) / 2, (y1 + y2) / 2)
    assert np.abs(middles).max() < 4
    for content in ({"view": "nowhere", "polygon": rough}, {"view": view, "polygon": rough[:2]}, {"view": view}):
        assert ask(served, "POST", "outline", json.dumps(content).encode())[0] == 400
