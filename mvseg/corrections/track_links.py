"""What a person says of leaves on different dates, from a file of corrections."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from mvseg.corrections.file import TrackLink, load_corrections
from mvseg.formats.find_views import base_name
from mvseg.formats.label_png import read_labels


@dataclass(frozen=True)
class LeafLink:
    """What a person says of leaves: `leaves` are (scene, leaf) pairs, all of one leaf, or of different ones."""

    is_same: bool
    leaves: tuple[tuple[str, int], ...]


def read_track_links(path: Path) -> list[TrackLink]:
    """The edits of a file of corrections that link leaves of different dates; others are for single scenes.

    Raises:
        InputError: see `load_corrections`.
    """
    return [edit for edit in load_corrections(path).edits if isinstance(edit, TrackLink)]


def find_links(edits: Sequence[TrackLink], folders: Mapping[str, Path]) -> tuple[list[LeafLink], list[str]]:
    """The links between leaves of a plant, and a sentence for each edit that points at no leaf.

    `folders` are {scene: result folder} of its dates. Edits that name none of these scenes are another plant's: they
    are passed over. A scene may be named by the end of its path, if no other one ends so.
    """
    links, lost = [], []
    for original in edits:
        edit, unclear = _with_full_names(original, list(folders))
        lost += [f"{edit.op}: {name} fits {' and '.join(fitting)}, expected one of them" for name, fitting in unclear]
        if unclear or not any(scene in folders for scene, *_ in edit.at):
            continue
        leaves = []
        for scene, view, x, y in edit.at:
            leaf = leaf_at(folders[scene], view, x, y) if scene in folders else 0
            leaves.append((scene, leaf))
            if not leaf:
                lost.append(f"{edit.op}: there is no leaf at ({x:g}, {y:g}) in view {view} of {scene}")
        if all(leaf for _, leaf in leaves):
            links.append(LeafLink(edit.op == "same_track", tuple(leaves)))
    return links, lost


def leaf_at(folder: Path, view: str, x: float, y: float) -> int:
    """The id of the leaf at a point of a view of a result; 0 where there is none, or no such view.

    The view is named as in a single scene (`find_views`): with its folders, or without them if no other one is named
    so; with or without the suffix of its photo.
    """
    path = _find_labels(folder / "labels", view)
    if path is None:
        return 0
    labels, column, row = read_labels(path), int(x // 1), int(y // 1)
    is_inside = 0 <= row < labels.shape[0] and 0 <= column < labels.shape[1]
    return int(labels[row, column]) if is_inside else 0


def _find_labels(folder: Path, view: str) -> Path | None:
    """The label image of a view; None where none is named so, or several are."""
    labels_of = {path.relative_to(folder).as_posix().removesuffix(".png"): path for path in folder.rglob("*.png")}
    name = view.replace("\\", "/").removeprefix("./")
    if (exact := labels_of.get(name, labels_of.get(name.rsplit(".", 1)[0]))) is not None:
        return exact
    alike = [path for of, path in labels_of.items() if base_name(of) == base_name(name)]
    return alike[0] if len(alike) == 1 else None


def _with_full_names(edit: TrackLink, scenes: Sequence[str]) -> tuple[TrackLink, list[tuple[str, list[str]]]]:
    """The edit with the names that scenes have, and the names that fit several, with these."""
    fitting = {name: [each for each in scenes if each == name or each.endswith(f"/{name}")] for name, *_ in edit.at}
    full = {name: found[0] if len(found) == 1 or name in found else name for name, found in fitting.items() if found}
    unclear = [(name, found) for name, found in fitting.items() if len(found) > 1 and name not in found]
    return edit.model_copy(update={"at": tuple((full.get(name, name), *at) for name, *at in edit.at)}), unclear
