"""Findings: a code, a place and values; a sentence where somebody reads; causes without what they explain."""

from __future__ import annotations

import ast
import json
import pickle
import re
from pathlib import Path
from string import Formatter

import pytest

import mvseg
from mvseg.errors import InputWarning, collect_warnings, note_warnings, warn
from mvseg.findings.finding import Finding, keep_causes, list_findings
from mvseg.findings.sentences import EXPLAINS, SENTENCES, TABLES
from warned import warns_of

ODD = Finding("view_off", "view 2 (c)", {"share": 0.04, "px": 16.2}, (2,), "error")
KINDS = Finding("other_kinds", "masks", {"kind": "COCO", "count": 4, "others": ("a", "b", "c", "d", "e")})
SOURCES = {path: path.read_text(encoding="utf-8") for path in Path(mvseg.__file__).parent.rglob("*.py")}


def test_the_sentence_is_made_of_the_values() -> None:
    assert str(ODD).startswith("view 2 (c) agrees with none of the others: 4% of its masks fit")
    assert str(KINDS) == "masks: COCO for 4 photos are taken, and not a, b, c and 2 more"
    assert (ODD.topic, KINDS.topic) == ("poses", "masks")


@pytest.mark.parametrize("finding", [ODD, KINDS])
def test_there_and_back(finding: Finding) -> None:
    assert Finding.from_json(json.loads(json.dumps(finding.as_json()))) == finding
    assert pickle.loads(pickle.dumps(InputWarning(finding))).finding == finding
    assert hash(finding) == hash(Finding.from_json(finding.as_json()))


def test_every_code_has_one_sentence_and_every_sentence_is_used() -> None:
    assert len(SENTENCES) == sum(map(len, TABLES.values()))
    words = {
        node.value for source in SOURCES.values() for node in ast.walk(ast.parse(source))
        if isinstance(node, ast.Constant) and isinstance(node.value, str)
    }  # fmt: skip
    assert SENTENCES.keys() - words == set()
    made = {code for source in SOURCES.values() for code in re.findall(r'Finding\(\s*"(\w+)"', source)}
    assert made - SENTENCES.keys() == set()
    explained = {code for (cause, _), effects in EXPLAINS.items() for code in (cause, *effects)}
    assert explained - SENTENCES.keys() == set()


def test_sentences_tell_and_ask_in_one_breath() -> None:
    for code, sentence in SENTENCES.items():
        assert not sentence.endswith("."), code
        assert all(name for _, name, _, _ in Formatter().parse(sentence) if name is not None), code
        assert not re.search(r"of what|of those that|of these that", sentence), code
    rules = [("grey_photo", "note", [1], {}), ("dark_photo", "warning", [], {}), ("unknown_up", "note", None, {})]
    found = list_findings(rules, ("a", "b"))  # type: ignore[arg-type]
    assert found == [Finding("grey_photo", "view 1 (b)", views=(1,), level="note"), Finding("unknown_up", level="note")]


def test_causes_alone_are_told_and_once() -> None:
    unsure, note = Finding("views_disagree", values={"share": 0.5}), Finding("unknown_up", level="note")
    assert keep_causes((note, unsure, ODD, ODD)) == (ODD, note)
    assert keep_causes((unsure, note)) == (unsure, note)
    reader, check = Finding("turned_for_display", "a.jpg", {"count": 1}), Finding("turned_for_display", "a", views=(0,))
    assert keep_causes((reader, check)) == (check,)


def test_warnings_are_collected_by_code_and_given_without_what_is_explained() -> None:
    with collect_warnings() as given, note_warnings() as noticed:
        for code in ("same_position", "centres_shared"):
            warn(Finding(code, "views 0 and 1", {"count": 1}))
    assert [each.code for each in given] == ["same_position"]
    assert [each.code for each in noticed] == ["same_position", "centres_shared"]
    with warns_of("no_masks") as noticed:
        warn(Finding("no_masks"))
        warn(Finding("no_masks"))
    assert noticed == [Finding("no_masks")]
