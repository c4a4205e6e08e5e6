"""The command `mvseg <verb>`: one file per verb, whose `add_options` adds its options; `run` returns the exit code."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from io import TextIOWrapper

from mvseg.system.say import say

INTERRUPTED = 130  # definition: exit code after Ctrl-C, as shells have it
__all__ = ["main"]


def main(argv: Sequence[str] | None = None) -> int:
    """Run one verb, see `mvseg.cli.command.main`. Ctrl-C gives one sentence at any time, even during imports, in which
    libraries may swallow its exception or turn it into another one."""
    try:
        import signal

        for stream in (sys.stdout, sys.stderr):  # a character that the terminal lacks becomes a question mark
            if isinstance(stream, TextIOWrapper):
                stream.reconfigure(errors="replace")
        from mvseg.system.sigterm import held_back

        with held_back(signal.SIGINT):
            from mvseg.cli.command import main as run_command
        return run_command(argv)
    except KeyboardInterrupt:
        pass
    except Exception as error:
        if not _is_interruption(error):
            raise
    say("mvseg: interrupted", to_stderr=True)
    return INTERRUPTED


def _is_interruption(error: BaseException | None) -> bool:
    while error is not None and not isinstance(error, KeyboardInterrupt):
        error = error.__cause__ or error.__context__
    return error is not None
