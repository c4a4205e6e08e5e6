"""How a run works: whether it shows progress, which processes help it, and whether it is still wanted.

Stages ask here, so that no signature hands it on (as with `decimal.localcontext`, it is a context variable).
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Sequence, Sized
from contextlib import ExitStack, contextmanager, nullcontext
from contextvars import ContextVar
from dataclasses import dataclass, field, replace
from typing import Any

from mvseg.system.progress import NETWORKS, Progress
from mvseg.system.say import say, show_line
from mvseg.system.threads import on_one_thread
from mvseg.system.worker_pool import Workers, start_workers


@dataclass(frozen=True)
class Running:
    """How a run works.

    Attributes:
        progress: how far the command is, and lines that say what was done; None: silent.
        workers: processes that surfaces are fitted in, see `start_workers`; up to one: this one.
        seconds: {stage: wall time}, see `timed`.
        is_cancelled: asked before each stage, see `timed`.
        report: progress callback; None disables it.
    """

    progress: Progress = field(default_factory=Progress, compare=False)
    workers: Workers = ()
    seconds: dict[str, float] = field(default_factory=dict, compare=False)
    is_cancelled: Callable[[], bool] = field(default=lambda: False, compare=False)
    report: Callable[[str], None] | None = field(default=None, compare=False)


class Cancelled(Exception):
    """The run is not wanted any more."""


SILENT = Running()
_NOW: ContextVar[Running] = ContextVar("mvseg_running")


def now_running() -> Running:
    """State of the run that this is called in; without `running`, a silent one in this process."""
    return _NOW.get(SILENT)


@contextmanager
def running(
    *,
    progress: bool | None = None,
    num_workers: int | None = None,
    is_cancelled: Callable[[], bool] | None = None,
    report: Callable[[str], None] | None = None,
    plan: Sequence[str] = (),
) -> Iterator[Running]:
    """Let all of mvseg that is called inside the block work so. A thread that is started there does not know of it.

    Args:
        progress: show progress bars; None: as outside.
        num_workers: processes that surfaces are fitted in, stopped at the end, see `start_workers`; None: as outside.
        is_cancelled: asked before each stage; where it says so, that stage raises `Cancelled`. None: as outside.
        report: is told what is done, as "learning: step 30 of 75"; then `is_cancelled` is asked at each step, too.
            None: as outside.
        plan: stages (`timed`) of the whole command, in order; progress says how long all of them will take. (): as
            outside.

    Raises:
        InputError: fewer than one process.
    """
    outside = now_running()
    given: dict[str, Any] = {"is_cancelled": is_cancelled, "report": report}
    with ExitStack() as stack:
        if plan or progress not in (None, bool(outside.progress)):
            given["progress"] = Progress(plan, is_shown=bool(outside.progress if progress is None else progress))
            stack.callback(show_line, "")
        if num_workers is not None:
            given["workers"] = stack.enter_context(start_workers(num_workers))
        changes = {name: value for name, value in given.items() if value is not None}
        stack.callback(_NOW.reset, _NOW.set(replace(outside, seconds={}, **changes)))
        yield now_running()


@contextmanager
def timed(stage: str) -> Iterator[None]:
    """A stage of a run, on one thread unless a network does the work (`NETWORKS`): `Running.seconds` has its wall time,
    the sum if it comes more than once. Raises `Cancelled` if the run is not wanted any more."""
    now = now_running()
    if now.is_cancelled():
        raise Cancelled
    now.progress.begin(stage)
    begun = time.perf_counter()
    with nullcontext() if stage in NETWORKS else on_one_thread():
        yield
    now.seconds[stage] = now.seconds.get(stage, 0.0) + time.perf_counter() - begun
    now.progress.end(stage, is_stage=True)


def report_step(sentence: str) -> None:
    """Report the present step to the callback of the run, or print it; nothing in a silent run."""
    if (report := now_running().report) is not None:
        report(sentence)
    elif now_running().progress:
        say(f"mvseg: {sentence}", to_stderr=True)


@dataclass
class progress_bar:
    """Count items, or `update` as often as wanted, in the one line of the command. The callback of the run is told of
    each item, and then the run may be cancelled."""

    items: Iterable[Any] = ()
    name: str = ""
    total: int | None = None
    unit: str = "step"
    beside: str = ""
    n: int = 0
    progress: Progress = field(default_factory=lambda: now_running().progress)  # other threads may count, too

    def __iter__(self) -> Iterator[Any]:
        if self.total is None and isinstance(self.items, Sized):
            self.total = len(self.items)
        now = now_running()
        with self:
            for item in self.items:
                if now.report is not None:
                    if now.is_cancelled():
                        raise Cancelled
                    now.report(f"{self.name}: {self.unit} {self.n + 1} of {self.total}")
                yield item
                self.update()

    def __enter__(self) -> progress_bar:
        if not self.progress.is_planned:
            self.progress.begin(self.name)
        return self

    def __exit__(self, *_: object) -> None:
        self.update(0, ends=True)
        self.progress.end(self.name, is_stage=False)

    def update(self, more: int = 1, *, ends: bool = False) -> None:
        """Count more; show what stands `beside` it."""
        self.n += more
        count = f" of {self.total}" if self.total else ""
        part = min(1.0, self.n / self.total) if self.total else 0.0
        self.progress.show(f"{self.name}: {self.unit} {self.n}{count}{self.beside}", part, ends=ends)
