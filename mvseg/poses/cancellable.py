"""COLMAP's long calls, which Ctrl-C and SIGTERM must end: each runs in its own thread while the main thread waits."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from threading import Event, Thread
from typing import TypeVar

import pycolmap

Answer = TypeVar("Answer")
WAIT = 0.1  # seconds until a signal is handled, at the latest
ERRORS_ONLY = 2  # of COLMAP's log


def run_cancellable(call: Callable[[pycolmap.CancellationToken], Answer]) -> Answer:
    """Run a call of pycolmap, which gets a token and returns soon after it was cancelled.

    Python handles signals between bytecodes only, and a call of pycolmap takes seconds to minutes.

    Raises:
        BaseException: what the call raises; or what a signal raises meanwhile, once the call has returned.
    """
    token, done, answers, errors = pycolmap.CancellationToken(), Event(), [], []

    def run() -> None:
        try:
            if not token.is_cancelled:
                answers.append(call(token))
        except BaseException as error:
            errors.append(error)
        finally:
            done.set()

    thread = Thread(target=run)
    with _quiet():
        try:
            thread.start()
            while not done.wait(WAIT):  # not `join`: in Python 3.11 an exception in it takes the thread for ended
                pass
        finally:  # files that the call still writes are about to be deleted
            token.cancel()
            if thread.ident is not None:
                done.wait()
    if errors:
        raise errors[0]
    return answers[0]


@contextmanager
def _quiet() -> Iterator[None]:
    """Suppress COLMAP's log, which is for its developers."""
    earlier = pycolmap.logging.minloglevel
    pycolmap.logging.minloglevel = max(earlier, ERRORS_ONLY)
    try:
        yield
    finally:
        pycolmap.logging.minloglevel = earlier
