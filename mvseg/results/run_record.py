"""run.json of a result: the record of the run that made it."""

from __future__ import annotations

import re
from contextlib import suppress
from pathlib import Path
from typing import Any, ClassVar, Literal

from pydantic import BaseModel, ConfigDict, Field

from mvseg._version import __version__
from mvseg.corrections.corrected import Fate
from mvseg.errors import InputError
from mvseg.findings.finding import Finding
from mvseg.formats.json_file import Items, Vector3, check_content, load_json
from mvseg.results.earlier import RUN_FILE
from mvseg.system.atomic import wait_until_whole

FORMAT = 2  # definition: of the folder; 1, which says no "format", was of versions before 0.2.0


class _Part(BaseModel):
    model_config: ClassVar[ConfigDict] = ConfigDict(frozen=True, extra="allow")


class MatchingRecord(_Part):
    """Other fields of `MatchReport`."""

    has_probabilities: bool = False
    explained: float | None = None
    view_explained: tuple[float | None, ...] | None = None


class TraitsRecord(_Part):
    """The world that traits were measured in."""

    unit: str | None = None
    up: Vector3 | None = None
    up_from: Literal["scene", "stem", ""] | None = None
    rejected: dict[str, Any] = {}

    @property
    def kinds(self) -> dict[int, Any]:
        """{id of an instance that is no leaf to be measured: kind of the reason}; earlier versions counted kinds."""
        return {int(leaf): kind for leaf, kind in self.rejected.items() if re.fullmatch("[0-9]{1,9}", leaf)}


class LearnedRecord(_Part):
    rounds: int = 0
    agreed_area: tuple[float, ...] = ()


class RunRecord(_Part):
    """Record of the run that made a result. Fields of run.json, see docs/results.md; others are kept."""

    format: int = Field(1, ge=1)
    mvseg: str = ""
    code: str = ""
    torch: str = ""
    scene: str = ""
    inputs: dict[str, str] = {}
    config: dict[str, Any] = {}
    mask_kind: str | None = None
    findings: tuple[dict[str, Any], ...] = ()
    unit: str | None = None
    up: Vector3 | None = None
    photos: Path | None = None
    photo_sha256: dict[str, str] = {}
    views: dict[str, tuple[str, ...]] = {}
    matched_by: str = "none"
    residual_px: int | None = None
    matching: MatchingRecord = MatchingRecord()
    traits: TraitsRecord | None = None
    edits: Items[Any] = []
    corrections: tuple[Fate, ...] = ()
    learned: LearnedRecord = LearnedRecord()
    counts: dict[str, int] = {}
    seconds: dict[str, float] = {}
    files: dict[str, str] = {}

    def list_findings(self) -> tuple[Finding, ...]:
        """The findings of the run; none where another version wrote them in another way."""
        with suppress(KeyError, TypeError, AttributeError, ValueError):
            return tuple(Finding.from_json(each) for each in self.findings)
        return ()

    def as_json(self) -> dict[str, Any]:
        return self.model_dump(mode="json", exclude_unset=True)


def load_run(folder: Path) -> RunRecord:
    """The run that made a result. Raises InputError: no result, a newer format, or a broken run.json."""
    wait_until_whole(folder)
    path = folder / RUN_FILE
    if not path.is_file():
        raise InputError(f"{folder}: holds no {RUN_FILE}, expected a result folder of mvseg infer")
    content = load_json(path)
    stated = content.get("format") if isinstance(content, dict) else None
    if isinstance(stated, int) and stated > FORMAT:
        message = f"is a result of format {stated}, and mvseg {__version__} reads those up to {FORMAT}"
        raise InputError(f"{folder}: {message}; expected a newer mvseg")
    return check_content(path, content, RunRecord)


def find_place(folder: Path, run: RunRecord, stated: Path) -> Path:
    """Find a file or folder that the run of a result names: where it was, or at the same place as seen from the result,
    since they may have moved together; where it was, if it is nowhere."""
    from_here = run.config.get("from_here")
    if stated.exists() or not isinstance(from_here, dict):
        return stated
    for name, relative in from_here.items():
        before = Path(str(run.config.get(name)))
        if relative is not None and (before == stated or before in stated.parents):
            moved = (folder / str(relative)).resolve() / stated.relative_to(before)
            if moved.exists():
                return moved
    return stated
