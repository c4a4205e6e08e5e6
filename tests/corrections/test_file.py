"""The file of corrections: what is written is read again, and each fault is one sentence."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from mvseg.corrections.file import (
    FORMAT,
    Confirm,
    Corrections,
    Link,
    Outline,
    Reject,
    Split,
    TrackLink,
    load_corrections,
    parse_corrections,
    write_corrections,
)
from mvseg.corrections.numbers import EDITS
from mvseg.errors import InputError

REJECT = {"op": "reject", "view": "003", "at": [1, 2]}


def content(*edits: Any) -> dict[str, Any]:
    return {"format": FORMAT, "edits": list(edits)}


def test_what_is_written_is_read_again(tmp_path: Path) -> None:
    edits = (
        Outline(view="003", polygon=((1, 2), (3.5, 4), (0, 9)), leaf="ä<b>", by="me", when="2026-11-23"),
        Reject(view="003", at=(1, 2)),
        Reject(view="003", at=(1, 2), everywhere=True, when=17),
        Link(op="same", at=(("003", 1, 2), ("007", 3, 4))),
        Link(op="different", at=(("003", 1, 2), ("003", 3, 4))),
        Split(view="a/b", at=(1, 2), line=((0, 0), (5, 5))),
        Confirm(view="003", at=(0.5, 0.5), stem=True),
        TrackLink(op="same_track", at=(("day1", "003", 1, 2), ("day2", "003", 1, 2))),
    )
    path = tmp_path / "corrections.json"
    write_corrections(path, Corrections(edits))
    read = load_corrections(path)
    assert read == Corrections(edits, path)
    write_corrections(tmp_path / "again.json", read)
    assert (tmp_path / "again.json").read_bytes() == path.read_bytes()
    assert json.loads(path.read_text())["edits"][1] == {"op": "reject", "view": "003", "at": [1.0, 2.0]}


@pytest.mark.parametrize(
    ("data", "message"),
    [
        ([], "valid dictionary"),
        ({"format": "mvseg-corrections/2", "edits": []}, "format: Input should be 'mvseg-corrections/1'"),
        ({"format": FORMAT}, "edits: Field required"),
        ({"format": FORMAT, "edits": [], "more": 1}, "more: Extra inputs are not permitted"),
        (content(REJECT, 3), "edit 2: Input should be a valid dictionary"),
        (content({"op": "delete"}), "edit 1: Input tag 'delete' .* expected tags: 'outline', 'reject'"),
        (content({"op": ["reject"]}), "edit 1: Input tag"),
        (content(REJECT | {"color": 1}), r"edit 1 \(reject\): color: Extra inputs are not permitted"),
        (content(REJECT | {"at": [float("nan"), 1]}), r"edit 1 \(reject\): at\[0\]: .*finite"),
        (content(REJECT | {"at": [1e300, 1]}), "at"),
        (content(REJECT | {"at": ["1", 1]}), "number"),
        (content(REJECT | {"at": [1]}), "at"),
        (content(REJECT | {"view": 3}), "view: .*string"),
        (content(REJECT | {"everywhere": "yes"}), "everywhere: .*boolean"),
        (content({"op": "outline", "view": "3", "polygon": [[0, 0], [1, 1]]}), "polygon: .*at least 3"),
        (content({"op": "outline", "view": "3", "polygon": [[0, 0]] * 10_001}), "polygon: .*at most 10000"),
        (content({"op": "same", "at": [["3", 1, 2]]}), "at: .*at least 2"),
        (content(*[REJECT] * (EDITS.most_edits + 1)), "edits: .*at most 10000"),
    ],
)
def test_faults_are_one_sentence(data: Any, message: str) -> None:
    with pytest.raises(InputError, match=message) as caught:
        parse_corrections(data, Path("plant/corrections.json"))
    assert str(caught.value).startswith("plant/corrections.json: ")
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 250


MILLION = '{"format": "mvseg-corrections/1", "edits": [' + "0," * 999_999 + "0]}"


@pytest.mark.parametrize("text", ["", "{", "[" * 100_000, '{"format": NaN}', "\udce4", MILLION], ids=len)
def test_broken_files_are_refused(tmp_path: Path, text: str) -> None:
    path = tmp_path / "corrections.json"
    path.write_bytes(text.encode("utf-8", "surrogateescape"))
    with pytest.raises(InputError, match=r"corrections\.json: "):
        load_corrections(path)


def test_hostile_texts_stay_in_their_sentence(tmp_path: Path) -> None:
    """HTML, paths and line ends are texts: no file is opened by them, and a message is one short line."""
    evil = "<img src=x onerror=alert(1)>\n\x1b[31m" + "../" * 100 + "etc/passwd"
    named = parse_corrections(content(REJECT | {"view": evil, "by": evil, "when": evil})).edits[0]
    assert isinstance(named, Reject)
    assert named.view == evil
    for edit in ({"op": evil}, REJECT | {evil: 1}, {"op": "same", "at": [[evil, 1]] * 2}, evil):
        with pytest.raises(InputError) as caught:
            parse_corrections(content(edit), tmp_path / "corrections.json")
        assert not set("\n\x1b") & set(str(caught.value))
        assert len(str(caught.value)) < 250 + len(str(tmp_path))


def test_missing_and_huge_files_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cannot be read"):
        load_corrections(tmp_path / "none.json")
    with (tmp_path / "huge.json").open("wb") as file:
        file.truncate(2**30)
    with pytest.raises(InputError, match="1073741824 bytes"):
        load_corrections(tmp_path / "huge.json")
