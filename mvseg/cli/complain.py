"""One sentence on stderr."""

from __future__ import annotations

import sys

from mvseg.errors import InputError

BAD_INPUT = 2


def complain(error: Exception) -> int:
    """Print what is wrong with the input, on one line; returns the exit code."""
    if isinstance(error, OSError) and error.filename:
        error = InputError(f"{error.filename}: {error.strerror}")
    print(f"mvseg: error: {' '.join(str(error).split())}", file=sys.stderr)
    return BAD_INPUT
