"""Read the inputs and options of a run from its result, to repeat it."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter, ValidationError

from mvseg._version import __version__, code_hash
from mvseg.config import RunConfig
from mvseg.errors import InputError, collect_warnings
from mvseg.findings.finding import Finding
from mvseg.formats.find_views import find_file
from mvseg.formats.scene_folder import is_scene_folder, load_scene
from mvseg.results.earlier import RUN_FILE, path_from
from mvseg.results.run_record import RunRecord, find_place, load_run
from mvseg.scene import Scene
from mvseg.system.file_hash import hash_files

# Options of earlier versions: what they were by default, and the finding about a result of another value.
GONE: dict[str, tuple[Any, str]] = {
    "color_card": (None, "color_card_gone"),
    "detect.min_views": (2, "min_views_gone"),
    "refine_poses": (False, "refine_poses_gone"),
    "split_merged": (False, "split_merged_gone"),
}
PLACES = ("scene", "masks", "corrections", "out")  # of run.json's config: what the run read and wrote
MOST_BYTES = 1 << 34  # limit: of an input that is compared: run.json may name a file without an end


@dataclass(frozen=True)
class RecordedRun:
    """The run that made a result, with the options of its stages.

    Attributes:
        masks: that were given; None: a detector found them.
        changes: inputs that are other ones now, another version of mvseg, and options that this version no longer has.
    """

    folder: Path
    record: RunRecord
    config: RunConfig
    scene: Path
    masks: Path | None
    corrections: Path | None
    changes: tuple[Finding, ...]


def read_recorded(folder: Path) -> RecordedRun:
    """The run that made a result; its inputs are looked for where they were, and then at the same place as seen from
    the result: so they may have moved together.

    Raises InputError: this is no result, or one with options that this version lacks; its scene or masks are gone.
    """
    record = load_run(folder)
    scene, masks, corrections = (
        None if (stated := record.config.get(name)) is None else find_place(folder, record, Path(str(stated)))
        for name in ("scene", "masks", "corrections")
    )
    if scene is None:
        raise InputError(f"{folder / RUN_FILE}: does not say which scene this is, expected a result of one scene")
    if not scene.exists():
        raise InputError(f"{scene}: the scene of this result is gone, expected it there")
    if not is_scene_folder(scene):
        raise InputError(f"{scene}: is no scene any more, expected that of the result in {folder}")
    if masks is not None and not masks.exists():
        raise InputError(f"{masks}: the masks of this result are gone, expected them there")
    with collect_warnings():  # a run says them
        opened = load_scene(scene)
    return RecordedRun(
        folder=folder,
        record=record,
        config=_read_config(folder, record),
        scene=scene,
        masks=masks,
        corrections=corrections,
        changes=tuple(_list_changes(folder, record, opened, [each for each in (masks, corrections) if each])),
    )


def record_places(scene: Path, out: Path, masks: Path | None, corrections: Path | None) -> dict[str, Any]:
    """Entries of run.json about the places of a run: absolute paths, and under "from_here" those from the result."""
    places = {"scene": scene, "out": out, "masks": masks, "corrections": corrections}
    absolute = {name: None if path is None else str(path.resolve()) for name, path in places.items()}
    return absolute | {"from_here": {name: path_from(out, path) for name, path in absolute.items() if path is not None}}


def _list_changes(folder: Path, record: RunRecord, scene: Scene, given: Sequence[Path]) -> list[Finding]:
    changes = []
    if record.code != code_hash():
        changes.append(Finding("other_version", values={"before": record.mvseg[:60], "now": __version__}))
    named, weights = [path.resolve() for path in (*given, *([] if scene.source is None else [scene.source]))], ""
    if isinstance(detect := record.config.get("detect"), dict):
        from mvseg.detectors.zoo import weights_path  # loads torchvision

        with suppress(InputError, OSError):  # they are gone, which is said where they are wanted
            named.append(weights_path(str(detect.get("weights"))).resolve())
            weights = hash_files(named[-1], most_bytes=MOST_BYTES)
    for stated, sha256 in record.inputs.items():
        if sha256 == weights:  # wherever this version keeps them
            continue
        path = find_place(folder, record, Path(stated))
        if not (path.is_dir() or path.is_file()):
            changes.append(Finding("input_gone", str(path)))
        elif path.resolve() not in named:
            changes.append(Finding("input_not_read", str(path)))
        elif _hash(path) != sha256:
            changes.append(Finding("input_changed", str(path)))
    changes += _list_other_photos(folder, record, scene)
    before = _flatten(record.config)
    gone = [code for name, (usual, code) in GONE.items() if before.get(name) not in (None, usual)]
    return changes + [Finding(code, str(folder)) for code in gone]


def _hash(path: Path) -> str:
    try:
        return hash_files(path, most_bytes=MOST_BYTES)
    except OSError:
        return ""


def _list_other_photos(folder: Path, record: RunRecord, scene: Scene) -> list[Finding]:
    if record.photos is None:
        return []
    place, count = find_place(folder, record, record.photos), len(record.photo_sha256)
    photos = {os.path.abspath(view.path) for view in scene.views if view.path.is_file()}
    gone = [name for name in record.photo_sha256 if os.path.abspath(find_file(place / name)) not in photos]
    others = [name for name, own in record.photo_sha256.items() if name not in gone and _hash(place / name) != own]
    return [
        Finding(code, str(place), {"count": len(names), "total": count, "names": tuple(names)})
        for code, names in (("photos_changed", others), ("photos_gone", gone))
        if names
    ]


def _flatten(options: Mapping[str, Any]) -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for stage, value in options.items():
        flat |= {f"{stage}.{name}": each for name, each in value.items()} if isinstance(value, dict) else {stage: value}
    return flat


def _read_config(folder: Path, record: RunRecord) -> RunConfig:
    options = {stage: value for stage, value in record.config.items() if stage not in (*PLACES, "from_here")}
    defaults = asdict(RunConfig())
    unknown = [name for name in _flatten(options) if name not in {*defaults, *_flatten(defaults), *GONE}]
    try:
        if unknown:
            raise InputError(f"unknown option {unknown[0]}")
        return TypeAdapter(RunConfig).validate_python({"reconstruct": None, **options})
    except (ValidationError, InputError) as error:
        problem = error.errors()[0]["msg"] if isinstance(error, ValidationError) else str(error)
        message = f"mvseg {record.mvseg[:60]} made it with options that this version does not have ({problem})"
        raise InputError(f"{folder}: {message}; expected one made by this version") from None
