"""What a check found: one sentence with the next step."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Literal

Level = Literal["note", "warning", "error"]
# Views (None: the whole scene), and a sentence in which "{}" stands for them.
Rule = tuple[Level, Sequence[int] | None, str]
SHOWN = 3  # names in a sentence


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


def name_views(views: tuple[int, ...], names: tuple[str, ...], *, shown: int = SHOWN) -> str:
    """The views in a sentence: "view 3 (003)", or "5 views (000, 001, 002 and 2 more)"."""
    if len(views) == 1:
        return f"view {views[0]} ({names[views[0]]})"
    more = f" and {len(views) - shown} more" if len(views) > shown else ""
    return f"{len(views)} views ({', '.join(names[view] for view in views[:shown])}{more})"


def list_findings(where: str, rules: Iterable[Rule], names: tuple[str, ...]) -> list[Finding]:
    """A finding for each rule that has views, or is about the whole scene."""
    findings = []
    for level, indices, what in rules:
        views = tuple(indices or ())
        if views or indices is None:
            said = what.replace("{}", name_views(views, names)) if views else what
            findings.append(Finding(where=where, what=said, level=level, views=views))
    return findings
