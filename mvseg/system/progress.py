"""One line: how far a command is, and how long the rest will take at the speed of this run."""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence

from mvseg.system.say import show_line

# fitted: python -m benchmarks.speed (CPU seconds of plants of 9 to 12 photos; of one pass, and of one round)
EXPECTED = {"load": 2.0, "detect": 5.0, "match": 3.0, "choose": 5.0, "learn": 100.0, "snap": 1.0, "surfaces": 3.0,
            "check": 1.0, "voxels": 0.3, "measure": 2.0, "write": 1.5}  # fmt: skip
NETWORKS = "detect", "learn"  # definition: stages that networks work in; the only bar of these is all of it
COVERS = 0.5  # chosen: share of the rest of another stage that one of its bars covers: nobody knows how many come
TERMINAL_SECONDS = 0.1  # limit: between two changes of the line on a terminal
LINE_SECONDS = 30.0  # limit: between two lines in a file or a pipe


class Progress:
    """How far a command is. Its total is that of the plan: `to_come` only shrinks, so that the line never goes back.
    Without a plan, each bar is all that is known of the command."""

    def __init__(self, plan: Sequence[str] = (), *, is_shown: bool = False) -> None:
        self.is_shown = is_shown
        self.to_come, self.total = list(plan), sum(EXPECTED[stage] for stage in plan)
        self._stage, self._part, self._spent = "", 0.0, 0.0
        self._begun = self._shown = time.monotonic()
        self._text, self._told = "", ""

    def __bool__(self) -> bool:
        return self.is_shown

    def begin(self, stage: str) -> None:
        """Begin a stage. The stages planned before it do not come. A stage that was not planned is part of the present
        one, as are passes of the detector that are more than those planned before the next round of learning."""
        is_pass = stage in ("detect", "match", "choose") and "learn" in self.to_come
        planned = self.to_come[: self.to_come.index("learn")] if is_pass else self.to_come
        if not self.total:
            self._stage, self._part, self._begun = stage, 0.0, time.monotonic()
        elif stage in planned and stage != self._stage:
            self._spent += EXPECTED.get(self._stage, 0.0)
            del self.to_come[: planned.index(stage) + 1]
            self._stage, self._part = stage, 0.0
        self._shown -= TERMINAL_SECONDS
        self.show(stage, 0.0)

    def show(self, words: str, part: float, *, ends: bool = False) -> None:
        """Show a bar that is at this part of itself, from 0 to 1, or `ends` there."""
        cost, now = EXPECTED.get(self._stage, 1.0), time.monotonic()
        covers = COVERS if self.total and self._stage not in NETWORKS else 1.0
        reached = self._part + (1 - self._part) * covers * part
        self._part = reached if ends else self._part
        spent, rest = self._spent + cost * reached, cost * (1 - reached) + sum(EXPECTED[each] for each in self.to_come)
        time_left = ""
        if self._spent if self.total else part:  # the speed is measured
            minutes, seconds = divmod(round((now - self._begun) * rest / spent), 60)
            time_left = f", {'up to ' if 'learn' in self.to_come else ''}{minutes:02}:{seconds:02} left"
        self._text = f"{1 - rest / self.total:.0%}{time_left}: {words}" if self.total else f"{words}{time_left}"
        if self.is_shown and now - self._shown > (TERMINAL_SECONDS if sys.stderr.isatty() else LINE_SECONDS):
            self._shown = now
            show_line(self._text)

    def end(self, stage: str) -> None:
        """End a stage: in a file or a pipe it has a line, but one if it comes several times in a row."""
        if self.is_shown and stage != self._told and not sys.stderr.isatty():
            self._shown, self._told = time.monotonic(), stage
            show_line(self._text)
