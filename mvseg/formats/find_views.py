"""Views by the names of files: mask files come from other machines and tools, with their own naming."""

from __future__ import annotations

import re
import unicodedata
from collections import defaultdict
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from mvseg.errors import InputError, warn
from mvseg.findings.finding import Finding
from mvseg.formats.image_file import PHOTO_SUFFIXES
from mvseg.scene import Scene, View

# Roboflow calls the export of 000.jpg "000_jpg.rf.<hash>.jpg".
ROBOFLOW = re.compile(r"_(jpe?g|png|tiff?|bmp|webp|heic)\.rf\.\w+$", re.IGNORECASE)
LABEL_STUDIO = re.compile(r"^[0-9a-f]{8}-", re.IGNORECASE)  # its upload of 000.jpg is "5f1c0e7a-000.jpg"


@dataclass(frozen=True)
class LonePhotos:
    """Photos without cameras, named as the views of a scene are."""

    views: tuple[View, ...]
    source: Path | None = None


PhotoSet = Scene | LonePhotos


def find_views(
    names: Sequence[str], scene: PhotoSet, *, source: Path | None, warn_of_loose: bool = False
) -> list[int | None]:
    """The view that each file name refers to, None for a photo that is not in the scene.

    A name refers to a view if it is the path of the view's photo, the last part of that path, either of them with one
    more suffix (COLMAP's masks: 000.jpg.png), or the view's name with or without suffix. Views without such a name may
    be matched by the base name alone, see `base_name`, if only one view and one of the names have it.

    Args:
        names: paths with "/" or "\\" between folders, with or without suffix; of any machine.
        source: the file or folder that holds the names; messages name it. None: they do not.
        warn_of_loose: warn (InputWarning) of names that were matched by their base name alone.

    Raises:
        InputError: a name fits several views, or several names that fit nothing else have the base name of one view.
    """
    in_source = "" if source is None else f"{source}: "
    view_indices = _exact_views(names, scene, in_source)
    open_views = [view for view in range(len(scene.views)) if view not in set(view_indices)]
    bases = [base_name(scene.views[view].name) for view in open_views]
    view_of = {base: view for base, view in zip(bases, open_views, strict=True) if bases.count(base) == 1}
    first_of: dict[int, str] = {}
    for index, name in enumerate(names):
        view = view_of.get(base_name(name)) if view_indices[index] is None else None
        if view is None:
            continue
        if first_of.setdefault(view, name) != name:
            message = f"both {first_of[view]} and {name} could be view {view} ({scene.views[view].name})"
            raise InputError(f"{in_source}{message}, expected the path of its photo")
        view_indices[index] = view
    if first_of and warn_of_loose:
        view, name = next(iter(first_of.items()))
        first = f"{name} for {scene.views[view].name}"
        warn(Finding("base_names", str(source), {"count": len(first_of), "first": first}))
    return view_indices


def find_view(name: str, photos: PhotoSet) -> int | None:
    """The view that one file name refers to, see `find_views`; None where it refers to none, or fits several."""
    with suppress(InputError):
        return find_views([name], photos, source=None)[0]
    return None


def base_name(name: str) -> str:
    """A file name in small letters, without folders, image suffixes, Roboflow's ending and Label Studio's prefix."""
    last = composed(name).replace("\\", "/").rsplit("/", 1)[-1]
    while "." in last and f".{last.rsplit('.', 1)[1].lower()}" in PHOTO_SUFFIXES:
        last = last.rsplit(".", 1)[0]
    return LABEL_STUDIO.sub("", ROBOFLOW.sub("", last)).lower()


def composed(name: str) -> str:
    """A name in Unicode's composed form: macOS decomposes the umlauts of file names, other systems do not."""
    return unicodedata.normalize("NFC", name)


def find_file(path: Path) -> Path:
    """The file of a name, or one beside it whose name differs in Unicode's form only; else the path itself."""
    if str(path).isascii() or path.exists():
        return path
    place = Path(path.anchor)
    for part in path.parts[len(place.parts) :]:
        if not (place / part).exists() and place.is_dir():
            part = next((each.name for each in place.iterdir() if composed(each.name) == composed(part)), part)
        place /= part
    return place if place.exists() else path


def natural_order(name: str) -> list[tuple[int, int | str]]:
    """A key for natural sorting: 2.jpg before 10.jpg."""
    return [(0, int(part)) if part.isdecimal() else (1, part) for part in re.split(r"(\d+)", name.lower())]


def _exact_views(names: Sequence[str], scene: PhotoSet, in_source: str) -> list[int | None]:
    by_name = {composed(view.name): index for index, view in enumerate(scene.views)}
    by_path: dict[str, list[int]] = defaultdict(list)
    for index, view in enumerate(scene.views):
        parts = composed(view.path.as_posix()).split("/")
        for start in range(len(parts)):
            by_path["/".join(parts[start:])].append(index)
    exact: list[int | None] = []
    for file_name in names:
        name = composed(file_name).replace("\\", "/").removeprefix("./")
        stem = name.rsplit(".", 1)[0]
        same_name = by_name.get(name, by_name.get(stem))
        fitting = [] if same_name is not None else by_path.get(name) or by_path.get(stem, [])
        if len(fitting) > 1:
            views = " or ".join(f"{i} ({scene.views[i].name})" for i in fitting)
            raise InputError(f"{in_source}image {file_name} could be view {views}, expected its path")
        exact.append(fitting[0] if fitting else same_name)
    return exact
