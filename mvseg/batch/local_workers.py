"""Processes on this machine that work on a list, one item at a time.

A pool of `concurrent.futures` breaks when one of its processes is killed. So each process is a pool of its own here: if
it dies, only its own item is lost.
"""

from __future__ import annotations

import signal
from collections.abc import Callable, Generator, Mapping
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from typing import Any, TypeVar

from mvseg.batch.lost import Lost
from mvseg.errors import InputError
from mvseg.system.sigterm import held_back
from mvseg.system.worker_pool import one_thread, start_pools

Item = TypeVar("Item")
Answer = TypeVar("Answer")


def run_locally(
    work: Callable[[Item], Answer],
    items: Mapping[int, Item],
    *,
    num_workers: int,
    started: Callable[[int], object],
) -> Generator[tuple[int, Answer | Lost], None, None]:
    """The answers of `work` in the order in which they come, each with the key of its item.

    Workers are spawned, use one thread, and end with this process, however that ends. When the iterator is closed
    early, they are stopped at once.

    Args:
        work: what a module holds, or `partial` of it.
        items: items that can be pickled, by key.
        num_workers: at most that many processes, >= 1.
        started: called with the key of an item when a worker takes it.

    Raises:
        InputError: no worker can be started.
    """
    todo = dict(items)
    asked: dict[Future[Any], tuple[int | None, ProcessPoolExecutor]] = {}  # None: whether the worker has started
    with start_pools() as start_pool:
        for _ in range(min(num_workers, len(items))):
            asked |= _start_worker(start_pool(1), work)
        while asked:
            for future in wait(asked, return_when=FIRST_COMPLETED).done:
                key, worker = asked.pop(future)
                error = future.exception()
                has_died = isinstance(error, BrokenProcessPool)
                if key is None and has_died:
                    if not asked:
                        raise InputError("no worker can be started: the process dies before it has anything to do")
                    continue  # the others go on
                if todo and has_died:
                    asked |= _start_worker(start_pool(1), work)
                elif todo:
                    following = next(iter(todo))
                    started(following)
                    asked[worker.submit(work, todo.pop(following))] = following, worker
                if key is not None:
                    yield key, future.result() if error is None else _describe(error)


def _start_worker(
    worker: ProcessPoolExecutor, work: Callable[[Any], Any]
) -> dict[Future[Any], tuple[None, ProcessPoolExecutor]]:
    # it inherits the blocked signals: Ctrl-C is left to the parent
    with one_thread(), held_back(signal.SIGINT):
        return {worker.submit(_load, work): (None, worker)}


def _load(work: Callable[[Any], Any]) -> None:
    """In a worker: import the modules that `work` needs, without pycolmap's handler, which prints a trace on
    SIGTERM."""
    import pycolmap  # noqa: F401

    signal.signal(signal.SIGTERM, signal.SIG_DFL)


def _describe(error: BaseException) -> Lost:
    if isinstance(error, BrokenProcessPool):
        return Lost("died, most likely because memory ran out")
    return Lost(f"stopped with {type(error).__name__}: {' '.join(str(error).split())}")
