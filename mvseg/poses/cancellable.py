"""COLMAP's long calls, which Ctrl-C and SIGTERM must end: each runs in its own thread while the main thread waits."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import contextmanager
from typing import Any, TypeVar

import pycolmap

Answer = TypeVar("Answer")


def run_cancellable(call: Callable[..., Answer], *args: Any, **options: Any) -> Answer:
    """Run a function of pycolmap; it gets a `cancellation_token` and returns soon after that was cancelled. Python
    handles signals between bytecodes only, and such a call takes seconds to minutes. Raises what the call raises; or
    what a signal raises meanwhile, once the call has returned."""
    token = pycolmap.CancellationToken()
    with quiet_colmap(), ThreadPoolExecutor(1) as thread:  # which waits for the end of the call
        thread.submit(int).result()  # while a thread starts, a signal would make the executor forget it
        try:
            future = thread.submit(call, *args, cancellation_token=token, **options)
            while not wait([future], 0.1).done:  # seconds
                pass
        finally:  # files that the call still writes are about to be deleted
            token.cancel()
    return future.result()


@contextmanager
def quiet_colmap() -> Iterator[None]:
    """COLMAP logs errors only: its log is for its developers."""
    loglevel = pycolmap.logging.minloglevel
    pycolmap.logging.minloglevel = max(loglevel, 2)
    try:
        yield
    finally:
        pycolmap.logging.minloglevel = loglevel
