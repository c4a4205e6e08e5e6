"""Names of files and the views that they mean."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from mvseg.errors import InputError
from mvseg.findings.finding import list_some
from mvseg.formats.find_views import base_name, find_views
from mvseg.scene import Cameras, Scene, View
from warned import warns_of


def scene_of(*files: str) -> Scene:
    eye = torch.eye(3).expand(len(files), 3, 3)
    cameras = Cameras(K=eye, R=eye, t=torch.zeros(len(files), 3), sizes=torch.ones(len(files), 2))
    views = [View(file.removeprefix("images/").rsplit(".", 1)[0], Path("plant") / file) for file in files]
    return Scene("plant", tuple(views), cameras)


@pytest.mark.parametrize(
    ("name", "base"),
    [
        ("000.jpg", "000"), ("a/b/000.PNG", "000"), ("C:\\x\\Leaf 1.TIF", "leaf 1"), ("day.1", "day.1"),
        ("day.1.plant.jpg", "day.1.plant"), ("000_jpg.rf.0f3a9.jpg", "000"), ("000_png.rf.0f3a9", "000"),
        ("IMG_1.heic", "img_1"), ("", ""), (".jpg", ""), ("000.jpg.png", "000"), ("5f1c0e7a-000.jpg", "000"),
    ],
)  # fmt: skip
def test_base_names(name: str, base: str) -> None:
    assert base_name(name) == base


@pytest.mark.parametrize(
    ("names", "views"),
    [
        (["images/left/1.jpg", "right/1.jpg", "2.jpg"], [0, 1, 2]),
        (["left/1", "right/1.png", "plant/images/2.jpg"], [0, 1, 2]),
        (["old/2.jpg", "right/1.jpg", "left/1.jpg"], [2, 1, 0]),
        (["old/1.jpg"], [None]),  # two photos have this base name
        (["3.jpg", "", "/", "..", "../2.jpg"], [None, None, None, None, 2]),
        ([], []),
    ],
)
def test_names_find_their_views(names: list[str], views: list[int | None]) -> None:
    scene = scene_of("images/left/1.jpg", "images/right/1.jpg", "images/2.jpg")
    assert find_views(names, scene, source=Path("masks")) == views


def test_a_name_that_fits_by_itself_beats_base_names() -> None:
    scene = scene_of("images/day.jpg", "images/day.1.jpg")
    assert find_views(["day.1", "x/day.jpg", "day.jpg"], scene, source=Path("masks")) == [1, None, 0]
    assert find_views(["day.1.jpg.png", "images/day.jpg.png"], scene, source=Path("masks")) == [1, 0]
    assert find_views(["5f1c0e7a-day.jpg", "day.1.JPG.png"], scene, source=Path("masks")) == [0, 1]


def test_names_that_fit_several_views_or_loosely() -> None:
    scene = scene_of("images/left/1.jpg", "images/right/1.jpg", "images/2.jpg")
    with pytest.raises(InputError, match=r"masks: image 1.jpg could be view 0 \(left/1\) or 1 \(right/1\)"):
        find_views(["1.jpg"], scene, source=Path("masks"))
    with pytest.raises(InputError, match=r"masks: both a/2.jpg and b/2.jpg could be view 2 \(2\), expected the path"):
        find_views(["a/2.jpg", "b/2.jpg"], scene, source=Path("masks"))
    scene, names = scene_of("images/1.jpg", "images/2.jpg"), ["1.jpg", "old/2.jpg"]
    with warns_of("base_names"):
        find_views(names, scene, source=Path("masks"), warn_of_loose=True)
    find_views(names[:1], scene, source=Path("masks"), warn_of_loose=True)


def test_lists_are_short() -> None:
    assert list_some([]) == "nothing"
    assert list_some(["a", "b", "a", "c"]) == "a, b, c"
    assert list_some(list("abcde")) == "a, b, c and 2 more"
