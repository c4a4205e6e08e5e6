"""Spreads items over processes of this machine: those of one job, whose answers come in order, or scenes of a batch.

A pool of `concurrent.futures` breaks when one of its processes is killed. So each process is a pool of its own: if it
dies, only its own item is lost.
"""

from __future__ import annotations

import multiprocessing
import os
import pickle
import signal
import threading
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence, Sized
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import ExitStack, contextmanager, suppress
from importlib import import_module
from multiprocessing.connection import Connection
from typing import Any, TypeAlias, TypeVar

from mvseg.errors import InputError, warn
from mvseg.system.sigterm import held_back
from mvseg.system.threads import stay_on_one_thread

Item = TypeVar("Item")
Answer = TypeVar("Answer")
Asked: TypeAlias = "Future[tuple[Answer, list[Warning]]]"
Workers: TypeAlias = Sequence[ProcessPoolExecutor]  # each of one process
SAFE_PATH = "PYTHONSAFEPATH"
AHEAD = 16  # limit: answers that wait for an earlier one: a slow item blocks no others, and few are in memory


@contextmanager
def start_workers(num_workers: int) -> Iterator[Workers]:
    """Open pools of one spawned process each, which start on demand. At the end of the block they are stopped at once,
    whatever they do. A script that asks for several needs `if __name__ == "__main__":`, as with all of Python's spawned
    processes. Raises InputError for fewer than one."""
    if num_workers < 1:
        raise InputError(f"num_workers is {num_workers}, expected at least 1")
    with ExitStack() as stack:
        yield [stack.enter_context(_start_pool()) for _ in range(num_workers)]


@contextmanager
def _start_pool() -> Iterator[ProcessPoolExecutor]:
    before = {name: value for name, value in os.environ.items() if name == SAFE_PATH}
    os.environ[SAFE_PATH] = "1"  # the process imports no module of the user's folder
    context = multiprocessing.get_context("spawn")
    theirs, ours = context.Pipe(duplex=False)
    pool = ProcessPoolExecutor(1, context, initializer=_start_worker, initargs=(theirs,))
    try:
        yield pool
    finally:
        os.environ.pop(SAFE_PATH, None)
        os.environ.update(before)
        ours.close()  # an orderly shutdown of the interpreter would take seconds
        pool.shutdown(cancel_futures=True)


def default_workers() -> int:
    """One for each core that this process may use, but at most four: each takes half a gigabyte of memory."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return min(4, cores)


def load_ahead(workers: Workers, module: str) -> None:
    """Let all processes start and load a module, which takes seconds, before anybody waits for them."""
    for pool in workers if len(workers) > 1 else ():
        pool.submit(import_module, module)


def run_each(
    work: Callable[[Item], Answer],
    items: Iterable[tuple[int, Item]],
    workers: Workers,
    *,
    started: Callable[[int], object] = int,
    held: Sized = (),
) -> Iterator[tuple[int, Asked[Answer]]]:
    """Do work in processes. Yields keys of items and answers for `receive`, in the order in which they come; that of an
    item whose process died has BrokenProcessPool as its exception, and another process takes over.

    Args:
        work: function of a module, or `partial` of it.
        items: keys, and items that can be pickled.
        started: called with the key of an item when a process takes it.
        held: answers that the caller holds back: with `AHEAD` of them, no further item is taken.
    """
    todo, free = iter(items), [*workers]
    asked: dict[Asked[Answer], tuple[int, ProcessPoolExecutor]] = {}
    with ExitStack() as stack:
        while True:
            while free and len(held) < AHEAD and (following := next(todo, None)) is not None:
                key, item = following
                started(key)
                pool = free.pop()
                # pickled here: multiprocessing would move tensors into shared memory, which containers have little of
                pickled = pickle.dumps((work, item))
                with held_back(signal.SIGINT):  # a process that starts inherits this: Ctrl-C is left to the parent
                    asked[pool.submit(_answer, pickled)] = key, pool
            if not asked:
                return
            for future in wait(asked, return_when=FIRST_COMPLETED).done:
                key, pool = asked.pop(future)
                has_died = isinstance(future.exception(), BrokenProcessPool)
                free.append(stack.enter_context(_start_pool()) if has_died else pool)
                yield key, future


def receive(future: Asked[Answer]) -> Answer:
    """The answer; the warnings of the worker are repeated here."""
    answer, noticed = future.result()
    for each in noticed:
        warn(each)
    return answer


def map_in_order(work: Callable[[Item], Answer], items: Iterable[Item], workers: Workers) -> Iterator[Answer]:
    """`map(work, items)`, in processes if there are several, see `run_each`; their warnings are given here. Raises
    InputError if a process was killed."""
    if len(workers) < 2:
        yield from map(work, items)
        return
    held: dict[int, Asked[Answer]] = {}
    following = 0
    try:
        for key, future in run_each(work, enumerate(items), workers, held=held):
            held[key] = future
            while following in held:
                yield receive(held.pop(following))
                following += 1
    except BrokenProcessPool as error:
        message = "a worker process was killed, as systems do when memory runs out: expected fewer workers"
        raise InputError(message) from error


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
