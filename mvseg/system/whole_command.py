"""One line on the terminal: how far a command is, and how long the rest will take."""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence

from tqdm import tqdm

# fitted: python -m benchmarks.speed (CPU seconds of a known plant of 12 photos)
EXPECTED = {"load": 1.0, "detect": 9.0, "match": 2.0, "choose": 5.0, "learn": 30.0, "snap": 0.6, "surfaces": 1.5,
            "check": 1.0, "voxels": 0.3, "measure": 1.5, "write": 3.0}  # fmt: skip
FOLLOWED = {"learn": ("detect", "match", "choose"), "detect": ("match",)}  # definition: what comes after a stage
COVERED = {"detect": 1.0, "learn": 1.0}  # definition: the only bar of these stages is all of it
COVERS = 0.5  # chosen: share of the rest of another stage that one of its bars covers: nobody knows how many come
REFRESH_SECONDS = 0.1  # limit: between two changes of the line
KNOWN = 0.03  # chosen: part of a command after which its speed is known


class WholeCommand:
    """How far a command is, never back again; `to_come` are the planned stages, `text` is that of the line."""

    def __init__(self, stages: Sequence[str]) -> None:
        self.to_come = list(stages)
        self._stage, self._done, self._part, self._shown = "", 0.0, 0.0, 0.0
        self._begun, self.text = time.monotonic(), ""
        self._refreshed = -REFRESH_SECONDS
        self._line = tqdm(total=1, bar_format="{desc}", leave=False, disable=not sys.stderr.isatty(), file=sys.stderr)

    def begin(self, stage: str) -> None:
        """A stage begins. One that was not planned makes the command longer; those before a planned one do not come."""
        self._done += EXPECTED.get(self._stage, 0.0)
        if stage in self.to_come:
            del self.to_come[: self.to_come.index(stage) + 1]
        else:
            self.to_come[:0] = FOLLOWED.get(stage, ())
        self._stage, self._part = stage, 0.0
        self.advance(0.0, stage)

    def advance(self, part: float, words: str, *, ends: bool = False) -> None:
        """A bar of this stage is at this part of itself, from 0 to 1, or it `ends`; `words` say what is done now."""
        reached = self._part + (1 - self._part) * COVERED.get(self._stage, COVERS) * part
        if ends:
            self._part = reached
        done = self._done + EXPECTED.get(self._stage, 0.0) * reached
        whole = self._done + sum(EXPECTED.get(stage, 0.0) for stage in (self._stage, *self.to_come))
        self._shown = max(self._shown, done / max(whole, 1e-9))
        seconds = (time.monotonic() - self._begun) * (whole / max(done, 1e-9) - 1)
        left = f", {tqdm.format_interval(seconds)} left" if self._shown > KNOWN else ""
        self.text = f"{self._shown:.0%}{left}: {words}"
        if time.monotonic() - self._refreshed > REFRESH_SECONDS:
            self._refreshed = time.monotonic()
            self._line.set_description_str(self.text)

    def close(self) -> None:
        """Take the line away."""
        self._line.close()
