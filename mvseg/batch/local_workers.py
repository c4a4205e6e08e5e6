"""Processes on this machine that work through a list, one item after another.

`concurrent.futures` gives up a whole pool when one of its processes is killed, and does not tell which item it had.
Here a process that dies loses its own item only.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import threading
from collections.abc import Callable, Generator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from typing import Any, TypeVar

from tqdm import tqdm

from mvseg.batch.lost import Lost
from mvseg.errors import InputError
from mvseg.system.sigterm import Terminated, end_with_parent, held_back, stopped_by_sigterm
from mvseg.system.worker_pool import one_thread

Item = TypeVar("Item")
Answer = TypeVar("Answer")
GRACE = 20.0  # seconds for a worker to clear away what it has half written, before it is killed
TERMINATED = 143


@dataclass(eq=False)
class _Worker:
    """A process, and the key of the item it works on; None while it starts, and in the end."""

    process: BaseProcess
    connection: Connection
    has_started: bool = False
    key: Any = None


def run_locally(
    work: Callable[[Item], Answer],
    items: Mapping[int, Item],
    *,
    num_workers: int,
    started: Callable[[int], object],
) -> Generator[tuple[int, Answer | Lost], None, None]:
    """The answers of `work` in the order in which they come, each with the key of its item.

    Workers are spawned, run on one thread, and end with this process, however that ends. When the iterator is closed
    before its end, they get SIGTERM, which `work` sees as `Terminated`.

    Args:
        work: what a module holds, or `partial` of it.
        items: items that can be pickled, by key.
        num_workers: at most that many processes, >= 1.
        started: is told the key of an item when a worker takes it.

    Raises:
        InputError: no worker can be started.
    """
    todo = dict(items)
    workers: list[_Worker] = []
    try:
        while len(workers) < min(num_workers, len(items)):
            workers.append(_start_worker(work))
        while workers:
            for connection in wait([worker.connection for worker in workers]):
                worker = next(each for each in workers if each.connection is connection)
                key, answer = worker.key, _receive(worker)
                worker.key = None
                worker.has_started |= not isinstance(answer, Lost)
                has_died = not worker.process.is_alive()
                if has_died:
                    workers.remove(worker)
                if key is not None:
                    yield key, answer
                if not has_died:
                    _hand_out(worker, todo, workers, started=started)
                elif todo and worker.has_started:
                    workers.append(_start_worker(work))
                elif todo and not workers:
                    raise InputError(f"no worker can be started: the process {answer.reason}")
    finally:
        _stop(workers)


def _hand_out(
    worker: _Worker, todo: dict[int, Any], workers: list[_Worker], *, started: Callable[[int], object]
) -> None:
    """Give a worker its next item, or send it home. One that has just died is noticed when its answer is read."""
    if not todo:
        workers.remove(worker)
        worker.connection.close()
        _join(worker.process)
        return
    worker.key = next(iter(todo))
    started(worker.key)
    with suppress(OSError):
        worker.connection.send(todo.pop(worker.key))


def _receive(worker: _Worker) -> Any:
    """The worker's answer; None when it has just started."""
    try:
        return worker.connection.recv()
    except (EOFError, OSError):
        _join(worker.process)
        code = worker.process.exitcode or 0
        if code == -getattr(signal, "SIGKILL", 9):
            return Lost("was killed (SIGKILL), as systems do when memory runs out")
        return Lost(f"was ended by signal {-code}" if code < 0 else f"ended with exit code {code}")


def _start_worker(work: Callable[[Any], Any]) -> _Worker:
    context = multiprocessing.get_context("spawn")
    here, there = context.Pipe()
    process = context.Process(target=_serve, args=(there, work), daemon=True)
    # not to be torn apart while a process is started; it inherits this: Ctrl-C is for the parent alone to hear
    with one_thread(), held_back(signal.SIGINT, signal.SIGTERM):
        process.start()
    there.close()  # so that this process hears when the other end is gone
    return _Worker(process, here)


def _serve(connection: Connection, work: Callable[[Any], Any]) -> None:
    """Be a worker: answer each item, until there are no more."""
    threading.Thread(target=end_with_parent, daemon=True).start()
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    tqdm.set_lock(threading.RLock())  # instead of one that all processes share, and that has to be given back
    code = 0
    try:
        with stopped_by_sigterm():
            connection.send(None)
            while True:
                item = connection.recv()
                try:
                    answer = work(item)
                except Exception as error:
                    answer = Lost(f"stopped with {type(error).__name__}: {' '.join(str(error).split())}")
                connection.send(answer)
    except (EOFError, OSError):  # the parent has closed the pipe, or is gone
        pass
    except Terminated:
        code = TERMINATED
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)  # taking all modules apart first takes seconds


def _stop(workers: list[_Worker]) -> None:
    """End all workers: those that have an item may clear away what is half written, others have nothing."""
    for worker in workers:
        if worker.key is None:
            worker.process.kill()
        else:
            worker.process.terminate()
    for worker in workers:
        _join(worker.process)
        worker.connection.close()


def _join(process: BaseProcess) -> None:
    process.join(GRACE)
    if process.is_alive():
        process.kill()
        process.join()
