"""COLMAP's long calls, which Ctrl-C and SIGTERM must end: each runs in its own thread while the main thread waits."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from threading import Event, Thread
from typing import Any, TypeVar

import pycolmap

Answer = TypeVar("Answer")


def run_cancellable(call: Callable[..., Answer], *args: Any, **options: Any) -> Answer:
    """Run a function of pycolmap; it gets a `cancellation_token` and returns soon after that was cancelled. Python
    handles signals between bytecodes only, and such a call takes seconds to minutes. Raises what the call raises; or
    what a signal raises meanwhile, once the call has returned."""
    token, done, answers, errors = pycolmap.CancellationToken(), Event(), [], []

    def run() -> None:
        try:
            if not token.is_cancelled:
                answers.append(call(*args, cancellation_token=token, **options))
        except BaseException as error:
            errors.append(error)
        finally:
            done.set()

    thread = Thread(target=run)
    with quiet_colmap():
        try:
            thread.start()
            # seconds; not `join`: in Python 3.11 an exception in it takes the thread for ended
            while not done.wait(0.1):
                pass
        finally:  # files that the call still writes are about to be deleted
            token.cancel()
            if thread.ident is not None:
                done.wait()
    if errors:
        raise errors[0]
    return answers[0]


@contextmanager
def quiet_colmap() -> Iterator[None]:
    """COLMAP logs errors only: its log is for its developers."""
    loglevel = pycolmap.logging.minloglevel
    pycolmap.logging.minloglevel = max(loglevel, 2)
    try:
        yield
    finally:
        pycolmap.logging.minloglevel = loglevel
