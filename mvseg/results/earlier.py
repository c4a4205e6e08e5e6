"""Files that a command may replace: those that mvseg wrote for the same purpose, and nobody has changed since.

The run.json of a folder says what it is and what it was made of ("output"), and lists the files that were written with
it, with their SHA-256 ("files"). Everything else there belongs to the user (edits, notes, the metrics.json of `mvseg
eval`) and stays where it is. A folder of another command, or without run.json, is refused, and nothing that a command
reads is replaced.
"""

from __future__ import annotations

import errno
import json
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, Field

from mvseg.errors import InputError
from mvseg.system.atomic import (
    folder_whole,
    is_partial,
    list_files,
    resolve_place,
    try_moving,
    try_writing,
    write_text_whole,
)
from mvseg.system.file_hash import hash_files

RUN_FILE, POSE_FILE = "run.json", "pose.json"
_Name = Annotated[str, Field(pattern=r"^[^\x00]*$")]
Kind = Literal["result", "tracks", "tables", "training", "scene"]
KINDS: dict[str, str] = {
    "result": "a result of mvseg infer, match or batch",
    "tracks": "tracks of mvseg track",
    "tables": "tables of mvseg batch",
    "training": "a run of mvseg train",
    "scene": "a scene of mvseg pose",
}


@dataclass(frozen=True)
class Output:
    """Output of a command that is about to write into a folder.

    Attributes:
        of: inputs; a folder made from other inputs is refused. (): any folder of the kind is accepted.
        reads: other files and folders that the command reads.
        overwrite: replace another one's folder, too, or one of another kind; None: the command has no such option.
        names: files that the command surely writes: one of the user is refused before the work.
    """

    kind: Kind
    of: tuple[Path, ...] = ()
    reads: tuple[Path, ...] = ()
    overwrite: bool | None = None
    names: tuple[str, ...] = ()

    @property
    def run_file(self) -> str:
        """The file that says what a folder is; that of a scene, which lies in the user's hands, has another name."""
        return POSE_FILE if self.kind == "scene" else RUN_FILE

    def describe(self, out: Path) -> dict[str, Any]:
        """Entry of run.json in `out` about it: under "of" absolute paths, and the same as seen from there."""
        places = [os.path.realpath(path) for path in self.of]
        return {"kind": self.kind, "of": {path: path_from(out, path) for path in places}}


class _Made(BaseModel):
    kind: Kind
    of: dict[_Name, _Name | None] = {}


class _Run(BaseModel):
    output: _Made | None = None
    files: dict[_Name, str] | None = None


RESULT = Output("result")
NOT_OURS = "was not written by mvseg, but the new result has a file of this name: move it away"


@contextmanager
def replace_result(out: Path, run: dict[str, Any], output: Output) -> Iterator[Path]:
    """A new folder whose files replace those of an earlier one at `out` when the block ends, see `folder_whole`.

    At the end, `run`, as the block left it, is written to the run file with the folder's purpose and a list of the
    files. Raises InputError: see `check_out`; or a file of the user has the name of a new one: nothing of `out` is
    changed, and the new result stays beside it.
    """

    def list_replaced(folder: Path) -> set[str]:
        earlier, place = check_out(out, output), resolve_place(out)
        for name in map(Path, list_files(folder)):
            taken = [each for each in name.parents[:-1] if (place / each).is_symlink() or (place / each).is_file()]
            taken += [name] if name.as_posix() not in earlier and os.path.lexists(place / name) else []
            if taken:
                places = (place.with_name(f"{place.name}-{n}") for n in count(1))
                free = next(each for each in places if not os.path.lexists(each))
                os.replace(folder, free)
                raise InputError(f"{out / taken[0]}: {NOT_OURS}; the new result is in {free}")
        return earlier

    check_out(out, output)
    try:
        with folder_whole(out, list_replaced) as folder:
            yield folder
            files = {name: hash_files(folder / name) for name in list_files(folder)}
            text = json.dumps(run | {"output": output.describe(out), "files": files}, indent=1, default=str)
            (folder / output.run_file).write_text(text + "\n", encoding="utf-8")
    except OSError as error:
        raise InputError(f"{out}: the output folder is not writable ({error.strerror})") from None


def check_out(out: Path, output: Output = RESULT) -> set[str]:
    """The files in `out` that a command may replace with its output; none if it is new or empty.

    Raises InputError: nothing can be written there; it holds something else than an earlier output of this kind, made
    of the same, or a file that was changed since; or the command reads it.
    """
    place = resolve_place(out)
    _try_place(out, place)
    try:
        if not place.exists() or all(is_partial(path) for path in place.iterdir()):
            return set()
        run = _Run.model_validate_json((place / output.run_file).read_bytes())
    except (FileNotFoundError, ValueError):  # there is none, or another program's
        run = _Run()
    except OSError as error:
        raise InputError(f"{out}: the output folder is not writable ({error.strerror})") from None
    if run.output is None and run.files is None:
        raise InputError(f"{out}: holds files that are not {KINDS[output.kind]}, expected a new or empty folder")
    if run.output is not None and not output.overwrite:
        mend = "expected another folder" + ("" if output.overwrite is None else ", or --overwrite true")
        if run.output.kind != output.kind:
            raise InputError(f"{out}: holds {KINDS[run.output.kind]}, not {KINDS[output.kind]}; {mend}")
        before = [*run.output.of, *(str(place / path) for path in run.output.of.values() if path is not None)]
        now = {os.path.realpath(path) for path in output.of}
        if now and before and now.isdisjoint(map(os.path.realpath, before)):
            made = f"made of {next(iter(run.output.of))}, not of {output.of[0]}"
            raise InputError(f"{out}: holds {KINDS[output.kind]}, {made}; {mend}")
    replaced = {*(files := run.files or {}), output.run_file}
    for path in map(resolve_place, (*output.of, *output.reads)):
        if path.is_relative_to(place) and any((place / name).is_relative_to(path) for name in replaced):
            raise InputError(f"{path}: is read by this run, which would replace it; expected another folder")
    for name, sha256 in files.items():
        if not (place / name).parent.resolve().is_relative_to(place) or Path(name).name in ("", ".."):
            raise InputError(f"{out / output.run_file}: lists {name}, which is not in this folder")
        if (place / name).is_dir():
            raise InputError(f"{out / name}: is a folder now, with a name that mvseg gave a file: move it away")
        if (place / name).is_file() and hash_files(place / name) != sha256:
            raise InputError(f"{out / name}: was changed after mvseg wrote it, move it away, or choose another folder")
    for name in output.names:
        if name not in replaced and os.path.lexists(place / name):
            raise InputError(f"{out / name}: {NOT_OURS}")
    return replaced


def claim_folder(out: Path, output: Output) -> None:
    """Make a folder for a command that adds files one by one, and say in it whose it is; see `check_out`."""
    out.mkdir(parents=True, exist_ok=True)
    if not (out / output.run_file).is_file():
        write_text_whole(out / output.run_file, json.dumps({"output": output.describe(out)}, indent=1) + "\n")


def check_file(path: Path, sign: bytes | None) -> None:
    """Check that a command may write a file: there is none, or one that mvseg wrote, which holds `sign` (None: no such
    file is ours). A link is replaced, and never followed. Raises InputError: there is another file, or a folder; or
    nothing can be written there."""
    _try_place(path, resolve_place(path.parent) / path.name)
    if path.is_symlink() or not path.exists():
        return
    if sign is None or not path.is_file() or sign not in path.read_bytes():
        raise InputError(f"{path}: was not written by mvseg, expected another name, or to move it away")


def _try_place(out: Path, place: Path) -> None:
    """Raises InputError: nothing can be written where a folder or file is to be; before the work, not after it."""
    if not place.name:
        raise InputError(f"{out}: cannot be replaced, expected a folder in it")
    try:
        try_writing(next(parent for parent in place.parents if parent.exists()))
        if place.is_dir():
            try_moving(place)
    except OSError as error:
        if error.errno == errno.EXDEV:
            raise InputError(f"{out}: is a disk of its own (a mount point), expected a new folder in it") from None
        raise InputError(f"{out}: the output folder is not writable ({error.strerror}: {error.filename})") from None


def path_from(out: Path, path: str) -> str | None:
    """A path as seen from a folder; None on another drive of Windows."""
    with suppress(ValueError):
        return Path(os.path.relpath(path, resolve_place(out))).as_posix()
    return None
