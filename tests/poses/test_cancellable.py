from __future__ import annotations

import os
import signal
import time

import pycolmap
import pytest

from mvseg.poses.cancellable import run_cancellable
from mvseg.system.sigterm import Terminated, stopped_by_sigterm


def test_answers_and_errors_pass() -> None:
    assert run_cancellable(lambda number, cancellation_token: number, 3) == 3
    with pytest.raises(ZeroDivisionError):
        run_cancellable(lambda cancellation_token: 1 / 0)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="SIGTERM of POSIX systems")
@pytest.mark.parametrize("delay", [0.0, 0.15])
@pytest.mark.parametrize(("number", "error"), [(signal.SIGTERM, Terminated), (signal.SIGINT, KeyboardInterrupt)])
def test_a_signal_cancels_the_call_and_waits_for_its_end(number: int, error: type[BaseException], delay: float) -> None:
    ended = []

    def call(cancellation_token: pycolmap.CancellationToken) -> None:
        time.sleep(delay)
        os.kill(os.getpid(), number)
        while not cancellation_token.is_cancelled:
            time.sleep(0.01)
        time.sleep(0.1)
        ended.append(True)

    earlier = signal.signal(signal.SIGINT, signal.default_int_handler)  # shells let their background jobs ignore it
    try:
        with pytest.raises(error), stopped_by_sigterm():
            run_cancellable(call)
    finally:
        signal.signal(signal.SIGINT, earlier)
    assert ended == [True]
    assert pycolmap.logging.minloglevel == 0
