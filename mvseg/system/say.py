"""The one place that writes to the terminal: what a stranger's file or name holds cannot command it."""

from __future__ import annotations

import re
import sys
from shutil import get_terminal_size

# Control characters but line feed and tab, and those that turn the direction of text.
CONTROL = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u200e\u200f\u202a-\u202e\u2066-\u2069]")
_line = ""  # at the bottom of the terminal


def plain(text: str) -> str:
    r"""The text with each control character as its escape: "\x1b" for the one that begins a terminal's commands."""
    return CONTROL.sub(lambda match: match[0].encode("unicode_escape").decode("ascii"), text)


def say(text: object = "", *, to_stderr: bool = False, end: str = "\n") -> None:
    """Print on stdout, or on stderr, at once, in place of the line of `show_line`."""
    if _line:
        show_line("")
    print(plain(str(text)), end=end, file=sys.stderr if to_stderr else sys.stdout, flush=True)


def show_line(text: str) -> None:
    """Show one line on stderr: at the bottom of a terminal, in place of the one before, which "" takes away."""
    global _line
    if sys.stderr.isatty() and (text or _line):
        earlier, _line = _line, plain(text)[: get_terminal_size().columns - 1]
        print(f"\r{' ' * len(earlier)}\r{_line}", end="", file=sys.stderr, flush=True)
    elif text:
        say(text, to_stderr=True)
