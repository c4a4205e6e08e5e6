"""How processes end: SIGTERM as an exception, so that what is half written is cleared away, as after Ctrl-C; and
workers, which end with the process that started them."""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

AGAIN = 0.05  # seconds


class Terminated(BaseException):
    """SIGTERM came. It passes through everything that catches `Exception`."""


@contextmanager
def stopped_by_sigterm() -> Iterator[None]:
    """SIGTERM raises `Terminated` in this block, which belongs to the main thread.

    pycolmap brings a handler of its own, which prints a C++ trace and may hang: so pycolmap is imported here, with the
    signal held back, before ours is set.
    """
    mask = getattr(signal, "pthread_sigmask", None)
    try:
        if mask is not None:
            mask(signal.SIG_BLOCK, {signal.SIGTERM})
        import pycolmap  # noqa: F401

        earlier, earlier_hook = signal.signal(signal.SIGTERM, _terminate), sys.unraisablehook
        sys.unraisablehook = _Insist(earlier_hook)
    finally:
        if mask is not None:
            mask(signal.SIG_UNBLOCK, {signal.SIGTERM})
    try:
        yield
    finally:
        sys.unraisablehook = earlier_hook
        signal.signal(signal.SIGTERM, signal.SIG_DFL if earlier is None else earlier)


def end_with_parent() -> None:
    """Wait until the parent process is gone, then end this one at once; for a thread of a `multiprocessing` process."""
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)


def _terminate(*_: object) -> None:
    raise Terminated


class _Insist:
    """Python swallows what is raised in a finaliser, or in the hooks around a fork (data loaders fork), and reports it
    here: then the signal comes once more."""

    def __init__(self, report: Any) -> None:
        self.report = report

    def __call__(self, unraisable: Any) -> None:
        if not issubclass(unraisable.exc_type, Terminated) or not hasattr(signal, "setitimer"):
            self.report(unraisable)
            return
        signal.signal(signal.SIGALRM, _terminate)
        signal.setitimer(signal.ITIMER_REAL, AGAIN)
