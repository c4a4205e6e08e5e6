"""Processes that work through a list, and what becomes of an item whose process dies."""

from __future__ import annotations

import os
import signal
import time
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest

from batch_work import do_as_told, start_lightly
from mvseg.batch.workers import Lost, run_locally


def run(items: list[str], num_workers: int) -> tuple[dict[int, Any], list[int]]:
    """The answers, and the keys in the order in which workers took them."""
    begun: list[int] = []
    numbered = dict(enumerate(items))
    answers = run_locally(do_as_told, numbered, begun.append, num_workers=num_workers)
    found = list(answers)
    assert len(found) == len({key for key, _ in found})
    return dict(found), begun


@pytest.fixture
def light(monkeypatch: pytest.MonkeyPatch) -> None:
    """Workers that load no libraries."""
    monkeypatch.setattr("mvseg.system.worker_pool._start_worker", start_lightly)


@pytest.mark.slow
def test_every_item_has_its_answer_and_workers_are_used_again() -> None:
    """With workers as they are; those of the other tests load no libraries."""
    environment = dict(os.environ)
    answers, begun = run(["a", "b", "c", "threads", "d"], 2)
    assert [answers[key][0] for key in range(5)] == ["A", "B", "C", "1", "D"]
    assert len({process for _, process in answers.values()} - {os.getpid()}) <= 2
    assert begun == [0, 1, 2, 3, 4]
    assert dict(os.environ) == environment


def test_a_process_that_dies_loses_its_own_item_only(light: None) -> None:
    answers, _ = run(["kill", "a", "exit", "b", "raise", "c"], 2)
    assert [answers[key][0] for key in (1, 3, 5)] == ["A", "B", "C"]
    assert answers[0] == answers[2] == Lost("died, most likely because memory ran out")
    assert answers[4] == Lost("stopped with ValueError: it is broken")
    answers, _ = run(["a", "kill"], 1)
    assert (answers[0][0], type(answers[1])) == ("A", Lost)
    assert run([], 2) == ({}, [])


def test_workers_end_when_the_caller_has_enough(light: None, tmp_path: Path) -> None:
    items = {0: f"wait:{tmp_path}", 1: "a"}
    with closing(run_locally(do_as_told, items, int, num_workers=2)) as answers:
        assert next(answers)[1][0] == "A"  # type: ignore[index]
        while not (tmp_path / "begun").exists() or not (tmp_path / "begun").read_text():
            time.sleep(0.01)
        process = int((tmp_path / "begun").read_text())
        os.kill(process, signal.SIGINT)  # a terminal sends Ctrl-C to all; the parent alone decides
        time.sleep(0.1)
        os.kill(process, 0)
    with pytest.raises(ProcessLookupError):
        os.kill(process, 0)
