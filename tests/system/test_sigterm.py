"""SIGTERM as an exception: also where Python swallows exceptions."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time

import pytest

from mvseg.system.sigterm import Terminated, stopped_by_sigterm

pytestmark = pytest.mark.skipif(not hasattr(os, "fork"), reason="SIGTERM of POSIX systems")


def test_it_is_raised_and_the_earlier_handler_comes_back() -> None:
    earlier = signal.getsignal(signal.SIGTERM)
    cleared = []
    with pytest.raises(Terminated), stopped_by_sigterm():  # noqa: PT012
        try:
            os.kill(os.getpid(), signal.SIGTERM)
            time.sleep(10)
        finally:
            cleared.append(True)
    assert cleared == [True]
    assert signal.getsignal(signal.SIGTERM) == earlier


class Dying:
    """Gets a signal in its finaliser."""

    def __init__(self, number: signal.Signals) -> None:
        self.number = number

    def __del__(self) -> None:
        os.kill(os.getpid(), self.number)
        time.sleep(0.01)


@pytest.mark.parametrize(("number", "raised"), [(signal.SIGTERM, Terminated), (signal.SIGINT, KeyboardInterrupt)])
def test_it_is_not_lost_where_python_swallows_exceptions(number: signal.Signals, raised: type[BaseException]) -> None:
    """Nor is Ctrl-C."""
    earlier = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with pytest.raises(raised), stopped_by_sigterm():  # noqa: PT012
            Dying(number)
            time.sleep(10)
    finally:
        signal.signal(signal.SIGINT, earlier)


FORK = """
import os, signal, time
from mvseg.system.sigterm import Terminated, stopped_by_sigterm

def send():
    os.kill(os.getpid(), signal.SIGTERM)
    time.sleep(0.01)

os.register_at_fork(before=send)
try:
    with stopped_by_sigterm():
        if not os.fork():
            os._exit(0)
        time.sleep(30)
except Terminated:
    print("terminated")
"""


def test_it_is_not_lost_in_a_fork() -> None:
    """In a process of its own: hooks around a fork stay, and an exception between them keeps logging's lock for good,
    for which threads of later tests would wait without end."""
    done = subprocess.run([sys.executable, "-c", FORK], capture_output=True, text=True, timeout=120, check=False)
    assert (done.stdout, done.returncode) == ("terminated\n", 0), done.stderr


def test_other_reports_pass(monkeypatch: pytest.MonkeyPatch) -> None:
    reported = []
    monkeypatch.setattr(sys, "unraisablehook", reported.append)

    class Failing:
        def __del__(self) -> None:
            raise ValueError

    with stopped_by_sigterm():
        Failing()
    assert [report.exc_type for report in reported] == [ValueError]
