"""Links of a person, from a file of corrections."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mvseg.corrections.file import load_corrections
from mvseg.corrections.track_links import LeafLink, find_links
from mvseg.errors import InputError
from mvseg.formats.label_png import write_label_png
from tests.plants_over_days import grow_blades, write_result


def write(path: Path, *edits: dict[str, Any]) -> Path:
    path.write_text(json.dumps({"format": "mvseg-corrections/1", "edits": list(edits)}))
    return path


def write_results(folder: Path, *names: str, view: str = "000") -> dict[str, Path]:
    for name in names:
        write_result(folder / name, grow_blades(3, 1), view=view)
    return {name: folder / name for name in names}


def test_points_become_leaves(tmp_path: Path) -> None:
    folders = write_results(tmp_path, "a", "b")
    path = write(
        tmp_path / "corrections.json",
        {"op": "reject", "view": "000", "at": [1.0, 2.0]},  # of a single scene
        {"op": "same_track", "at": [["a", "000", 5.5, 20], ["b", "000.jpg", 30.2, 20]]},
        {"op": "different_track", "at": [["a", "000", 5.5, 20], ["b", "000", 0.5, 0.5]]},  # no leaf is there
        {"op": "same_track", "at": [["x", "000", 5, 5], ["y", "000", 5, 5]]},  # another plant
    )
    links, lost = find_links(load_corrections(path).edits, folders)
    assert links == [LeafLink(True, (("a", 1), ("b", 2)))]
    assert lost == {2: "different_track: there is no leaf at (0.5, 0.5) in view 000 of b"}


def test_results_of_one_folder_name_keep_their_links(tmp_path: Path) -> None:
    folders = write_results(tmp_path, "mon/plant", "fri/plant")
    path = write(
        tmp_path / "corrections.json",
        {"op": "same_track", "at": [["mon/plant", "000", 5.5, 20], ["fri/plant", "000", 30.2, 20]]},
        {"op": "same_track", "at": [["plant", "000", 5.5, 20], ["fri/plant", "000", 30.2, 20]]},
    )
    links, lost = find_links(load_corrections(path).edits, folders)
    assert links == [LeafLink(True, (("mon/plant", 1), ("fri/plant", 2)))]
    assert lost == {1: "same_track: plant fits mon/plant and fri/plant, expected one of them"}


def test_views_in_folders_are_found_by_any_name_that_fits_one(tmp_path: Path) -> None:
    folders = write_results(tmp_path, "a", "b", view="left/000")
    write_label_png(tmp_path / "b" / "labels" / "right" / "000.png", np.zeros((40, 60), np.uint16))  # two are named 000
    for view in ("left/000", "left/000.jpg", "left\\000.png"):
        edit = {"op": "same_track", "at": [["a", "000", 5.5, 20], ["b", view, 30.2, 20]]}
        links, lost = find_links(load_corrections(write(tmp_path / "corrections.json", edit)).edits, folders)
        assert (links, lost) == ([LeafLink(True, (("a", 1), ("b", 2)))], {})
    edit = {"op": "same_track", "at": [["a", "000", 5.5, 20], ["b", "000", 30.2, 20]]}
    links, lost = find_links(load_corrections(write(tmp_path / "corrections.json", edit)).edits, folders)
    assert (links, lost) == ([], {0: "same_track: there is no leaf at (30.2, 20) in view 000 of b"})


def test_a_later_link_wins(tmp_path: Path) -> None:
    folders, x = write_results(tmp_path, "a", "b", "c"), {1: 5.5, 2: 30.2, 3: 50.0}

    def edit(op: str, *leaves: tuple[str, int]) -> dict[str, Any]:
        return {"op": op, "at": [[scene, "000", x[leaf], 20] for scene, leaf in leaves]}

    path = write(
        tmp_path / "corrections.json",
        edit("same_track", ("a", 1), ("b", 1)),  # both with leaf 2 of c, by edits 2 and 3; so edit 4 is against one
        edit("same_track", ("a", 1), ("c", 2)),
        edit("same_track", ("b", 1), ("c", 2)),
        edit("different_track", ("a", 1), ("b", 1)),
        edit("same_track", ("a", 3), ("a", 2)),
        edit("same_track", ("a", 3), ("b", 2)),
    )
    links, lost = find_links(load_corrections(path).edits, folders)
    assert links == [
        LeafLink(True, (("b", 1), ("c", 2))),
        LeafLink(False, (("a", 1), ("b", 1))),
        LeafLink(True, (("a", 3), ("b", 2))),
    ]
    assert lost == {
        0: "same_track: contradicted by edit 4",
        1: "same_track: contradicted by edit 4",
        4: "same_track: two leaves of one date, which are never the same",
    }


@pytest.mark.parametrize("view", ["nothing", "../labels/000", "/etc/x"])
def test_views_that_are_not_there(tmp_path: Path, view: str) -> None:
    path = write(tmp_path / "c.json", {"op": "same_track", "at": [["a", view, 900, 900], ["b", "000", 5.5, 20]]})
    assert find_links(load_corrections(path).edits, write_results(tmp_path, "a", "b"))[0] == []


@pytest.mark.parametrize("at", [None, [["a", "000", 1, 2]], [["a", 1], ["b", 2]]])
def test_broken_links_are_refused(tmp_path: Path, at: Any) -> None:
    with pytest.raises(InputError, match=r"edit 1 \(same_track\)"):
        load_corrections(write(tmp_path / "c.json", {"op": "same_track", "at": at}))
