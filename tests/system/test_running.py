"""How a run works is said once, outside, and holds for all that is called inside."""

from __future__ import annotations

import io
import re
import sys
import threading
from collections.abc import Iterator
from contextvars import copy_context

import cv2
import numpy as np
import pytest
import torch
from threadpoolctl import threadpool_info, threadpool_limits

from mvseg.errors import InputError
from mvseg.system.running import NETWORKS, Running, expected_minutes, now_running, progress_bar, running, timed
from mvseg.system.threads import on_one_thread


def test_it_holds_inside_only_and_nests() -> None:
    assert now_running() == Running(progress=False, workers=None)
    with running(progress=True):
        with running(num_workers=2):
            assert now_running().progress
            assert now_running().workers is not None
            with running(progress=False, num_workers=1):
                assert now_running() == Running()
        assert now_running() == Running(progress=True)
    assert now_running() == Running()


def test_it_ends_with_an_error() -> None:
    with pytest.raises(InputError, match=r"^num_workers is 0"), running(progress=True, num_workers=0):
        pass
    with pytest.raises(KeyboardInterrupt), running(progress=True):
        raise KeyboardInterrupt
    assert now_running() == Running()


def test_threads_know_of_it_if_they_run_in_its_context() -> None:
    seen: list[bool] = []

    def look() -> None:
        seen.append(now_running().progress)

    with running(progress=True):
        for thread in (threading.Thread(target=look), threading.Thread(target=copy_context().run, args=(look,))):
            thread.start()
            thread.join()
    assert seen[1]  # the first one differs between versions of Python


def test_bars_are_silent_by_default(capsys: pytest.CaptureFixture[str]) -> None:
    assert list(progress_bar(range(3), "counting")) == [0, 1, 2]
    assert capsys.readouterr() == ("", "")
    with running(progress=True):
        for _ in range(2):  # one line, in a file or a pipe
            assert list(progress_bar(range(3), "counting", unit="sheep")) == [0, 1, 2]
    assert re.fullmatch(r"counting: 100% of 3 sheeps, 00:0\d\n", capsys.readouterr().err)


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_on_a_terminal_there_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "stderr", terminal := Terminal())
    with running(progress=True):
        for name in ("match", "pictures"):
            assert list(progress_bar(range(3), name, unit="view")) == [0, 1, 2]
    assert "match: view 0 of 3, ? left" in terminal.getvalue()
    assert "pictures: view 0 of 3, ? left" in terminal.getvalue()
    assert "\n" not in terminal.getvalue()
    assert terminal.getvalue().endswith(" \r")


PLAN = ("detect", "match", "choose", "write")


def shown_lines(text: str) -> tuple[list[int], list[str]]:
    """Percentages and words of lines of a whole command."""
    found = re.findall(r"(\d+)%(?:, [\d:]+ left)?: ([^\r\n]+)", text)
    return [int(share) for share, _ in found], [words.strip() for _, words in found]


def test_a_command_has_one_line_that_never_goes_back(monkeypatch: pytest.MonkeyPatch) -> None:
    """A run may repeat stages, and learn, which nobody planned; a stage that does not come is left out."""
    monkeypatch.setattr(sys, "stderr", terminal := Terminal())
    monkeypatch.setattr("mvseg.system.whole_command.REFRESH_SECONDS", 0.0)
    with running(progress=True, plan=PLAN), running():
        for stage in ("detect", "match", "detect", "match", "choose", "learn", "detect", "match", "write"):
            with timed(stage):
                list(progress_bar(range(3), stage, unit="view"))
                list(progress_bar(iter("ab"), "letters", unit="letter"))
    shares, words = shown_lines(terminal.getvalue())
    assert shares == sorted(shares)
    assert 80 < shares[-1] < 100
    assert {"detect: view 2 of 3", "learn", "learn: view 3 of 3", "letters: letter 2"} <= set(words)
    assert "\n" not in terminal.getvalue()


def test_in_a_pipe_each_bar_has_a_line_once(capsys: pytest.CaptureFixture[str]) -> None:
    with running(progress=True, plan=PLAN):
        for stage in ("detect", "match", "detect", "match", "choose"):
            with timed(stage), progress_bar(total=4, name=stage, unit="view") as bar:
                bar.update(4)
    shares, words = shown_lines(capsys.readouterr().err)
    assert words == [f"{stage}: view 4 of 4" for stage in ("detect", "match", "choose")]
    assert shares == sorted(shares)
    assert shares[-1] < 100


def test_how_long_learning_will_take_follows_from_detection() -> None:
    with running() as now:
        now.seconds["detect"] = 60.0
        assert expected_minutes("learn") == "some 3 minutes"


def test_steps_are_reported_also_where_there_are_none_or_they_cannot_be_counted() -> None:
    said: list[str] = []
    with running(report=said.append):
        assert list(progress_bar(iter(()), "surfaces", 0, unit="instance")) == []
        assert list(progress_bar(iter("ab"), "surfaces", 2, unit="instance")) == ["a", "b"]
        assert list(progress_bar(range(1), "views", unit="view")) == [0]
    assert said == ["surfaces: instance 1 of 2", "surfaces: instance 2 of 2", "views: view 1 of 1"]


def all_threads() -> set[int]:
    """Threads of torch, OpenCV, and the libraries that NumPy and SciPy multiply with."""
    np.linalg.inv(np.eye(2))  # it is loaded
    blas = {library["num_threads"] for library in threadpool_info() if library["user_api"] == "blas"}
    return blas | {torch.get_num_threads(), cv2.getNumThreads()}


@pytest.fixture
def two_threads() -> Iterator[None]:
    with threadpool_limits(limits=2, user_api="blas"), on_one_thread():
        torch.set_num_threads(2)
        cv2.setNumThreads(2)
        with threadpool_limits(limits=2, user_api="blas"):
            yield


@pytest.mark.usefixtures("two_threads")
def test_stages_compute_on_one_thread_and_give_back_the_others() -> None:
    assert all_threads() == {2}
    with timed("match"):
        assert all_threads() == {1}
        with timed("surfaces"):
            assert all_threads() == {1}
        assert all_threads() == {1}
    assert all_threads() == {2}
    with pytest.raises(ZeroDivisionError), timed("match"):
        _ = 1 / 0
    assert all_threads() == {2}


@pytest.mark.usefixtures("two_threads")
def test_networks_and_they_alone_compute_on_all_threads() -> None:
    for stage in NETWORKS:
        with timed(stage):
            assert all_threads() == {2}
    computes = on_one_thread()(all_threads)  # as `fit_surfaces`, for those who call it without a run
    assert [computes(), computes(), all_threads()] == [{1}, {1}, {2}]
