"""What a check found: one sentence with the next step."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Literal

from mvseg.formats.find_views import name_views

Level = Literal["note", "warning", "error"]
# Views (None: the whole scene), and a sentence in which "{}" stands for them.
Rule = tuple[Level, Sequence[int] | None, str]


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


def list_findings(where: str, rules: Iterable[Rule], names: tuple[str, ...]) -> list[Finding]:
    """A finding for each rule that has views, or is about the whole scene."""
    findings = []
    for level, indices, what in rules:
        views = tuple(indices or ())
        if views or indices is None:
            said = what.replace("{}", name_views(views, names)) if views else what
            findings.append(Finding(where=where, what=said, level=level, views=views))
    return findings
