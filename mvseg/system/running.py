"""How a run works: whether it shows progress, which processes help it, and whether it is still wanted.

Stages ask here, so that no signature hands it on (as with `decimal.localcontext`, it is a context variable).
"""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence, Sized
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack, contextmanager, nullcontext
from contextvars import ContextVar
from dataclasses import dataclass, field
from typing import Any

from tqdm import tqdm

from mvseg.system.say import say, say_beside_bars
from mvseg.system.threads import on_one_thread
from mvseg.system.whole_command import EXPECTED, WholeCommand
from mvseg.system.worker_pool import start_workers


@dataclass(frozen=True)
class Running:
    """How a run works.

    Attributes:
        progress: show progress bars, and lines that say what was done.
        workers: processes that surfaces are fitted in, see `start_workers`; None: this one.
        seconds: {stage: wall time}, see `timed`.
        is_cancelled: asked before each stage, see `timed`.
        report: progress callback; None disables it.
        told: names of the progress bars that have a line already, where there is no terminal.
        whole: how far the command is, of which this is a part; None: nobody asks.
    """

    progress: bool = False
    workers: ProcessPoolExecutor | None = None
    seconds: dict[str, float] = field(default_factory=dict, compare=False)
    is_cancelled: Callable[[], bool] = field(default=lambda: False, compare=False)
    report: Callable[[str], None] | None = field(default=None, compare=False)
    told: set[str] = field(default_factory=set, compare=False)
    whole: WholeCommand | None = field(default=None, compare=False)


class Cancelled(Exception):
    """The run is not wanted any more."""


NETWORKS = "detect", "learn"  # definition: stages that networks work in
LINE_SECONDS = 60.0  # limit: between two lines of one stage
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
    with ExitStack() as stack:
        workers = outside.workers if num_workers is None else stack.enter_context(start_workers(num_workers))
        is_shown = outside.progress if progress is None else progress
        cancelled = outside.is_cancelled if is_cancelled is None else is_cancelled
        told = outside.told if outside.progress else set()
        report = outside.report if report is None else report
        whole = outside.whole
        if plan and is_shown:
            whole = WholeCommand(plan)
            stack.callback(whole.close)
        now = Running(
            progress=is_shown,
            workers=workers,
            is_cancelled=cancelled,
            report=report,
            told=told,
            whole=whole,
        )
        stack.callback(_NOW.reset, _NOW.set(now))
        yield now


@contextmanager
def timed(stage: str) -> Iterator[None]:
    """A stage of a run, on one thread unless a network does the work (`NETWORKS`): `Running.seconds` has its wall time,
    the sum if it comes more than once. Raises `Cancelled` if the run is not wanted any more."""
    now = now_running()
    if now.is_cancelled():
        raise Cancelled
    if now.whole is not None:
        now.whole.begin(stage)
    begun = time.perf_counter()
    with nullcontext() if stage in NETWORKS else on_one_thread():
        yield
    now.seconds[stage] = now.seconds.get(stage, 0.0) + time.perf_counter() - begun


def report_step(sentence: str) -> None:
    """Report the present step to the callback of the run, or print it beside the bars; nothing in a silent run."""
    if (report := now_running().report) is not None:
        report(sentence)
    elif now_running().progress:
        say_beside_bars(sentence)


def expected_minutes(stage: str) -> str:
    """Expected time of a stage, in words: the measured ratio to detection, times the time of detection."""
    seconds = now_running().seconds.get("detect", 0.0) * EXPECTED[stage] / EXPECTED["detect"]
    return f"some {max(1, round(seconds / 60))} minutes"


def progress_bar(
    items: Iterable[Any] | None = None, name: str = "", total: int | None = None, *, unit: str = "step"
) -> Any:
    """tqdm's bar with a name in front, hidden where the run is silent. On a terminal, each takes the line of the one
    before; in a file or a pipe, each name has a line at its end, and one a minute until then."""
    now = now_running()
    if now.report is not None or (now.progress and now.whole is not None):
        return _Part(items, name, total, unit=unit)
    if not now.progress or sys.stderr.isatty():
        form = f"{{desc}}: {unit} {{n_fmt}} of {{total_fmt}}, {{remaining}} left{{postfix}}"
        return tqdm(items, name, total, unit=unit, bar_format=form, leave=False, disable=not now.progress)
    is_told = name in now.told
    now.told.add(name)
    form = f"{{desc}}: {{percentage:.0f}}% of {{total_fmt}} {unit}s, {{elapsed}}{{postfix}}"
    return _Lines(items, name, total, unit=unit, bar_format=form, leave=True, disable=is_told)


class _Part:
    """A bar of one stage: reported, or part of the command's line; in a file or a pipe, a line at its first end."""

    def __init__(self, items: Iterable[Any] | None, name: str, total: int | None, *, unit: str) -> None:
        self.items, self.name, self.unit, self.n = items, name, unit, 0
        self.total = len(items) if total is None and isinstance(items, Sized) else total

    def __iter__(self) -> Iterator[Any]:
        with self:
            for item in self.items or ():
                if (now := now_running()).report is not None:
                    if now.is_cancelled():
                        raise Cancelled
                    now.report(f"{self.name}: {self.unit} {self.n + 1} of {self.total}")
                yield item
                self.update()

    def __enter__(self) -> _Part:
        self.update(0)
        return self

    def __exit__(self, *_: object) -> None:
        self._show(ends=True)
        now = now_running()
        if now.whole is not None and not sys.stderr.isatty() and self.name not in now.told:
            now.told.add(self.name)
            say(now.whole.text, to_stderr=True)

    def update(self, more: int = 1) -> None:
        self.n += more
        self._show(ends=False)

    def _show(self, *, ends: bool) -> None:
        if (whole := now_running().whole) is not None:
            count = f" of {self.total}" if self.total else ""
            part = min(1.0, self.n / self.total) if self.total else 0.0
            whole.advance(part, f"{self.name}: {self.unit} {self.n}{count}", ends=ends)


class _Lines(tqdm):  # type: ignore[misc]  # it has no types
    said_at = math.inf

    def __init__(self, *what: Any, **how: Any) -> None:
        super().__init__(*what, **how)
        self.said_at = time.monotonic()

    def display(self, msg: str | None = None, pos: int | None = None) -> bool:
        """At the end, `pos` is 0, and tqdm ends the line."""
        if pos == 0:
            self.fp.write(str(self))
        elif time.monotonic() - self.said_at > LINE_SECONDS:
            self.fp.write(f"{self}\n")
            self.said_at = time.monotonic()
        return True
