"""Processes of this machine that go through a list of items: one that dies loses only its own item."""

from __future__ import annotations

import signal
from collections.abc import Callable, Generator, Mapping
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from functools import partial
from typing import Any, TypeVar

from mvseg.system.worker_pool import receive, run_each, start_workers

Item = TypeVar("Item")
Answer = TypeVar("Answer")
Started = Callable[[int], object]
Engine = Callable[[Mapping[int, Any], Started], Generator[tuple[int, Any], None, None]]


@dataclass(frozen=True)
class Lost:
    """The answer for an item whose worker died, or could not even report what went wrong; `reason` is the end of a
    sentence: "the process that worked on it ..."."""

    reason: str


def run_locally(
    work: Callable[[Item], Answer], items: Mapping[int, Item], started: Started, *, num_workers: int
) -> Generator[tuple[int, Answer | Lost], None, None]:
    """The answers of `work` in the order in which they come, each with the key of its item.

    At most `num_workers`, >= 1, are spawned; they use one thread, and end with this process, however that ends. When
    the iterator is closed early, they are stopped at once. `work` is a function of a module, or `partial` of it;
    `items`, by key, can be pickled; `started` is called with the key of an item when a worker takes it.
    """
    with start_workers(num_workers) as workers:
        for key, future in run_each(partial(_work_alone, work), items.items(), workers, started=started):
            error = future.exception()
            yield key, receive(future) if error is None else _lost_by(error)


def _work_alone(work: Callable[[Item], Answer], item: Item) -> Answer:
    """Work in a process whose main thread this is; pycolmap's handler of SIGTERM, which its import sets, goes."""
    import pycolmap  # noqa: F401

    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    return work(item)


def _lost_by(error: BaseException) -> Lost:
    if isinstance(error, BrokenProcessPool):
        return Lost("died, most likely because memory ran out")
    return Lost(f"stopped with {type(error).__name__}: {' '.join(str(error).split())}")
