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
PASSES = ("detect", "match", "choose") * 3  # chosen: most plants that the detector does not know take so many
ROUND = "snap", "learn", *PASSES  # definition: of learning
MAY_COME = 0.2  # chosen: share of the rounds of learning that the line counts before anybody knows whether they come
COVERS = 0.5  # chosen: share of the rest of another stage that one of its bars covers: nobody knows how many come
TERMINAL_SECONDS = 0.1  # limit: between two changes of the line on a terminal
LINE_SECONDS = 30.0  # limit: between two lines in a file or a pipe


class Progress:
    """How far a command is. Each step moves the line by its part of the rest: it never goes back or jumps. Without a
    plan, each bar is all that is known. `plan`: stages in order, with each `ROUND` of learning that may come."""

    def __init__(self, plan: Sequence[str] = (), *, is_shown: bool = False) -> None:
        self.is_shown, self.is_planned, self.to_come = is_shown, bool(plan), list(plan)
        self._begun = self._shown = time.monotonic()
        self._stage, self._text, self._told = "", "", ""
        # costs of the stages that are over, and to come: sure ones, and rounds; the line, as the stage begins and ends
        self._spent = self._rest = self._in_rounds = self._share = self._goal = self._part = 0.0

    def __bool__(self) -> bool:
        return self.is_shown

    def begin(self, stage: str) -> None:
        """Begin a stage. The stages planned before it do not come. A stage that was not planned is part of the present
        one, as are passes of the detector that are more than those planned before the next round of learning."""
        is_pass = stage in ("detect", "match", "choose") and "learn" in self.to_come
        planned = self.to_come[: self.to_come.index("learn")] if is_pass else self.to_come
        if not self.is_planned:
            self._stage, self._part, self._begun = stage, 0.0, time.monotonic()
        elif stage in planned and stage != self._stage:
            self._spent += EXPECTED.get(self._stage, 0.0)
            del self.to_come[: planned.index(stage) + 1]
            self._stage, self._part, self._share = stage, 0.0, self._goal
            self._in_rounds = self.to_come.count("learn") * sum(EXPECTED[each] for each in ROUND)
            self._rest = sum(EXPECTED[each] for each in self.to_come) - self._in_rounds
            self._goal += (1 - self._goal) / (1 + (self._rest + MAY_COME * self._in_rounds) / EXPECTED[stage])
        self._shown -= TERMINAL_SECONDS
        self.show(stage, 0.0)

    def show(self, words: str, part: float, *, ends: bool = False) -> None:
        """Show a bar that is at this part of itself, from 0 to 1, or `ends` there."""
        cost, now = EXPECTED.get(self._stage, 1.0), time.monotonic()
        covers = COVERS if self.is_planned and self._stage not in NETWORKS else 1.0
        reached = self._part + (1 - self._part) * covers * part
        self._part = reached if ends else self._part
        spent, rest = self._spent + cost * reached, self._rest + cost * (1 - reached)
        time_left = ""
        if self._spent if self.is_planned else part:  # the speed is measured
            seconds = [(now - self._begun) * each / spent for each in (rest, rest + self._in_rounds)]
            least, most = ["{:02}:{:02}".format(*divmod(round(each), 60)) for each in seconds]
            time_left = f", {least} left" + (f" ({most} if it learns more)" if self._in_rounds else "")
        share = self._share + (self._goal - self._share) * reached
        self._text = f"{share:.0%}{time_left}: {words}" if self.is_planned else f"{words}{time_left}"
        if self.is_shown and now - self._shown > (TERMINAL_SECONDS if sys.stderr.isatty() else LINE_SECONDS):
            self._shown = now
            show_line(self._text)

    def end(self, name: str, *, is_stage: bool) -> None:
        """End a stage, or a bar without a plan: it has a line in a file or a pipe; one if it comes again and again."""
        if self.is_shown and is_stage == self.is_planned and name != self._told and not sys.stderr.isatty():
            self._shown, self._told = time.monotonic(), name
            show_line(self._text)
