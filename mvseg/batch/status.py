"""The status of one scene of a batch: a small JSON file, written whole whenever it changes."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from pydantic import BaseModel

from mvseg.errors import InputError
from mvseg.formats.json_file import read_json
from mvseg.system.atomic import write_text_whole

STATUS_FILE = "status.json"


class Status(BaseModel, frozen=True):
    """The state of one scene.

    Attributes:
        state: "running" from the moment a process takes the scene until its result is there.
        scene: the scene folder.
        key: hash of the inputs and the options, see `scene_key`; "" where the inputs could not be read.
        result: SHA-256 of the result's run.json, which lists the hashes of all its files.
        instances, masks, views: how many the result has.
        seconds: from the start of the scene to its result, or to its failure.
        peak_mb: the most memory that the process has used until then, in MB; None if the system does not report it.
        warnings: the InputWarnings.
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


def read_status(folder: Path) -> Status | None:
    """The status in a scene's folder of the batch; None where there is none, or a broken one."""
    try:
        return read_json(folder / STATUS_FILE, Status)
    except InputError:
        return None


def write_status(folder: Path, status: Status) -> None:
    """Write the status; the folder must exist.

    Raises:
        OSError: it cannot be written; the earlier one stays.
    """
    write_text_whole(folder / STATUS_FILE, status.model_dump_json(indent=1) + "\n")
