"""The progress display of a batch."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from tqdm import tqdm

SHOWN = 4  # names beside the bar


class Progress:
    """A progress bar over the scenes with the names of the running ones beside it, and messages above it."""

    def __init__(self, names: Sequence[str], *, quiet: bool) -> None:
        self.names = names
        self.running: dict[int, None] = {}  # in the order in which they began
        self.bar = tqdm(total=len(names), desc="batch", unit="scene", disable=quiet)

    def start(self, index: int) -> None:
        self.running[index] = None
        self._show()

    def stop(self, index: int, *, is_finished: bool) -> None:
        """A scene is done or has failed, or its worker has died."""
        self.running.pop(index, None)
        self.bar.update(int(is_finished))
        self._show()

    def say(self, text: str) -> None:
        """Print a line on stderr, with or without a bar."""
        tqdm.write(f"mvseg: {text}", file=sys.stderr)

    def close(self) -> None:
        self.bar.close()

    def _show(self) -> None:
        shown = [self.names[index] for index in list(self.running)[:SHOWN]]
        more = f" and {len(self.running) - SHOWN} more" if len(self.running) > SHOWN else ""
        self.bar.set_postfix_str(", ".join(shown) + more)
