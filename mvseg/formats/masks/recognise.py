"""What kind of masks a path holds, and which files belong to which photo."""

from __future__ import annotations

import re
import warnings
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path

from mvseg.errors import InputError, InputWarning
from mvseg.formats.find_views import find_views, list_some, warn_of_base_names
from mvseg.scene import Scene

# Endings of files that are called as their photo; longer ones first, since `_seg.npy` ends on `.npy`.
ENDINGS = {
    "_cp_masks.png": "label images",
    "_cp_masks.tif": "label images",
    "_seg.npy": "cellpose",
    ".png": "label images",
    ".tif": "label images",
    ".tiff": "label images",
    ".npy": "NumPy arrays",
    ".json": "JSON",
    ".txt": "YOLO",
}
ONE_PER_MASK = "one image per mask"
# The first of several that fit as many photos is taken.
KINDS = ("label images", "NumPy arrays", "cellpose", "JSON", "YOLO", ONE_PER_MASK)
COMPLETE = ("label images", "NumPy arrays", "cellpose")  # a photo without leaves has a file there, too
NUMBERED = re.compile(r"(?P<photo>.+?)[_-](?:mask[_-]?)?\d+$", re.IGNORECASE)
EXPECTED = "expected a folder of label PNGs or a COCO .json file, or another kind of docs/formats.md"


@dataclass(frozen=True)
class MaskFiles:
    """The files of the masks of a scene.

    Attributes:
        source: the path that was given; messages name it.
        kind: "COCO", "label images", "NumPy arrays", "cellpose", "labelme", "SAM", "YOLO" or "one image per mask".
        files: V tuples of paths, one per photo but for "one image per mask"; empty for a photo without masks. For COCO
            the same file V times.
    """

    source: Path
    kind: str
    files: tuple[tuple[Path, ...], ...]


def recognise_masks(scene: Scene, masks: Path) -> MaskFiles:
    """The kind of masks that fits most photos of a scene, and its files.

    Warns (InputWarning) where there is more than one kind, of photos without a file, and of files that fit a photo by
    their base name only. The photos themselves are no masks, wherever they lie.

    Raises:
        InputError: there is nothing at the path, or nothing there fits a photo; the message says what is there.
    """
    if masks.is_file() and masks.suffix.lower() == ".json":
        return MaskFiles(masks, "COCO", ((masks,),) * len(scene.views))
    if not masks.is_dir():
        what = "not a kind of masks that is known" if masks.is_file() else "no such masks"
        raise InputError(f"{masks}: {what}, {EXPECTED}")
    folder = masks / "SegmentationObject" if (masks / "SegmentationObject").is_dir() else masks  # VOC
    photos = {view.path.resolve() for view in scene.views}
    paths = [path for path in sorted(folder.rglob("*")) if path.is_file() and path.resolve() not in photos]
    by_kind = {kind: files for kind, names in _group(folder, paths).items() if any(files := _fit(names, scene, folder))}
    if not by_kind:
        return _lone_coco(scene, masks, paths)
    counts = {kind: sum(map(bool, by_kind[kind])) for kind in KINDS if kind in by_kind}
    kind = max(counts, key=lambda each: counts[each])
    others = [f"{each} for {count}" for each, count in counts.items() if each != kind]
    if others:
        message = f"{kind} for {counts[kind]} photos are taken, and not {', '.join(others)}"
        warnings.warn(f"{masks}: {message}", InputWarning, stacklevel=3)
    _warn_of_loose_names(_group(folder, paths)[kind], scene, folder)
    files = _complete(scene, folder, kind=kind, files=by_kind[kind])
    return MaskFiles(masks, _name_json(kind, by_kind[kind]), files)


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
        if ENDINGS[ending] == "label images":
            numbered = NUMBERED.match(stem.rpartition("/")[2])
            if "/" in stem:
                groups[ONE_PER_MASK][stem.rpartition("/")[0]].append(path)
            elif numbered:
                groups[ONE_PER_MASK][numbered["photo"]].append(path)
    return groups


def _fit(names: dict[str, list[Path]], scene: Scene, folder: Path) -> tuple[tuple[Path, ...], ...]:
    """The files of each view; none at all where names cannot be told apart."""
    files: list[list[Path]] = [[] for _ in scene.views]
    try:
        views = find_views([f"{name}.png" for name in names], scene, source=folder)
    except InputError:
        return ((),) * len(files)
    for view, paths in zip(views, names.values(), strict=True):
        if view is not None:
            files[view] += paths
    return tuple(map(tuple, files))


def _warn_of_loose_names(names: dict[str, list[Path]], scene: Scene, folder: Path) -> None:
    stems = [f"{name}.png" for name in names]
    warn_of_base_names(stems, find_views(stems, scene, source=folder), scene, source=folder)


def _complete(
    scene: Scene, folder: Path, *, kind: str, files: tuple[tuple[Path, ...], ...]
) -> tuple[tuple[Path, ...], ...]:
    """Photos without a file: the reader will miss it where each photo must have one; elsewhere they show nothing."""
    missing = [view for view, paths in enumerate(files) if not paths]
    if missing and kind in COMPLETE:
        ending = next(ending for ending, each in ENDINGS.items() if each == kind and "_cp" not in ending)
        return tuple(paths[:1] or (folder / f"{scene.views[view].name}{ending}",) for view, paths in enumerate(files))
    if missing:
        first = f"view {missing[0]} ({scene.views[missing[0]].name})"
        message = f"{len(missing)} photos have no file and no masks, the first is {first}"
        warnings.warn(f"{folder}: {message}", InputWarning, stacklevel=4)
    return files if kind == ONE_PER_MASK else tuple(paths[:1] for paths in files)


def _name_json(kind: str, files: tuple[tuple[Path, ...], ...]) -> str:
    """labelme's files have shapes, those of Segment Anything have not."""
    if kind != "JSON":
        return kind
    first = next(paths[0] for paths in files if paths)
    try:
        return "labelme" if b'"shapes"' in first.read_bytes() else "SAM"
    except OSError as error:
        raise InputError(f"{first}: cannot be read ({error.strerror})") from None


def _lone_coco(scene: Scene, masks: Path, paths: list[Path]) -> MaskFiles:
    """A folder that fits no photo may hold one COCO file, as exports of CVAT and Roboflow do."""
    jsons = [path for path in paths if path.suffix.lower() == ".json"]
    if len(jsons) == 1:
        return MaskFiles(masks, "COCO", ((jsons[0],),) * len(scene.views))
    jpegs = [path for path in paths if path.suffix.lower() in (".jpg", ".jpeg")]
    if jpegs:
        raise InputError(f"{jpegs[0]}: is a JPEG, which blurs the numbers of masks: export PNG instead")
    found = list_some([path.relative_to(masks).as_posix() for path in paths])
    expected = f"masks called as {scene.views[0].name}.png or {scene.views[0].name}.json"
    raise InputError(f"{masks}: fits no photo of the scene, expected {expected}, found {found}")
