"""What a command may replace: only what mvseg wrote for the same purpose, and what is unchanged since.

The run.json of a folder says what kind of folder it is and what it was made of ("output"), and lists the files that
were written with it and their SHA-256 ("files"). Everything else in the folder belongs to the user (edits, notes, the
metrics.json of `mvseg eval`), and stays where it is. Nothing that a command reads is ever replaced.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal

from mvseg.errors import InputError
from mvseg.system.atomic import files_whole, is_partial, resolve_place, try_writing, write_text_whole
from mvseg.system.file_hash import hash_files

RUN_FILE, POSE_FILE = "run.json", "pose.json"
Kind = Literal["result", "tracks", "tables", "training", "scene"]
# Of each kind of folder: what it is called, and a file by which one of an earlier version is known.
KINDS: dict[str, tuple[str, str]] = {
    "result": ("a result of mvseg infer, match or batch", "instances.json"),
    "tracks": ("tracks of mvseg track", "tracks.csv"),
    "tables": ("tables of mvseg batch", "summary.csv"),
    "training": ("a run of mvseg train", "checkpoint.pt"),
    "scene": ("a scene of mvseg pose", "cameras.json"),
}


@dataclass(frozen=True)
class Output:
    """What a command is about to write into a folder.

    Attributes:
        kind: of the folder.
        of: what it is made of: a folder of the same kind that was made of none of these is another one's. None: the
            place alone says whose it is.
        reads: what else the command reads.
        overwrite: replace another one's folder, too, or one of another kind; None: the command has no such option.
    """

    kind: Kind
    of: tuple[Path, ...] = ()
    reads: tuple[Path, ...] = ()
    overwrite: bool | None = None

    @property
    def run_file(self) -> str:
        """The file that says what a folder is; that of a scene, which lies in the user's hands, is called apart."""
        return POSE_FILE if self.kind == "scene" else RUN_FILE

    def describe(self, out: Path) -> dict[str, Any]:
        """What run.json in `out` says of it: under "of" absolute paths, and the same as seen from there."""
        places = [os.path.realpath(path) for path in self.of]
        return {"kind": self.kind, "of": {path: path_from(out, path) for path in places}}


RESULT = Output("result")


@contextmanager
def replace_result(out: Path, run: dict[str, Any], output: Output) -> Iterator[Path]:
    """A new folder whose files replace those of an earlier one at `out` when the block ends, see `files_whole`.

    At the end, `run`, as the block left it, is written to the run file with what the folder is and a list of the files.
    The user's files in `out` are not touched.

    Raises:
        InputError: `out` cannot be written or holds something else, see `check_out`.
    """
    check_out(out, output)
    try:
        with files_whole(out, partial(_list_replaced, out, output)) as folder:
            yield folder
            said = run | {"output": output.describe(out), "files": _list_files(folder, output.run_file)}
            text = json.dumps(said, indent=1, default=str)
            (folder / output.run_file).write_text(text + "\n", encoding="utf-8")
    except OSError as error:
        raise InputError(f"{out}: the output folder is not writable ({error.strerror})") from None


def check_out(out: Path, output: Output = RESULT) -> None:
    """Check that a command may write its output to `out`: what is there is looked at, and writing is tried.

    Raises:
        InputError: `out` is a file, lies where nothing can be written, or is a folder that is neither empty nor an
            earlier output of this kind, made of the same; or one in which a file was changed, or that the command
            reads.
    """
    place = resolve_place(out)
    if place.is_dir():
        if not os.access(place, os.R_OK):
            raise InputError(f"{out}: cannot be read, expected a new or empty folder, or an earlier result")
        if _holds_some(place):
            _check_earlier(out, place, output)
    elif place.exists() or any(parent.is_file() for parent in place.parents):
        raise InputError(f"{out}: the output folder is not writable (a file is in the way)")
    _check_writable(out, place)


def _check_earlier(out: Path, place: Path, output: Output) -> None:
    """Raises InputError: what the folder holds may not be replaced."""
    said = _read_run(out, output)
    kind = _kind_of(said, output)
    if not output.overwrite:
        option = "--output" if output.kind == "training" else "--out"
        mend = f"expected another {option}" + ("" if output.overwrite is None else ", or --overwrite true")
        if kind != output.kind:
            raise InputError(f"{out}: holds {KINDS[kind][0]}, not {KINDS[output.kind][0]}; {mend}")
        if other := _made_of_others(said, place, output):
            what = "the result of another scene, " if kind == "result" else f"{KINDS[kind][0]} of "
            raise InputError(f"{out}: holds {what}{other}, not of {output.of[0]}; {mend}")
    if output.kind == "training":
        return
    listed = _read_listed(out, output)
    for path in map(resolve_place, (*output.of, *output.reads)):
        below = [place / name for name in listed] if place in path.parents else []
        if path == place or any(each == path or path in each.parents for each in below):
            raise InputError(f"{path}: is read by this run, which would replace it; expected another --out")
    for name, sha256 in listed.items():
        if (place / name).is_file() and hash_files(place / name) != sha256:
            message = "was changed after mvseg wrote it, move it away, or choose another --out"
            raise InputError(f"{out / name}: {message}")


def _check_writable(out: Path, place: Path) -> None:
    """Raises InputError: nothing can be written where a folder or file is to be; before the work, not after it."""
    nearest = next((parent for parent in place.parents if parent.exists()), place)
    if not os.access(nearest, os.W_OK | os.X_OK):
        raise InputError(f"{out}: the output folder is not writable (no permission to write in {nearest})")
    try:
        try_writing(nearest)
    except OSError as error:
        raise InputError(f"{out}: the output folder is not writable ({error.strerror})") from None


def claim_folder(out: Path, output: Output) -> None:
    """Make a folder for a command that adds files one by one, and say in it whose it is; see `check_out`."""
    out.mkdir(parents=True, exist_ok=True)
    if not (out / output.run_file).is_file():
        text = json.dumps({"output": output.describe(out)}, indent=1)
        write_text_whole(out / output.run_file, text + "\n")


def check_file(path: Path, sign: bytes | None) -> None:
    """Check that a command may write a file: there is none, or one that mvseg wrote, which holds `sign` (None: no such
    file is ours). A link is replaced, and never followed.

    Raises:
        InputError: there is another file, or a folder; or nothing can be written there.
    """
    _check_writable(path, resolve_place(path.parent) / path.name)
    if path.is_symlink() or not path.exists():
        return
    if sign is None or not path.is_file() or sign not in path.read_bytes():
        raise InputError(f"{path}: was not written by mvseg, expected another name, or to move it away")


def path_from(out: Path, path: str) -> str | None:
    """A path as seen from a folder; None on another drive of Windows."""
    try:
        return Path(os.path.relpath(path, resolve_place(out))).as_posix()
    except ValueError:
        return None


def _kind_of(said: Mapping[str, Any], output: Output) -> str:
    """The kind of a folder with this run file."""
    stated, files = said.get("output"), said.get("files")
    if isinstance(stated, dict) and stated.get("kind") in KINDS:
        return str(stated["kind"])
    signs = [kind for kind, (_, sign) in KINDS.items() if isinstance(files, dict) and sign in files]
    return output.kind if output.kind == "scene" or not signs else signs[0]


def _made_of_others(said: Mapping[str, Any], place: Path, output: Output) -> str | None:
    """What a folder was made of, where that is nothing of what the new one is made of; None if either is not known."""
    config, stated = said.get("config"), said.get("output")
    before: dict[Any, Any] = stated["of"] if isinstance(stated, dict) and isinstance(stated.get("of"), dict) else {}
    if not before and isinstance(config, dict) and config.get("scene"):
        from_here = config.get("from_here")
        before = {config["scene"]: from_here.get("scene") if isinstance(from_here, dict) else None}
    now = {os.path.realpath(path) for path in output.of}
    seen = {os.path.realpath(str(path)) for path in before}
    seen |= {os.path.realpath(place / str(path)) for path in before.values() if path is not None}
    return None if not now or not before or now & seen else os.path.realpath(str(next(iter(before))))


def _holds_some(folder: Path) -> bool:
    return any(not is_partial(path) for path in folder.iterdir())


def _list_files(folder: Path, run_file: str) -> dict[str, str]:
    """{path in the folder: SHA-256} of all files but run.json itself; what run.json says of them."""
    return {name: hash_files(folder / name) for name in _names_below(folder) if name != run_file}


def _list_replaced(out: Path, output: Output, folder: Path) -> set[str]:
    """The files of the earlier output at `out` that the new one, in `folder`, takes the places of.

    Raises:
        InputError: a file of the user has the name of a new one; nothing of `out` is changed.
    """
    place = resolve_place(out)
    if not place.is_dir() or not _holds_some(place):
        return set()
    new, earlier = _names_below(folder), {*_read_listed(out, output), output.run_file}
    for name in sorted(new):
        parents = [place / parent for parent in Path(name).parents[:-1]]
        blocked = [each for each in parents if each.is_symlink() or each.is_file()]
        if blocked or (name not in earlier and os.path.lexists(place / name)):
            message = "was not written by mvseg, but the new result has a file of this name: move it away"
            raise InputError(f"{(blocked or [out / name])[0]}: {message}")
    return earlier


def _names_below(folder: Path) -> set[str]:
    paths = folder.rglob("*")
    return {path.relative_to(folder).as_posix() for path in paths if path.is_symlink() or not path.is_dir()}


def _read_run(out: Path, output: Output) -> dict[str, Any]:
    """What the run file of an earlier output says."""
    with suppress(OSError, ValueError, RecursionError):  # there is none, or another program's
        said = json.loads((resolve_place(out) / output.run_file).read_text(encoding="utf-8"))
        if isinstance(said, dict):
            return said
    raise _not_ours(out, output)


def _read_listed(out: Path, output: Output) -> dict[str, str]:
    """The files that the run file of an earlier output lists, with their SHA-256.

    Raises:
        InputError: it lists none, or one outside of the folder: nothing there may be replaced.
    """
    files, place = _read_run(out, output).get("files"), resolve_place(out)
    if not isinstance(files, dict):
        raise _not_ours(out, output)
    for name in files:
        if not (place / name).parent.resolve().is_relative_to(place) or Path(name).name in ("", ".."):
            raise InputError(f"{out / output.run_file}: lists {name}, which is not in this folder")
    return {str(name): str(sha256) for name, sha256 in files.items()}


def _not_ours(out: Path, output: Output) -> InputError:
    what = KINDS["training"][0] if output.kind == "training" else "an earlier result"
    return InputError(f"{out}: holds files that are not {what}, expected a new or empty folder")
