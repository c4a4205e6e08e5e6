"""What a check found: one sentence with the next step."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Level = Literal["note", "warning", "error"]


@dataclass(frozen=True)
class Finding:
    """One thing that a user should know.

    Attributes:
        where: "cameras", "photos", "masks" or "poses".
        what: one sentence: what was found, in which views, and the next step.
        level: "note": nothing is wrong, but something will be missing from the result; "warning": the result may be
            worse; "error": a run would fail, or its ids would be wrong.
        views: indices of the views that it is about; empty for the whole scene.
    """

    where: str
    what: str
    level: Level
    views: tuple[int, ...] = ()


SHOWN = 3  # names in a sentence


def name_views(views: tuple[int, ...], names: tuple[str, ...], *, shown: int = SHOWN) -> str:
    """The views in a sentence: "view 3 (003)", or "5 views (000, 001, 002 and 2 more)"."""
    if len(views) == 1:
        return f"view {views[0]} ({names[views[0]]})"
    more = f" and {len(views) - shown} more" if len(views) > shown else ""
    return f"{len(views)} views ({', '.join(names[view] for view in views[:shown])}{more})"
