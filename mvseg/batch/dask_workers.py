"""The workers of a Dask cluster: on other machines, started by Slurm, PBS or by hand.

They need the same mvseg, and the same paths to scenes and results: a shared disk.
"""

from __future__ import annotations

import json
import signal
import threading
import uuid
from collections.abc import Callable, Generator, Mapping
from concurrent.futures import CancelledError
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from mvseg.batch.lost import Lost
from mvseg.errors import InputError

if TYPE_CHECKING:
    from distributed import Client

Item = TypeVar("Item")
Answer = TypeVar("Answer")
TIMEOUT = 30  # seconds, for the scheduler to answer


def connect(scheduler: str) -> Client:
    """A client of a Dask scheduler.

    Args:
        scheduler: its address ("tcp://node-07:8786"), or the file that `dask scheduler --scheduler-file FILE` wrote.

    Raises:
        InputError: Dask is not installed, the file is missing or broken, or no scheduler answers.
    """
    try:
        from distributed import Client
    except ModuleNotFoundError as error:
        raise InputError(f"--scheduler needs {error.name}: pip install 'mvseg[batch]'") from None
    address = scheduler
    if "://" not in scheduler and not _is_host_and_port(scheduler):
        address = _read_scheduler_file(Path(scheduler))
    try:
        return Client(address, timeout=TIMEOUT, name="mvseg")
    except (OSError, ValueError) as error:
        raise InputError(f"no Dask scheduler answers at {address} ({' '.join(str(error).split())})") from None


def run_on_dask(
    work: Callable[[Item], Answer],
    items: Mapping[int, Item],
    *,
    client: Client,
    at_once: int | None,
    started: Callable[[int], object],
) -> Generator[tuple[int, Answer | Lost], None, None]:
    """The answers of `work` in the order in which they come, each with the key of its item.

    When a worker dies, the scheduler gives its items to others, up to `allowed-failures` times; then they are lost.
    When the iterator is closed early, items that no worker has started are cancelled; workers finish those that they
    have started.

    Args:
        work: what a module holds, or `partial` of it.
        items: items that can be pickled, by key.
        client: see `connect`.
        at_once: most items that are submitted to the cluster at a time; None for no limit.
        started: called with the key of an item when it is submitted.
    """
    from distributed import as_completed

    batch, todo = uuid.uuid4().hex[:8], iter(items.items())
    key_of: dict[Any, int] = {}
    client.register_plugin(_build_plugin(), name="mvseg")
    running = as_completed(loop=client.loop)
    try:
        while True:
            while at_once is None or len(key_of) < at_once:
                key, item = next(todo, (None, None))
                if key is None:
                    break
                future = client.submit(work, item, key=f"mvseg-{batch}-{key}", pure=False)
                key_of[future] = key
                running.add(future)
                started(key)
            if not key_of:
                return
            future = next(running)
            answer = _read_answer(future)
            yield key_of.pop(future), answer
    finally:
        if key_of:
            client.cancel(list(key_of))


def _read_answer(future: Any) -> Any:
    try:
        error = future.exception()
    except CancelledError as cancelled:
        error = cancelled
    if error is None:
        return future.result()
    if type(error).__name__ == "KilledWorker":
        return Lost("died with its worker, most likely because memory ran out; see the worker's log")
    return Lost(f"stopped with {type(error).__name__}: {' '.join(str(error).split())}")


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


def _is_host_and_port(text: str) -> bool:
    host, _, port = text.rpartition(":")
    return bool(host) and port.isdigit() and not Path(text).exists()


def _read_scheduler_file(path: Path) -> str:
    try:
        address = json.loads(path.read_text(encoding="utf-8"))["address"]
    except OSError as error:
        message = f"cannot be read ({error.strerror}), expected the address of a Dask scheduler, or its file"
        raise InputError(f"{path}: {message}") from None
    except (ValueError, KeyError, TypeError):
        raise InputError(f"{path}: is not a scheduler file of Dask, expected that of dask scheduler") from None
    return str(address)
