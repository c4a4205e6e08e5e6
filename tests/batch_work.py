"""Work for the workers of a batch that goes wrong as it is told; light, because each worker imports it."""

from __future__ import annotations

import os
import pickle
import signal
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any
from unittest.mock import MagicMock

from mvseg.errors import InputError, warn
from mvseg.findings.finding import Finding
from mvseg.system import worker_pool

start_worker = worker_pool._start_worker


def start_lightly(parent: Connection) -> None:
    """Stands in for the start of a worker: all of it, but for libraries that take a second to load."""
    sys.modules.update(dict.fromkeys(("cv2", "torch", "pycolmap"), MagicMock()))
    start_worker(parent)


def run_here(
    work: Callable[[Any], Any], items: Mapping[int, Any], started: Callable[[int], object], *, num_workers: int
) -> Iterator[tuple[int, Any]]:
    """As `run_locally`, in this process: others take seconds to start. What they would be sent can be sent."""
    assert num_workers >= 1
    for key, item in items.items():
        started(key)
        work_there, item_there = pickle.loads(pickle.dumps((work, item)))
        yield key, work_there(item_there)


def square(number: int) -> tuple[int, int, str | None]:
    """The square, the process, and how many threads its libraries were told to use; some numbers misbehave."""
    if number == 13:
        raise InputError("13 brings bad luck")
    if number == 7:
        warn(Finding("dark_photo", "7"))
    if number < 0:
        os.kill(os.getpid(), signal.SIGKILL)
    return number**2, os.getpid(), os.environ.get("OMP_NUM_THREADS")


def do_as_told(item: str, *_: object) -> tuple[str, int]:
    """The word in capitals and the number of the process; "verb:argument" does something else before."""
    verb, _, argument = item.partition(":")
    if verb == "kill":
        os.kill(os.getpid(), signal.SIGKILL)
    elif verb == "touch":
        time.sleep(0.1)
        Path(argument).touch()
    elif verb == "exit":
        os._exit(7)
    elif verb == "raise":
        raise ValueError("it is\nbroken")
    elif verb == "wait":
        Path(argument, "begun").write_text(str(os.getpid()))
        time.sleep(60)
    elif verb == "threads":
        return os.environ["OMP_NUM_THREADS"], os.getpid()
    return verb.upper(), os.getpid()
