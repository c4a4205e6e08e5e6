"""The folder of a batch, and the status of its scenes: a small JSON file each, written whole whenever it changes.

OUT/NAME holds the result of a scene; two folders beside them belong to the batch.
"""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from pydantic import BaseModel

from mvseg.errors import InputError
from mvseg.formats.json_file import read_json
from mvseg.system.atomic import write_text_whole

STATE, TABLES = "_batch", "tables"
STATUS_FILE = "status.json"


class Status(BaseModel, frozen=True):
    """The state of one scene.

    Attributes:
        state: "running" from the moment a process takes the scene until its result is there.
        key: hash of the inputs and the options, see `scene_key`; "" where the inputs could not be read.
        result: SHA-256 of the result's run.json, which lists the hashes of all its files.
        instances, masks, views: how many the result has.
        seconds: from the start of the scene to its result, or to its failure.
        peak_mb: the most memory that the process has used until then, in MB; None if the system does not report it.
        sentence: why it failed.
        trace: the traceback, for failures that are bugs of mvseg.
    """

    state: Literal["running", "done", "failed"]
    scene: str
    key: str = ""
    result: str = ""
    instances: int = 0
    masks: int = 0
    views: int = 0
    seconds: float = 0.0
    peak_mb: float | None = None
    warnings: list[str] = []
    sentence: str = ""
    trace: str = ""


def scene_state(out: Path, name: str) -> Path:
    """The folder of a scene's status and its cached detections; locked while a process works on the scene."""
    return out / STATE / name


def read_status(folder: Path) -> Status | None:
    """The status in the state folder of a scene; None where there is none, or a broken one."""
    try:
        return read_json(folder / STATUS_FILE, Status)
    except InputError:
        return None


def write_status(folder: Path, status: Status) -> None:
    """Raises OSError where the folder is missing or cannot be written; the earlier status stays."""
    write_text_whole(folder / STATUS_FILE, status.model_dump_json(indent=1) + "\n")
