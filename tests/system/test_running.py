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
from mvseg.system.progress import EXPECTED, NETWORKS, PASSES, ROUND
from mvseg.system.running import SILENT, now_running, progress_bar, report_step, running, timed
from mvseg.system.threads import on_one_thread


def test_it_holds_inside_only_nests_and_ends_with_an_error() -> None:
    with running(progress=True):
        with running(num_workers=2):
            assert (bool(now_running().progress), len(now_running().workers)) == (True, 2)
            with running(progress=False, num_workers=1):
                assert (bool(now_running().progress), len(now_running().workers)) == (False, 1)
        assert (bool(now_running().progress), now_running().workers) == (True, ())
    assert not now_running().progress
    with pytest.raises(InputError, match=r"^num_workers is 0"), running(progress=True, num_workers=0):
        pass
    with pytest.raises(KeyboardInterrupt), running(progress=True):
        raise KeyboardInterrupt
    assert now_running() is SILENT


def test_threads_know_of_it_if_they_run_in_its_context() -> None:
    seen: list[bool] = []

    def look() -> None:
        seen.append(bool(now_running().progress))

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
    assert capsys.readouterr().err == "counting: sheep 3 of 3, 00:00 left\n"


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def open_terminal(monkeypatch: pytest.MonkeyPatch) -> Terminal:
    monkeypatch.setattr("mvseg.system.progress.TERMINAL_SECONDS", -1.0)
    monkeypatch.setattr(sys, "stderr", terminal := Terminal())
    return terminal


def test_on_a_terminal_there_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    terminal = open_terminal(monkeypatch)
    with running(progress=True):
        assert list(progress_bar(range(3), "match", unit="view")) == [0, 1, 2]
        with progress_bar(total=3, name="pictures", unit="view") as bar:
            (thread := threading.Thread(target=bar.update)).start()  # of a library
            thread.join()
        report_step("this stays")
    assert "\rmatch: view 3 of 3, 00:00 left" in terminal.getvalue()
    assert "\rpictures: view 1 of 3" in terminal.getvalue()
    assert terminal.getvalue().endswith(" \rmvseg: this stays\n")


PLAN = ("load", *PASSES, *ROUND * 2, "snap", "surfaces", "check", "voxels", "measure", "write")


def run_stages(*stages: str) -> None:
    for stage in stages:
        with timed(stage):
            list(progress_bar(range(4), stage, unit="view"))


@pytest.mark.parametrize(("passes", "rounds"), [(1, 0), (3, 2), (5, 0), (5, 1), (1, 2)])
def test_a_command_never_goes_back_or_jumps(passes: int, rounds: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """With fewer and with more passes of the detector than planned, and rounds that do not come."""
    terminal = open_terminal(monkeypatch)
    monkeypatch.setattr("mvseg.system.progress.TERMINAL_SECONDS", -1.0)
    with running(progress=True, plan=PLAN), running():
        run_stages("load", *PASSES[:3] * passes)
        run_stages(*("snap", "learn", *PASSES[:3] * passes) * rounds)
        run_stages(*PLAN[-6:])
    shares = [int(share) for share in re.findall(r"(\d+)%", terminal.getvalue())]
    assert all(0 <= step <= 25 for step in np.diff(shares))
    assert 85 < shares[-1] <= 100
    assert "if it learns more" not in terminal.getvalue()[-99:]  # no round can come


def test_the_time_left_follows_from_the_stages_that_are_over(monkeypatch: pytest.MonkeyPatch) -> None:
    terminal, now = open_terminal(monkeypatch), [0.0]
    monkeypatch.setattr("mvseg.system.progress.time.monotonic", lambda: now[0])
    with running(progress=True, plan=("detect", *ROUND, "write")):
        with timed("detect"):
            now[0] += 12 * EXPECTED["detect"]
        run_stages("snap")
    least, most = (round(12 * (EXPECTED["write"] + each)) for each in (0, sum(EXPECTED[one] for one in ROUND)))
    assert f", 00:{least} left ({most // 60}:{most % 60:02} if it learns more): snap" in terminal.getvalue()


def test_a_pipe_has_lines(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """One at the end of each stage, and one every half minute."""
    with running(progress=True, plan=PLAN):
        run_stages("load", "detect", "match", "match", "choose", "detect")
        monkeypatch.setattr("mvseg.system.progress.LINE_SECONDS", -1.0)
        run_stages("match")
    said = re.findall(r": (.*)", capsys.readouterr().err)
    ends = [f"{stage}: view 4 of 4" for stage in ("load", "detect", "match", "choose", "detect", "match")]
    assert [line for line in said if line in ends][: len(ends)] == ends
    assert "match" in said  # as it begins


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
