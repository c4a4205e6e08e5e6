"""What the user says of leaves on different dates, from a file of corrections."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path

from mvseg.corrections.corrected import keep_latest
from mvseg.corrections.file import Edit, TrackLink
from mvseg.formats.find_views import LonePhotos, find_view
from mvseg.formats.label_png import read_labels
from mvseg.scene import View


@dataclass(frozen=True)
class LeafLink:
    """Link of the user between leaves: `leaves` are (scene, leaf) pairs, all of one leaf, or of different ones."""

    is_same: bool
    leaves: tuple[tuple[str, int], ...]


def find_links(
    edits: Sequence[Edit], folders: Mapping[str, Path], shaped: Collection[tuple[str, int]] | None = None
) -> tuple[list[LeafLink], dict[int, str]]:
    """The links between leaves of a plant, and {place of an edit: what hinders it}: it points at no leaf, or
    contradicts later ones, which win.

    `folders` are {scene: result folder} of its dates, `shaped` those of their leaves (scene, leaf) that can be linked;
    None: all. Edits of single scenes, and those that name none of these scenes, which are another plant's, are passed
    over. A scene may be named by the end of its path, if no other one ends so.
    """
    links: dict[int, LeafLink] = {}
    problems: dict[int, str] = {}
    for index, original in enumerate(edits):
        if not isinstance(original, TrackLink):
            continue
        edit, unclear = _with_full_names(original, list(folders))
        if unclear:
            said = "; ".join(f"{name} fits {' and '.join(fitting)}" for name, fitting in unclear)
            problems[index] = f"{edit.op}: {said}, expected one of them"
        elif any(scene in folders for scene, *_ in edit.at):
            leaves = [
                (scene, leaf_at(folders[scene], view, x, y) if scene in folders else 0) for scene, view, x, y in edit.at
            ]
            nowhere = [
                f"({x:g}, {y:g}) in view {view} of {scene}"
                for (scene, view, x, y), (_, leaf) in zip(edit.at, leaves, strict=True)
                if not leaf
            ]
            if nowhere:
                problems[index] = f"{edit.op}: there is no leaf at {', '.join(nowhere)}"
            elif shaped is not None and (flat := [each for each in leaves if each not in shaped]):
                problems[index] = f"{edit.op}: leaf {flat[0][1]} of {flat[0][0]} has no shape, so nothing can be linked"
            else:
                links[index] = LeafLink(edit.op == "same_track", tuple(leaves))
    latest = sorted(links, reverse=True)
    held, losers = keep_latest(latest, lambda chosen: not _is_contradiction([links[index] for index in chosen]))
    for index, winner in losers.items():
        op = "same_track" if links[index].is_same else "different_track"
        is_own = winner == index
        why = "two leaves of one date, which are never the same" if is_own else f"contradicted by edit {winner + 1}"
        problems[index] = f"{op}: {why}"
    return [links[index] for index in sorted(held)], problems


def _is_contradiction(links: Sequence[LeafLink]) -> bool:
    part_of: dict[tuple[str, int], set[tuple[str, int]]] = {}
    for link in links:
        if link.is_same:
            part = set(link.leaves).union(*(part_of.get(leaf, ()) for leaf in link.leaves))
            part_of |= dict.fromkeys(part, part)
            if len({scene for scene, _ in part}) < len(part):
                return True
    apart = (pair for link in links if not link.is_same for pair in combinations(link.leaves, 2))
    return any(other in part_of.get(one, {one}) for one, other in apart if one != other)


def leaf_at(folder: Path, view: str, x: float, y: float) -> int:
    """The id of the leaf at a point of a view of a result; 0 where there is none, or no such view.

    The view is named as in a single scene (`find_views`): with its folders, or without them if no other one is named
    so; with or without the suffix of its photo.
    """
    paths = [*(folder / "labels").rglob("*.png")]
    names = (path.relative_to(folder / "labels").as_posix().removesuffix(".png") for path in paths)
    if (place := find_view(view, LonePhotos(tuple(map(View, names, paths))))) is None:
        return 0
    labels, column, row = read_labels(paths[place]), int(x // 1), int(y // 1)
    is_inside = 0 <= row < labels.shape[0] and 0 <= column < labels.shape[1]
    return int(labels[row, column]) if is_inside else 0


def _with_full_names(edit: TrackLink, scenes: Sequence[str]) -> tuple[TrackLink, list[tuple[str, list[str]]]]:
    """The edit with the names that scenes have, and the names that fit several, with these."""
    fitting = {name: [each for each in scenes if each == name or each.endswith(f"/{name}")] for name, *_ in edit.at}
    full = {name: found[0] if len(found) == 1 or name in found else name for name, found in fitting.items() if found}
    unclear = [(name, found) for name, found in fitting.items() if len(found) > 1 and name not in found]
    return edit.model_copy(update={"at": tuple((full.get(name, name), *at) for name, *at in edit.at)}), unclear
