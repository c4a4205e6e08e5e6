"""Replacing an earlier result: only files that mvseg wrote, and that are unchanged since, are replaced.

A result's run.json lists the files that were written with it and their SHA-256. Everything else in the folder belongs
to the user (notes, the metrics.json of `mvseg eval`), and is copied into the new result.
"""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from mvseg.errors import InputError
from mvseg.system.atomic import folder_whole, resolve_place
from mvseg.system.file_hash import hash_files

RUN_FILE = "run.json"


@contextmanager
def replace_result(out: Path, run: dict[str, Any], run_file: str = RUN_FILE) -> Iterator[Path]:
    """A new folder that becomes `out` when the block ends, see `folder_whole`; until then an earlier result stays.

    At the end, `run`, as the block left it, is written to `run_file` with a list of the files, and the user's files in
    the earlier result are copied.

    Raises:
        InputError: `out` cannot be written or holds something else, see `check_out`.
    """
    check_out(out, run_file)
    try:
        with folder_whole(out) as folder:
            yield folder
            text = json.dumps(run | {"files": _list_files(folder, run_file)}, indent=1, default=str)
            (folder / run_file).write_text(text + "\n", encoding="utf-8")
            _keep_user_files(out, folder, run_file)
    except OSError as error:
        raise InputError(f"{out}: the output folder is not writable ({error.strerror})") from None


def check_out(out: Path, run_file: str = RUN_FILE) -> None:
    """Check that a result can be written to `out`. `run_file` lists the files of an earlier one.

    Raises:
        InputError: `out` is a file, lies where nothing can be written, or is a folder that is neither empty nor an
            earlier result, or an earlier result in which a file was changed.
    """
    resolved = resolve_place(out)
    if out.is_dir():
        if not os.access(resolved, os.R_OK):
            raise InputError(f"{out}: cannot be read, expected a new or empty folder, or an earlier result")
        if any(resolved.iterdir()):
            for name, sha256 in _read_listed(out, run_file).items():
                if (out / name).is_file() and hash_files(out / name) != sha256:
                    message = "was changed after mvseg wrote it, move it away, or choose another --out"
                    raise InputError(f"{out / name}: {message}")
    elif out.exists() or any(parent.is_file() for parent in resolved.parents):
        raise InputError(f"{out}: the output folder is not writable (a file is in the way)")
    nearest = next((parent for parent in resolved.parents if parent.exists()), resolved)
    if not os.access(nearest, os.W_OK | os.X_OK):
        raise InputError(f"{out}: the output folder is not writable (no permission to write in {nearest})")


def check_same_scene(out: Path, scene: Path) -> None:
    """Check that `out` does not hold a result of another scene; one that does not name its scene folder passes.

    Raises:
        InputError: it was made from another scene folder.
    """
    try:
        earlier = os.path.realpath(json.loads((out / RUN_FILE).read_text(encoding="utf-8"))["config"]["scene"])
    except (OSError, ValueError, KeyError, TypeError):
        return
    if earlier != os.path.realpath(scene):
        message = f"holds the result of another scene, {earlier}, not of {scene}"
        raise InputError(f"{out}: {message}; expected another --out, or --overwrite true")


def _list_files(folder: Path, run_file: str) -> dict[str, str]:
    """{path in the folder: SHA-256} of all files but run.json itself; what run.json says of them."""
    return {name: hash_files(folder / name) for name in _names_below(folder) if name != run_file}


def _keep_user_files(out: Path, folder: Path, run_file: str) -> None:
    """Copy what the user put into the earlier result at `out` into the new one in `folder`.

    Raises:
        InputError: a file of the user has the name of one of the new result; nothing of `out` is changed.
    """
    if not out.is_dir() or not any(out.iterdir()):
        return
    for name in sorted(_names_below(out) - _read_listed(out, run_file).keys() - {run_file}):
        if os.path.lexists(folder / name):
            message = "was not written by mvseg, but the new result has a file of this name: move it away"
            raise InputError(f"{out / name}: {message}")
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(out / name, folder / name, follow_symlinks=False)


def _names_below(folder: Path) -> set[str]:
    paths = folder.rglob("*")
    return {path.relative_to(folder).as_posix() for path in paths if path.is_symlink() or not path.is_dir()}


def _read_listed(out: Path, run_file: str) -> dict[str, str]:
    """The files that the run.json of an earlier result lists, with their SHA-256."""
    try:
        files = json.loads((out / run_file).read_text(encoding="utf-8"))["files"]
        return {str(name): str(sha256) for name, sha256 in files.items()}
    except (OSError, ValueError, KeyError, TypeError, AttributeError):  # no run.json, or another program's
        message = "holds files that are not an earlier result, expected a new or empty folder"
        raise InputError(f"{out}: {message}") from None
