"""Were corrections made for this scene? Views of two plants often have the same names, and points fit anywhere."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

from mvseg.corrections.file import Corrections, Edit, Link, PhotoMark, TrackLink
from mvseg.errors import InputError, warn
from mvseg.findings.finding import Finding
from mvseg.formats.find_views import find_view, find_views
from mvseg.formats.photos import Photos
from mvseg.scene import Scene


def mark_photos(photos: Photos) -> dict[str, PhotoMark]:
    """{name of a view: what tells its photo from others}, of all views."""
    return {view.name: _mark_photo(photos, index) for index, view in enumerate(photos.scene.views)}


def _mark_photo(photos: Photos, view: int) -> PhotoMark:
    width, height = photos.scene.cameras.sizes[view].tolist()
    is_there = photos.scene.views[view].path.is_file()
    return PhotoMark(width=width, height=height, sha256=photos.sha256(view) if is_there else None)


def with_marks(corrections: Corrections, scene: Scene, marks: Mapping[str, PhotoMark]) -> Corrections:
    """The corrections with the marks of the photos that they name, of those of the scene (`mark_photos`)."""
    names = [scene.views[view].name for view in named_views(corrections, scene)]
    return replace(corrections, photos={name: marks[name] for name in names})


def named_views(corrections: Corrections, scene: Scene) -> list[int]:
    """The indices of the views that edits of single scenes name, each once; names that fit no view, or several, are
    left to `apply`."""
    views = (find_view(name, scene) for name in views_of(corrections))
    return list(dict.fromkeys(view for view in views if view is not None))


def views_of(corrections: Corrections) -> list[str]:
    """The views that edits of single scenes name, each once."""
    return list(dict.fromkeys(name for edit in corrections.edits for name in _names(edit)))


def _names(edit: Edit) -> list[str]:
    if isinstance(edit, TrackLink):
        return []
    return [name for name, *_ in edit.at] if isinstance(edit, Link) else [edit.view]


def check_made_for(corrections: Corrections, photos: Photos) -> None:
    """Check that the photos are those that the corrections were made for; views that the scene does not have are left
    to `apply`. Warns (InputWarning) of a file that does not say which photos it was made for.

    Raises:
        InputError: a photo is another one, or of another size.
    """
    scene, source = photos.scene, corrections.source or "the corrections"
    if corrections.source is not None and views_of(corrections) and not corrections.photos:
        warn(Finding("edits_of_unknown_photos", str(source)))
    named = find_views(list(corrections.photos), scene, source=Path(str(source)))
    for (name, stated), view in zip(corrections.photos.items(), named, strict=True):
        if view is None:
            continue
        actual = _mark_photo(photos, view)
        is_other = None not in (stated.sha256, actual.sha256) and stated.sha256 != actual.sha256
        if is_other or (stated.width, stated.height) != (actual.width, actual.height):
            raise InputError(
                f"{source}: was made for another scene (photo {name} is another one here), expected corrections of "
                f"{scene.name}; --force_corrections true applies them all the same"
            )
