"""Workers that go through a list of items: processes of this machine, or those of a Dask cluster.

A local process that dies loses only its own item. The workers of a cluster are on other machines, started by Slurm,
PBS or by hand; they need the same mvseg, and the same paths to scenes and results: a shared disk.
"""

from __future__ import annotations

import json
import logging
import signal
import threading
import uuid
from collections.abc import Callable, Generator, Iterator, Mapping
from concurrent.futures import CancelledError
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from mvseg.errors import InputError
from mvseg.system.worker_pool import receive, run_each, start_workers

if TYPE_CHECKING:
    from distributed import Client

Item = TypeVar("Item")
Answer = TypeVar("Answer")
Started = Callable[[int], object]
Engine = Callable[[Mapping[int, Any], Started], Generator[tuple[int, Any], None, None]]
TIMEOUT = 30  # limit: seconds, for a Dask scheduler to answer


@dataclass(frozen=True)
class Lost:
    """The answer for an item whose worker died, or could not even report what went wrong; `reason` is the end of a
    sentence: "the process that worked on it ..."."""

    reason: str


@contextmanager
def open_workers(work: Callable[[Any], Any], num_workers: int, scheduler: str | None) -> Iterator[Engine]:
    """Open workers that do `work` on items: `run_on_dask` where there is a scheduler, else `run_locally`. Raises
    InputError, see `connect`."""
    if scheduler is None:
        yield partial(run_locally, work, num_workers=num_workers)
    else:
        with connect(scheduler) as client:
            yield partial(run_on_dask, work, client=client)


# --- processes of this machine


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


# --- a Dask cluster


def connect(scheduler: str) -> Client:
    """A client of a Dask scheduler, by its address ("tcp://node-07:8786"), or by the file that `dask scheduler
    --scheduler-file FILE` wrote. Raises InputError if Dask is not installed, the file is missing or broken, or no
    scheduler answers."""
    try:
        from distributed import Client
    except ModuleNotFoundError as error:
        raise InputError(f"--scheduler needs {error.name}: pip install 'mvseg[batch]'") from None
    host, _, port = scheduler.rpartition(":")
    is_address = "://" in scheduler or (host and port.isdigit() and not Path(scheduler).exists())
    address = scheduler if is_address else _read_scheduler_file(Path(scheduler))
    logging.getLogger("distributed").setLevel(logging.CRITICAL)  # what it logs with traces, is said in one sentence
    try:
        return Client(address, timeout=TIMEOUT, name="mvseg")
    except (OSError, ValueError) as error:
        raise InputError(f"no Dask scheduler answers at {address} ({' '.join(str(error).split())})") from None


def _read_scheduler_file(path: Path) -> str:
    try:
        return str(json.loads(path.read_text(encoding="utf-8"))["address"])
    except OSError as error:
        message = f"cannot be read ({error.strerror}), expected the address of a Dask scheduler, or its file"
        raise InputError(f"{path}: {message}") from None
    except (ValueError, KeyError, TypeError):
        raise InputError(f"{path}: is not a scheduler file of Dask, expected that of dask scheduler") from None


def run_on_dask(
    work: Callable[[Item], Answer], items: Mapping[int, Item], started: Started, *, client: Client
) -> Generator[tuple[int, Answer | Lost], None, None]:
    """Run as `run_locally` does; `started` is called when an item is submitted, which all are at once.

    When a worker dies, the scheduler gives its items to others, up to `allowed-failures` times; then they are lost.
    When the iterator is closed early, items that no worker has started are cancelled; workers finish those that they
    have started. Raises InputError if a worker lacks mvseg, or the scheduler does not answer any more.
    """
    from distributed import as_completed

    try:
        client.register_plugin(_build_plugin(), name="mvseg")
    except Exception as error:  # whatever a worker answers
        _refuse_lost(client, error)
        found = f"{type(error).__name__}: {' '.join(str(error).split())}"
        raise InputError(f"a Dask worker cannot run mvseg ({found}), expected the same mvseg on all workers") from None
    batch, key_of = uuid.uuid4().hex[:8], {}
    try:
        for key, item in items.items():
            key_of[client.submit(work, item, key=f"mvseg-{batch}-{key}", pure=False)] = key
            started(key)
        for future in as_completed(list(key_of), loop=client.loop):
            answer = _read_answer(future, client)
            yield key_of.pop(future), answer
    except (OSError, CancelledError) as error:
        _refuse_lost(client, error)
        raise
    finally:
        with suppress(OSError):  # the scheduler is gone
            client.cancel(list(key_of))


def _refuse_lost(client: Client, error: BaseException) -> None:
    """Raise InputError if it is the scheduler that does not answer any more."""
    if isinstance(error, OSError) or client.status != "running":
        what = "the Dask scheduler does not answer any more"
        raise InputError(f"{what}: start it again, and then this command with --resume true") from None


def _read_answer(future: Any, client: Client) -> Any:
    try:
        error = future.exception()
    except CancelledError as cancelled:
        _refuse_lost(client, cancelled)
        error = cancelled
    if error is None:
        return future.result()
    if type(error).__name__ == "KilledWorker":
        return Lost("died with its worker, most likely because memory ran out; see the worker's log")
    return _lost_by(error)


def _build_plugin() -> Any:
    """For each worker's main thread: pycolmap's import sets a handler for SIGTERM that prints a trace and may hang."""
    from distributed import WorkerPlugin

    class OwnSigterm(WorkerPlugin):
        def setup(self, worker: Any) -> None:
            if threading.current_thread() is not threading.main_thread():
                return
            earlier = signal.getsignal(signal.SIGTERM)
            import pycolmap  # noqa: F401

            signal.signal(signal.SIGTERM, signal.SIG_DFL if earlier is None else earlier)

    return OwnSigterm()
