"""Kinds of masks at a path, and their files for each photo."""

from __future__ import annotations

import filecmp
import re
from collections import defaultdict
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from mvseg.errors import InputError, warn
from mvseg.findings.finding import Finding, list_some
from mvseg.formats.find_views import PhotoSet, base_name, find_views
from mvseg.formats.masks.yolo import YOLO_TRACKS, has_tracks

# Endings of files that are named after their photo; longer ones first, since `_seg.npy` ends on `.npy`.
CELLPOSE = "cellpose's label images"
ENDINGS = {
    "_cp_masks.png": CELLPOSE,
    "_cp_masks.tif": CELLPOSE,
    "_seg.npy": "cellpose",
    ".png": "label images",
    ".tif": "label images",
    ".tiff": "label images",
    ".npy": "NumPy arrays",
    ".json": "JSON",
    ".txt": "YOLO",
}
ONE_PER_MASK = "one image per mask"
# The first of several that fit as many photos is taken: plain images come late, since they may be photos.
KINDS = ("NumPy arrays", CELLPOSE, "cellpose", "JSON", "YOLO", "label images", ONE_PER_MASK)
# In these kinds, a photo without leaves has a file, too.
COMPLETE = ("NumPy arrays", "cellpose", CELLPOSE, "label images")
NUMBERED = re.compile(r"(?P<photo>.+?)[_-](?:mask[_-]?)?\d+$", re.IGNORECASE)
Files = tuple[tuple[Path, ...], ...]  # of each view
EXPECTED = "expected a folder of label PNGs or a COCO .json file, or another kind of docs/formats.md"
JPEG = "is a JPEG, which blurs the numbers of masks: export PNG instead"
# Files that hold masks in a form that is not read, and what to do.
REFUSED = {
    ".xml": "is XML, expected CVAT's export 'COCO 1.0' or 'Segmentation mask 1.1'",
    ".npz": "is an archive of arrays, expected one array: np.save writes it as .npy",
    ".jpg": JPEG,
    ".jpeg": JPEG,
}


@dataclass(frozen=True)
class MaskFiles:
    """The files of the masks of a scene.

    Attributes:
        source: the path that was given; messages name it.
        kind: "COCO", "label images", "NumPy arrays", "cellpose", "labelme", "SAM", "YOLO", "YOLO tracks" or "one image
            per mask".
        files: V tuples of paths, one per photo but for "one image per mask"; empty for a photo without masks. For COCO
            the same V times: its file, or the parts of one that was split.
    """

    source: Path
    kind: str
    files: Files


def recognise_masks(scene: PhotoSet, masks: Path) -> MaskFiles:
    """Find the kind of masks that fits most photos of a scene, and its files.

    Warns (InputWarning) where there is more than one kind, of photos without a file, and of files that fit a photo by
    their base name only. The photos themselves and their copies are no masks, wherever they lie. Raises InputError,
    which says what is there, if there is nothing at the path, nothing fits a photo, or several files of each kind fit
    the same one.
    """
    if masks.is_file() and masks.suffix.lower() == ".json":
        return MaskFiles(masks, "COCO", ((masks,),) * len(scene.views))
    if masks.is_file():
        raise InputError(f"{masks}: {REFUSED.get(masks.suffix.lower(), f'not a known kind of masks, {EXPECTED}')}")
    if not masks.is_dir():
        raise InputError(f"{masks}: no such masks, {EXPECTED}")
    folder = masks / "SegmentationObject" if (masks / "SegmentationObject").is_dir() else masks  # VOC
    paths = _list_files(folder, scene)
    groups = _group(folder, paths)
    by_kind, unclear = {}, {}
    for kind in (each for each in KINDS if each in groups):
        try:
            by_kind[kind] = _fit(groups[kind], scene, folder, kind=kind)
        except InputError as error:
            unclear[kind] = str(error)
    counts = {kind: count for kind, files in by_kind.items() if (count := sum(map(bool, files)))}
    if not counts:
        return _lone_coco(scene, masks, paths, unclear=tuple(unclear.values()))
    kind = max(counts, key=lambda each: counts[each])
    if kind == CELLPOSE and counts.get("cellpose", 0) <= counts[kind]:
        counts.pop("cellpose", None)  # its own files of the same masks
    others = [f"{each} for {count}" for each, count in counts.items() if each != kind]
    others += [f"{each} ({reason})" for each, reason in unclear.items()]
    if others:
        warn(Finding("other_kinds", str(masks), {"kind": kind, "count": counts[kind], "others": tuple(others)}))
    find_views([f"{name}.png" for name in groups[kind]], scene, source=folder, warn_of_loose=True)
    files = _complete(scene, folder, kind=kind, files=by_kind[kind])
    return MaskFiles(masks, _name_kind(kind, by_kind[kind]), files)


def _list_files(folder: Path, scene: PhotoSet) -> list[Path]:
    photos = [view.path for view in scene.views if view.path.is_file()]
    other_files = {path.resolve() for path in (*photos, scene.source) if path is not None}
    of_size: dict[int, list[Path]] = defaultdict(list)
    for photo in photos:
        of_size[photo.stat().st_size].append(photo)
    paths = [path for path in sorted(folder.rglob("*")) if path.is_file() and path.resolve() not in other_files]
    return [path for path in paths if not any(_is_copy(path, photo) for photo in of_size[path.stat().st_size])]


def _is_copy(path: Path, photo: Path) -> bool:
    with suppress(OSError):  # not readable: the reader will say so
        return filecmp.cmp(path, photo, shallow=False)
    return False


def _group(folder: Path, paths: list[Path]) -> dict[str, dict[str, list[Path]]]:
    """{kind: {name of the photo, as the files say: paths}}."""
    groups: dict[str, dict[str, list[Path]]] = defaultdict(lambda: defaultdict(list))
    for path in paths:
        name = path.relative_to(folder).as_posix()
        ending = next((ending for ending in ENDINGS if name.lower().endswith(ending)), None)
        if ending is None:
            continue
        stem = name[: -len(ending)]
        groups[ENDINGS[ending]][stem].append(path)
        if "label images" in ENDINGS[ending]:
            numbered = NUMBERED.match(stem)
            if photo := stem.rpartition("/")[0] or (numbered and numbered["photo"]):
                groups[ONE_PER_MASK][photo].append(path)
    return groups


def _fit(names: dict[str, list[Path]], scene: PhotoSet, folder: Path, *, kind: str) -> Files:
    """The files of each view; InputError, with a reason, if several fit one view and none has exactly its name."""
    files: list[list[Path]] = [[] for _ in scene.views]
    stems, problem = [f"{name}.png" for name in names], None
    views: list[int | None] = [None] * len(stems)
    try:
        views = find_views(stems, scene, source=None)
    except InputError as error:
        problem = str(error)
    bases = [base_name(view.name) for view in scene.views]
    by_base = {base: view for view, base in enumerate(bases) if kind != ONE_PER_MASK and bases.count(base) == 1}
    for (name, paths), stem, view in zip(names.items(), stems, views, strict=True):
        claimed = by_base.get(base_name(stem)) if view is None else view
        if claimed is not None and (name == scene.views[claimed].name or scene.views[claimed].name not in names):
            files[claimed] += paths
    if several := next((paths for paths in files if len(paths) > 1 and kind != ONE_PER_MASK), None):
        first, second = (path.relative_to(folder).as_posix() for path in several[:2])
        problem = f"both {first} and {second} fit one photo, expected the folder of one of them"
    if problem:
        raise InputError(problem)
    return tuple(map(tuple, files))


def _complete(scene: PhotoSet, folder: Path, *, kind: str, files: Files) -> Files:
    """Add a name for each missing file of a kind that every photo must have, for the reader to report; else warn."""
    if kind in COMPLETE:
        ending = next(ending for ending, each in ENDINGS.items() if each == kind)
        return tuple(paths or (folder / f"{scene.views[view].name}{ending}",) for view, paths in enumerate(files))
    if missing := [f"view {view} ({scene.views[view].name})" for view, paths in enumerate(files) if not paths]:
        warn(Finding("files_missing", str(folder), {"count": len(missing), "first": missing[0]}))
    return files


def _name_kind(kind: str, files: Files) -> str:
    if kind == "YOLO" and has_tracks(path for paths in files for path in paths):
        return YOLO_TRACKS
    if kind != "JSON":
        return "label images" if kind == CELLPOSE else kind
    first = next(paths[0] for paths in files if paths)
    return "labelme" if b'"shapes"' in first.read_bytes() else "SAM"


def _lone_coco(scene: PhotoSet, masks: Path, paths: list[Path], *, unclear: tuple[str, ...]) -> MaskFiles:
    """A folder that fits no photo may hold one COCO file (CVAT), or one in each of its folders (Roboflow)."""
    jsons = [path for path in paths if path.suffix.lower() == ".json"]
    if len({path.name for path in jsons}) == 1:
        return MaskFiles(masks, "COCO", (tuple(jsons),) * len(scene.views))
    if unclear:
        raise InputError(f"{masks}: {unclear[0]}")
    listed = list_some([path.relative_to(masks).as_posix() for path in jsons or paths])
    if jsons:
        message = f"holds {len(jsons)} JSON files ({listed}), none of them named after a photo"
        raise InputError(f"{masks}: {message}; expected the path of the COCO file")
    for path in paths:
        if reason := REFUSED.get(path.suffix.lower()):
            raise InputError(f"{path}: {reason}")
    expected = f"masks named {scene.views[0].name}.png or {scene.views[0].name}.json"
    raise InputError(f"{masks}: fits no photo of the scene, expected {expected}, found {listed}")
