"""`mvseg correct TRACKS`: links between dates are saved at once, and all else follows."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from mvseg.cli import main
from mvseg.corrections.track_links import leaf_at
from mvseg.errors import InputError
from mvseg.server.local_server import CorrectionServer
from mvseg.server.open_tracks import OpenTracks
from served_result import ask, save, serve, wait_for_news, wait_until_computed, write_two_ways

X = {leaf: 20 * leaf - 9.5 for leaf in range(1, 7)}  # the middle of each leaf in the photo of `write_result`


def place(scene: str, leaf: int) -> list[Any]:
    return [scene, "000", X[leaf], 20.5]


def link(op: str, one: int, other: int) -> dict[str, Any]:
    return {"op": op, "at": [place("a", one), place("b", other)]}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return write_two_ways(tmp_path)


@pytest.fixture
def served(folder: Path) -> Iterator[CorrectionServer]:
    with serve(OpenTracks(folder)) as server:
        yield server


def pairs_of(update: dict[str, Any]) -> dict[int, int]:
    """{leaf of a: leaf of b} of the tracks that a page shows."""
    tracks = [{leaf["track"]: leaf["leaf"] for leaf in update["leaves"] if leaf["date"] == date} for date in (0, 1)]
    return {leaf: tracks[1][track] for track, leaf in tracks[0].items() if track in tracks[1]}


def test_one_edit_is_saved_and_all_leaves_follow(served: CorrectionServer, folder: Path) -> None:
    before = wait_until_computed(served)["update"]
    status, page = ask(served, "GET", "")
    data = json.loads(page.split('id="data">')[1].split("</script>")[0])
    assert (status, data["correct"]["edits"], data["correct"]["isServed"]) == (200, [], before["warnings"] != [])
    assert [leaf["leaf"] for leaf in data["leaves"]] == [
        leaf_at(folder.with_name("ab"[leaf["date"]]), *leaf["place"]) for leaf in data["leaves"]
    ]
    now = pairs_of(before)
    behind = {leaf: 1 + (other + 2) % 6 for leaf, other in now.items()}
    edits = [link("same_track", 1, behind[1]), link("same_track", 1, now[1])]
    save(served, edits[:1])
    assert json.loads((folder / "corrections.json").read_text())["edits"] == edits[:1]
    after = wait_until_computed(served)
    assert (pairs_of(after["update"]), after["outcomes"]) == (behind, [""])
    both = before["leaves"], after["update"]["leaves"]
    numbers = [{(each["leaf"], each["track"]) for each in leaves if not each["date"]} for leaves in both]
    assert numbers[0] == numbers[1]  # leaves keep them
    assert not any("crop" in leaf for leaf in after["update"]["leaves"])
    save(served, edits)  # the later one wins
    after = wait_until_computed(served)
    assert (pairs_of(after["update"]), after["outcomes"]) == (now, ["same_track: contradicted by edit 2", ""])
    status, page = ask(served, "GET", "")
    assert json.loads(page.split('id="data">')[1].split("</script>")[0])["correct"]["edits"] == edits
    save(served, [])
    assert pairs_of(wait_until_computed(served)["update"]) == now


def test_questions_say_what_they_would_change_and_answers_are_not_asked_again(served: CorrectionServer) -> None:
    state = wait_until_computed(served)
    while state["update"] is None or state["update"]["questions"][0]["changes"] is None:
        state = wait_for_news(served, state)
    (first, *_), now = state["update"]["questions"], pairs_of(state["update"])
    assert 0 < len(state["update"]["questions"]) <= 10
    (_, leaf), (_, other) = first["before"], first["after"]
    assert first["isLinked"]
    assert now[leaf] == other
    assert len(first["changes"]) == 7  # the pot is turned, and each leaf is the one behind
    save(served, [link("different_track", leaf, other)])
    after = wait_until_computed(served)["update"]
    assert pairs_of(after) == {leaf: 1 + (other + 2) % 6 for leaf, other in now.items()}
    assert [leaf, other] not in [[each["before"][1], each["after"][1]] for each in after["questions"]]


def test_the_tables_follow_when_they_are_asked_for(
    served: CorrectionServer, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    commands: list[list[str]] = []

    def run(words: list[str], _: object) -> tuple[int, str]:
        commands.append(words)
        return 0, ""

    monkeypatch.setattr("mvseg.server.correction_server.run_command", run)
    edit = link("same_track", 1, 1 + pairs_of(wait_until_computed(served)["update"])[1] % 6)
    save(served, [edit])
    expected = pairs_of(wait_until_computed(served)["update"])
    assert ask(served, "POST", "whole") == (200, {})
    assert main([*commands[0], "--quiet"]) == 0
    rows = [line.split(",") for line in (folder / "tracks.csv").read_text().splitlines()[1:]]
    tracks = [{row[4]: int(row[3]) for row in rows if row[2] == scene and row[3]} for scene in ("a", "b")]
    assert {leaf: tracks[1][track] for track, leaf in tracks[0].items() if track in tracks[1]} == expected
    assert json.loads((folder / "corrections.json").read_text())["edits"] == [edit]
    assert OpenTracks(folder).read_edits()[0].edits
    assert ask(served, "POST", "learn")[0] == 409
    assert ask(served, "POST", "outline", b"{}")[0] == 404


def test_edits_of_single_scenes_in_the_file_stay(folder: Path) -> None:
    reject = {"op": "reject", "view": "000", "at": [1.0, 2.0]}
    marks = {"000": {"width": 120, "height": 40}}
    text = {"format": "mvseg-corrections/1", "photos": marks, "edits": [reject]}
    (folder / "corrections.json").write_text(json.dumps(text))
    with serve(OpenTracks(folder)) as server:
        assert save(server, [reject, link("same_track", 1, 1)])[0] == 200
        assert wait_until_computed(server)["outcomes"] == ["", ""]
    saved = json.loads((folder / "corrections.json").read_text())
    assert saved == text | {"edits": [reject, link("same_track", 1, 1)]}


def test_tracks_that_cannot_be_corrected(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(InputError, match="holds no plant maize, expected one of tracks with --plant"):
        OpenTracks(folder, "maize")
    said = json.loads((folder / "run.json").read_text())
    plants = said["config"]["plants"]
    for change, sentence in (
        ({"plants": []}, "an earlier version made these tracks"),
        ({"plants": [*plants, plants[0] | {"plant": "other"}]}, "holds 2 plants, expected one of tracks, other"),
        ({"plants": [plants[0] | {"times": plants[0]["times"][1:]}]}, "1 times for 2 results, expected one for each"),
        ({"plants": [plants[0] | {"results": ["/nowhere/a", plants[0]["results"][1]]}]}, "/nowhere/a: the result that"),
    ):
        (folder / "run.json").write_text(json.dumps(said | {"config": said["config"] | change}))
        assert main(["correct", str(folder), "--no_browser"]) == 2
        assert sentence in capsys.readouterr().err
