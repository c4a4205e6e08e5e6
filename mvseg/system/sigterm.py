"""SIGTERM as an exception, so that unfinished files are deleted, as after Ctrl-C."""

from __future__ import annotations

import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial

AGAIN = 0.05  # limit: seconds


class Terminated(BaseException):
    """SIGTERM came. It passes through everything that catches `Exception`."""


@contextmanager
def stopped_by_sigterm() -> Iterator[None]:
    """SIGTERM raises `Terminated` in this block, which belongs to the main thread. pycolmap installs a handler of its
    own, which prints a C++ trace and may hang: so pycolmap is imported here, with the signal blocked, before ours is
    set. Ctrl-C is blocked, too: pycolmap would report that it is not installed."""
    earlier_hook = sys.unraisablehook

    def insist(unraisable: sys.UnraisableHookArgs) -> None:
        """Raise the signal again that Python swallowed in a finaliser, or around a fork (data loaders fork)."""
        how = unraisable.exc_type
        if issubclass(how, (Terminated, KeyboardInterrupt)) and hasattr(signal, "setitimer"):
            signal.signal(signal.SIGALRM, partial(_end, how))
            signal.setitimer(signal.ITIMER_REAL, AGAIN)
        else:
            earlier_hook(unraisable)

    with held_back(signal.SIGTERM, signal.SIGINT):
        import pycolmap  # noqa: F401

        earlier = signal.signal(signal.SIGTERM, partial(_end, Terminated))
        sys.unraisablehook = insist
    try:
        if hasattr(signal, "pthread_sigmask"):
            signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGTERM})  # a worker is started with it blocked
        yield
    finally:
        sys.unraisablehook = earlier_hook
        signal.signal(signal.SIGTERM, signal.SIG_DFL if earlier is None else earlier)


@contextmanager
def held_back(*signals: signal.Signals) -> Iterator[None]:
    """Delay these signals to the end of the block, while no library's threads would receive them (not on Windows)."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    earlier = signal.pthread_sigmask(signal.SIG_BLOCK, signals)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, earlier)


def _end(how: type[BaseException], *_: object) -> None:
    raise how
