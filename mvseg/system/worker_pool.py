"""Spreads independent items of one job over processes of this machine; the answers come in order.

(In a batch of scenes, one that dies must not stop the others: see `batch.workers`.)
"""

from __future__ import annotations

import multiprocessing
import os
import pickle
import signal
import threading
import warnings
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from importlib import import_module
from multiprocessing.connection import Connection
from typing import Any, TypeVar

from mvseg.errors import InputError, warn
from mvseg.system.threads import stay_on_one_thread

Item = TypeVar("Item")
Answer = TypeVar("Answer")
SAFE_PATH = "PYTHONSAFEPATH"
AHEAD = 16  # limit: items queued for the workers: a slow one blocks no others, and few are in memory twice


def start_workers(num_workers: int) -> AbstractContextManager[ProcessPoolExecutor | None]:
    """A pool of up to `num_workers` processes, see `start_pool`; None for one: the caller does the work. Raises
    InputError for fewer than one."""
    if num_workers < 1:
        raise InputError(f"num_workers is {num_workers}, expected at least 1")
    return nullcontext() if num_workers == 1 else start_pool(num_workers)


@contextmanager
def start_pool(num_workers: int) -> Iterator[ProcessPoolExecutor]:
    """A pool of spawned processes, started on demand. At the end of the block they are stopped at once, whatever they
    do. A script that asks for several needs `if __name__ == "__main__":`, as with all of Python's spawned processes."""
    before = os.environ.get(SAFE_PATH)
    os.environ[SAFE_PATH] = "1"  # no process of it imports a module of the user's folder
    try:
        context = multiprocessing.get_context("spawn")
        theirs, ours = context.Pipe(duplex=False)
        pool = ProcessPoolExecutor(num_workers, context, initializer=_start_worker, initargs=(theirs,))
        try:
            yield pool
        finally:
            ours.close()  # an orderly shutdown of the interpreter would take seconds
            pool.shutdown(cancel_futures=True)
    finally:
        del os.environ[SAFE_PATH]
        if before is not None:
            os.environ[SAFE_PATH] = before


def default_workers() -> int:
    """One for each core that this process may use, but at most four: each takes half a gigabyte of memory."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return min(4, cores)


def load_ahead(workers: ProcessPoolExecutor | None, num_workers: int, module: str) -> None:
    """Let all processes of a pool start and load a module, which takes seconds, before anybody waits for them."""
    if workers is not None:
        for _ in range(num_workers):
            workers.submit(import_module, module)


def map_in_order(
    work: Callable[[Item], Answer], items: Iterable[Item], workers: ProcessPoolExecutor | None
) -> Iterator[Answer]:
    """`map(work, items)`, in processes of the pool if there is one; their warnings are given here. `work` is what a
    module holds, or `partial` of it. Raises InputError if a process was killed."""
    if workers is None:
        yield from map(work, items)
        return
    asked: deque[Future[tuple[Answer, list[Warning]]]] = deque()
    try:
        for item in items:
            # pickled here: multiprocessing would move tensors into shared memory, which containers have little of
            asked.append(workers.submit(_answer, pickle.dumps((work, item))))
            if len(asked) > AHEAD:
                yield _receive(asked.popleft())
        while asked:
            yield _receive(asked.popleft())
    except BrokenProcessPool as error:
        message = "a worker process was killed, as systems do when memory runs out: expected fewer workers"
        raise InputError(message) from error
    finally:
        for each in asked:
            each.cancel()


def run_all(work: Callable[[Item], Answer], items: Iterable[Item], num_workers: int) -> Iterator[Answer]:
    """The answers of `work` for each item in order, from this process or from spawned ones."""
    with start_workers(num_workers) as workers:
        yield from map_in_order(work, items, workers)


def _start_worker(parent: Connection) -> None:
    """Prepare a process of the pool: one thread, an end with its parent's, silent on SIGTERM, deaf to Ctrl-C."""
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with, args=(parent,), daemon=True).start()
    stay_on_one_thread()  # takes seconds, in which the parent may be killed
    from tqdm import tqdm

    tqdm.set_lock(threading.RLock())  # instead of one that all processes share, and that has to be given back


def _end_with(parent: Connection) -> None:
    with suppress(EOFError, OSError):
        parent.recv_bytes()
    os._exit(1)


def _answer(pickled: bytes) -> tuple[Any, list[Warning]]:
    work, item = pickle.loads(pickled)
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        answer = work(item)
    return answer, [each.message for each in said if isinstance(each.message, Warning)]


def _receive(asked: Future[tuple[Answer, list[Warning]]]) -> Answer:
    """The answer; the warnings of the worker are repeated here."""
    answer, said = asked.result()
    for each in said:
        warn(each)
    return answer
