"""Bad input: an exception that ends a run with one sentence, and a warning that does not."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager


class InputError(ValueError):
    """Wrong input from the user (a file, a camera, a mask, an option).

    The message is one sentence that names the file, the view or the index, and what was expected. The command line
    prints it and exits with code 2; from Python it is an ordinary `ValueError`.
    """


class InputWarning(UserWarning):
    """The input is odd but usable; the message says what was done about it. Kept in a result's `run.json`."""


def warn(said: str | Warning) -> None:
    """Warn (InputWarning) as of the line outside of this package that led here; one that was caught is repeated."""
    frame, level = sys._getframe(1), 2
    while frame.f_back is not None and frame.f_globals.get("__name__", "").startswith("mvseg."):
        frame, level = frame.f_back, level + 1
    warnings.warn(said, InputWarning, stacklevel=level)


@contextmanager
def collect_warnings() -> Iterator[list[str]]:
    """The sentences of InputWarnings inside the block, each once, when it ends; they are not given. Other warnings
    are."""
    sentences: list[str] = []
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", InputWarning)
        yield sentences
    ours = (str(each.message) for each in caught if issubclass(each.category, InputWarning))
    sentences += dict.fromkeys(ours)
    for other in (each for each in caught if not issubclass(each.category, InputWarning)):
        warnings.warn_explicit(other.message, other.category, other.filename, other.lineno)


@contextmanager
def faults_of(where: object) -> Iterator[None]:
    """Put the place, as a file or a view, in front of the reason of any InputError that is raised inside."""
    try:
        yield
    except InputError as error:
        raise InputError(f"{where}: {error}") from None
