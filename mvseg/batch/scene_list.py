"""The scenes of a batch: the rows of a table, or the sub-folders of a folder."""

from __future__ import annotations

import re
import sys
from dataclasses import dataclass
from pathlib import Path

from mvseg.batch.status import STATE, TABLES
from mvseg.errors import InputError
from mvseg.formats.scene_folder import is_scene_folder
from mvseg.formats.text_file import read_table
from mvseg.system.atomic import resolve_place

OWN_COLUMNS = ("scene", "name", "masks", "corrections")
KNOWN_COLUMNS = (*OWN_COLUMNS, "plant", "time")  # in any case
# of summary.csv, behind those of the scene
SUMMARY_COLUMNS = ("state", "instances", "masks", "views", "warnings", "seconds", "peak_mb", "warning_text", "sentence")
RESERVED = {STATE, TABLES}
FORBIDDEN = "/\\\0" + ('<>:"|?*' if sys.platform == "win32" else "")  # in the name of a folder


@dataclass(frozen=True)
class BatchScene:
    """One scene of a batch.

    Attributes:
        name: of its result folder; unique in the batch, case ignored.
        folder: the scene folder, absolute; it need not exist.
        masks: the path that the table gives, or that of `--masks`; None: a detector finds them.
        beside: where a relative path of masks or corrections may start, besides the scene folder; absolute.
        carried: {column: text} of the cells copied into all tables: `plant`, `time`, then other columns.
    """

    name: str
    folder: Path
    masks: Path | None
    beside: Path
    carried: dict[str, str]
    corrections: Path | None = None


def list_scenes(source: Path, out: Path, masks: Path | None) -> tuple[BatchScene, ...]:
    """The scenes of a batch, in the order of the table, or of the names of the folders; `masks` are of those for which
    the table names none.

    `source` is a CSV table with a column `scene`, the path of a scene folder that starts at the table's own folder, and
    perhaps `name`, `masks`, `corrections`, `plant`, `time` and others; or a folder with one scene in each sub-folder.
    Hidden sub-folders, and `out`, are none. Raises InputError: there is nothing of that name, the table is broken,
    there are no scenes, or two of one name.
    """
    if source.is_dir():
        scenes = _list_folders(source, out, masks)
    elif source.is_file():
        scenes = _read_table(source, masks)
    else:
        raise InputError(f"{source}: no such file or folder, expected a CSV table of scenes or a folder of scenes")
    first_of: dict[str, BatchScene] = {}
    for scene in scenes:
        if scene.name.casefold() in RESERVED:
            raise InputError(f"{source}: a scene is called '{scene.name}', the name of a folder of the batch's own")
        other = first_of.setdefault(scene.name.casefold(), scene)
        if other is not scene:
            message = f"{other.folder} and {scene.folder} are both called '{scene.name}'"
            raise InputError(f"{source}: {message}, expected different names (column name): each names a folder")
    return scenes


def _list_folders(source: Path, out: Path, masks: Path | None) -> tuple[BatchScene, ...]:
    if is_scene_folder(source):
        raise InputError(f"{source}: is itself a scene, expected a folder of scenes; use mvseg infer for one scene")
    folders = [path for path in sorted(source.iterdir()) if path.is_dir() and not path.name.startswith(".")]
    folders = [path for path in folders if path.resolve() != resolve_place(out)]
    if not folders:
        raise InputError(f"{source}: has no sub-folders, expected a scene in each, or a CSV table of scenes")
    return tuple(
        BatchScene(name=path.name, folder=path.absolute(), masks=masks, beside=Path.cwd(),
                   carried={"plant": path.name, "time": ""})
        for path in folders
    )  # fmt: skip


def _read_table(source: Path, masks: Path | None) -> tuple[BatchScene, ...]:
    from mvseg.traits.table import COLUMNS, wide_columns

    columns, rows = _read_rows(source)
    extra = [column for column in columns if column not in KNOWN_COLUMNS]
    if taken := sorted({*extra} & {*COLUMNS, *wide_columns(), *SUMMARY_COLUMNS} - {"plant"}):
        raise InputError(f"{source}: the column '{taken[0]}' is one of the results' own, expected another name")
    scenes = []
    for line, cells in rows:
        row = dict(zip(columns, cells, strict=True))
        if not row["scene"]:
            raise InputError(f"{source}: line {line} names no scene, expected the path of its folder")
        name = row.get("name") or _name_of(row["scene"])
        if name in ("", ".", "..") or name.startswith(".") or any(character in name for character in FORBIDDEN):
            raise InputError(f"{source}: line {line}: '{name}' cannot name a folder of results")
        carried = {"plant": row.get("plant") or name, "time": row.get("time", "")}
        scenes.append(
            BatchScene(
                name=name,
                folder=source.parent.absolute() / row["scene"],
                masks=Path(row["masks"]) if row.get("masks") else masks,
                beside=source.parent.absolute() if row.get("masks") else Path.cwd(),
                carried=carried | {column: row[column] for column in extra},
                corrections=_beside_table(source, row.get("corrections")),
            )
        )
    return tuple(scenes)


def _beside_table(source: Path, path: str | None) -> Path | None:
    if not path:
        return None
    return (source.parent / path).absolute() if (source.parent / path).is_file() else Path(path)


def _read_rows(source: Path) -> tuple[list[str], list[tuple[int, list[str]]]]:
    (_, columns), *rows = read_table(source, "a CSV table") or [(0, [])]
    if not columns:
        raise InputError(f"{source}: is empty, expected a table with a column 'scene'")
    columns = [column.lower() if column.lower() in KNOWN_COLUMNS else column for column in columns]
    if "scene" not in columns:
        shown = ", ".join(columns)[:200]
        raise InputError(f"{source}: has no column 'scene', found {shown}; expected the paths of scene folders there")
    if "" in columns:
        raise InputError(f"{source}: a column has no name")
    if twice := [column for column in columns if columns.count(column) > 1]:
        raise InputError(f"{source}: two columns are called '{twice[0]}', expected different names")
    if not rows:
        raise InputError(f"{source}: names no scenes, expected one row per scene")
    for line, cells in rows:
        if len(cells) != len(columns):
            raise InputError(f"{source}: line {line} has {len(cells)} cells, expected {len(columns)}")
    return columns, rows


def _name_of(path: str) -> str:
    parts = re.sub(r"^[A-Za-z]:[\\/]", "", path).replace("\\", "/").split("/")
    return "_".join(part for part in parts if part not in ("", ".", ".."))
