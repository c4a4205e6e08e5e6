"""How a run works: whether it shows progress, which processes help it, and what it has computed already.

Stages ask here, so that no signature hands it on (as with `decimal.localcontext`, it is a context variable).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack, contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from typing import Any

from tqdm import tqdm

from mvseg.system.worker_pool import start_workers


@dataclass(frozen=True)
class Running:
    """How a run works.

    Attributes:
        progress: show progress bars, and lines that say what was done.
        workers: processes that surfaces are fitted in, see `start_workers`; None: this one.
        kept: {name of what it was computed from: what was computed}; None: nothing is kept.
    """

    progress: bool = False
    workers: ProcessPoolExecutor | None = None
    kept: dict[str, Any] | None = None


SILENT = Running()
_NOW: ContextVar[Running] = ContextVar("mvseg_running")


def now_running() -> Running:
    """How the run that this is called in works; without `running`, silently and in this process."""
    return _NOW.get(SILENT)


@contextmanager
def running(*, progress: bool | None = None, num_workers: int | None = None, keep: bool = False) -> Iterator[None]:
    """Let all of mvseg that is called inside the block work so. A thread that is started there does not know of it.

    Args:
        progress: show progress bars; None: as outside.
        num_workers: processes that surfaces are fitted in, stopped at the end, see `start_workers`; None: as outside.
        keep: what was computed inside, or outside where that is kept, too, is not computed again, see `fit_kept`.

    Raises:
        InputError: fewer than one process.
    """
    outside = now_running()
    with ExitStack() as stack:
        workers = outside.workers if num_workers is None else stack.enter_context(start_workers(num_workers))
        is_shown = outside.progress if progress is None else progress
        kept = {} if keep and outside.kept is None else outside.kept
        stack.callback(_NOW.reset, _NOW.set(Running(progress=is_shown, workers=workers, kept=kept)))
        yield


def progress_bar(items: Iterable[Any] | None = None, name: str = "", total: int | None = None, **how: Any) -> Any:
    """tqdm's bar with a name in front, hidden where the run is silent; `how` are more options of tqdm."""
    return tqdm(items, name, total, disable=not now_running().progress, **how)
