"""What the engines of a batch have in common."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Lost:
    """An item whose worker gave no answer: it died, or could not even write down what went wrong.

    Attributes:
        reason: the end of a sentence: "the process that worked on it ...".
    """

    reason: str
