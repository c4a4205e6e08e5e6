"""The one place that writes to the terminal: what a stranger's file or name holds cannot command it."""

from __future__ import annotations

import re
import sys

# Control characters but line feed and tab, and those that turn the direction of text.
CONTROL = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u200e\u200f\u202a-\u202e\u2066-\u2069]")


def plain(text: str) -> str:
    r"""The text with each control character as its escape: "\x1b" for the one that begins a terminal's commands."""
    return CONTROL.sub(lambda match: match[0].encode("unicode_escape").decode("ascii"), text)


def say(text: object = "", *, to_stderr: bool = False, end: str = "\n") -> None:
    """Print on stdout, or on stderr, at once."""
    print(plain(str(text)), end=end, file=sys.stderr if to_stderr else sys.stdout, flush=True)


def say_beside_bars(sentence: str) -> None:
    """Print "mvseg: " and a sentence on stderr, above the progress bars, which stay where they are."""
    from tqdm import tqdm  # whoever shows bars has it; others need not load it to say a word

    tqdm.write(f"mvseg: {plain(sentence)}", file=sys.stderr)
