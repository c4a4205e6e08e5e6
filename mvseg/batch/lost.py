"""The answer that both engines of a batch give for a lost item."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Lost:
    """An item whose worker gave no answer: it died, or could not even report what went wrong.

    Attributes:
        reason: the end of a sentence: "the process that worked on it ...".
    """

    reason: str
