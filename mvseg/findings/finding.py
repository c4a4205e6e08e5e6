"""One finding: a code, a place and values. The program passes and compares codes; nothing looks into a sentence."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

from mvseg.findings.sentences import EXPLAINS, SENTENCES, TOPICS

Level = Literal["note", "warning", "error"]
Values = Mapping[str, str | float | tuple[str, ...]]  # by name; int, too
LEVELS: tuple[Level, ...] = ("error", "warning", "note")
NAMED = 3  # chosen: names in a sentence
# Code, level, views (None: the whole scene) and values of a finding that may have no views.
Rule = tuple[str, Level, Sequence[int] | None, Values]


@dataclass(frozen=True)
class Finding:
    """Something that the program noticed, and a user should know. `str` makes the sentence.

    Attributes:
        code: a key of `SENTENCES`.
        where: the place that the sentence names: a file, a folder, views; "" for the whole scene.
        values: what else the sentence holds, by name: numbers, words, and tuples of names.
        views: indices of the views that it is about; () for the whole scene.
        level: "note": nothing is wrong, but something will be missing from the result; "warning": the result may be
            worse; "error": a run would fail, or its ids would be wrong.
    """

    code: str
    where: str = ""
    values: Values = field(default_factory=dict, hash=False)
    views: tuple[int, ...] = ()
    level: Level = "warning"

    @staticmethod
    def from_json(content: Mapping[str, Any]) -> Finding:
        """The finding that `as_json` wrote; a KeyError or a TypeError for another version's."""
        values = {name: tuple(each) if isinstance(each, list) else each for name, each in content["values"].items()}
        finding = Finding(content["code"], content["where"], values, tuple(content["views"]), content["level"])
        _ = str(finding)  # a KeyError where there is no such sentence
        return finding

    @property
    def topic(self) -> str:
        """The subject: "cameras", "photos", "masks", "poses", "leaves", "edits", "run" or "dates"."""
        return TOPICS[self.code]

    def __str__(self) -> str:
        words = {name: list_some(each) if isinstance(each, tuple) else each for name, each in self.values.items()}
        return SENTENCES[self.code].format(where=self.where, **words)

    def as_json(self) -> dict[str, Any]:
        """The finding as run.json and check.json hold it, with its sentence."""
        return {
            "code": self.code,
            "level": self.level,
            "topic": self.topic,
            "where": self.where,
            "views": list(self.views),
            "values": {name: list(each) if isinstance(each, tuple) else each for name, each in self.values.items()},
            "sentence": str(self),
        }


def list_some(names: Sequence[str]) -> str:
    """The first names, for a message: "a, b, c and 12 more", or "nothing"."""
    distinct = list(dict.fromkeys(names))
    more = f" and {len(distinct) - NAMED} more" if len(distinct) > NAMED else ""
    return ", ".join(distinct[:NAMED]) + more if distinct else "nothing"


def name_views(views: Sequence[int], names: Sequence[str]) -> str:
    """The views in a sentence: "view 3 (003)", or "5 views (000, 001, 002 and 2 more)"."""
    named = [names[view] for view in views]
    return f"view {views[0]} ({named[0]})" if len(views) == 1 else f"{len(views)} views ({list_some(named)})"


def list_findings(rules: Iterable[Rule], names: Sequence[str]) -> list[Finding]:
    """The finding of each rule that has views, or is about the whole scene; `names` of all views."""
    return [
        Finding(code, name_views(views, names) if views else "", values, tuple(views or ()), level)
        for code, level, views, values in rules
        if views or views is None
    ]


def keep_causes(findings: Iterable[Finding]) -> tuple[Finding, ...]:
    """The findings without those that another one explains (`EXPLAINS`), each once, the gravest first.

    A code that comes with views, or as an error, is not told of the whole scene beside it: a reader and a check may
    notice the same.
    """
    distinct = list(dict.fromkeys(findings))
    explained = {effect for each in distinct for effect in EXPLAINS.get((each.code, each.level), ())}
    definite = {each.code for each in distinct if each.views or each.level == "error"}
    repeated = [each for each in distinct if not each.views and each.level != "error" and each.code in definite]
    causes = [each for each in distinct if each.code not in explained and each not in repeated]
    return tuple(sorted(causes, key=lambda each: LEVELS.index(each.level)))
