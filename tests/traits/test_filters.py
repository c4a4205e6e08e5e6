from __future__ import annotations

from collections.abc import Mapping
from functools import partial

import numpy as np
import pytest

from known_leaves import bent_blade, fit_coefficients, flat_leaf, flat_sheet, make_surface, move, turn_about
from mvseg.errors import InputError
from mvseg.reconstruction.surface.leaf_surface import LeafSurface
from mvseg.reconstruction.voxels import VoxelGrid
from mvseg.traits.config import TraitsConfig
from mvseg.traits.filters import find_rejected

UP = np.array([0.0, 0.0, 1.0])
CONFIG = TraitsConfig()
Shape = LeafSurface | VoxelGrid


def plant() -> dict[int, LeafSurface]:
    """Four leaves of 40 around a stem, at heights 10 to 70."""
    return {i: move(bent_blade(), turn_about(UP, 137 * i), shift=(0, 0, 20 * i - 10)) for i in (1, 2, 3, 4)}


def upright(*, length: float, half_width: float, iou: float) -> LeafSurface:
    surface = make_surface(fit_coefficients(flat_sheet, length=length, half_width=half_width), iou=iou)
    return move(surface, turn_about(np.array([0, -1.0, 0]), 88), shift=(0, 0, -5))


def tape(z: float) -> LeafSurface:
    return flat_leaf(length=150, half_width=9, at=(-70, 30, z))


def kinds(shapes: Mapping[int, Shape], *, up: np.ndarray | None = UP, config: TraitsConfig = CONFIG) -> dict[int, str]:
    return {i: rejection.kind for i, rejection in find_rejected(shapes, up, config=config).items()}


def test_leaves_are_leaves() -> None:
    assert kinds(plant()) == {}
    assert kinds({}) == {}
    assert kinds({1: flat_leaf()}) == {}


@pytest.mark.parametrize(
    ("shape", "kind"),
    [
        (upright(length=90, half_width=3, iou=0.85), None),  # what no tube explains is no stem
        (tape(-30.0), "floor"),
        (tape(20.0), None),  # large, but amid the plant
        (flat_leaf(length=30, half_width=5, at=(0, 0, -30)), None),  # the lowest leaf
        (flat_leaf(at=(200, 0, 30)), "beside_the_plant"),
        (flat_leaf(at=(70, 0, 30)), None),
    ],
)
def test_what_is_no_leaf(shape: Shape, kind: str | None) -> None:
    assert kinds(plant() | {9: shape}) == ({9: kind} if kind else {})
    assert kinds(plant() | {9: shape}, config=TraitsConfig(leaves_only=False)) == {}
    blind = kinds(plant() | {9: shape}, up=None)  # only the distance can be told
    assert blind == ({9: kind} if kind == "beside_the_plant" else {})


def test_the_world_may_be_turned_and_scaled() -> None:
    turn = turn_about(np.array([1.0, 2.0, -1.0]), 111)
    others = {8: tape(-30.0), 9: flat_leaf(at=(200, 0, 30))}
    shapes = {i: move(shape, turn, scale=0.01, shift=(5, -3, 2)) for i, shape in (plant() | others).items()}
    assert kinds(shapes, up=turn @ UP) == {8: "floor", 9: "beside_the_plant"}


def test_what_a_tube_explains_is_a_stem_unless_all_instances_are_wanted() -> None:
    shapes, chances = plant(), {1: 0.95, 2: 0.85, 3: 0.02, 7: 0.99}  # 7 has no shape
    found = find_rejected(shapes, None, config=CONFIG, stems=chances)
    assert {i: rejection.kind for i, rejection in found.items()} == {1: "stem", 7: "stem"}
    assert found[1].reason == "looks like a stem: a tube explains its masks, probability 0.95"
    assert find_rejected(shapes, None, config=TraitsConfig(leaves_only=False), stems=chances) == {}


def test_two_groups_apart_are_both_kept() -> None:
    """Neither of them is most of the plant."""
    there = {i + 10: move(leaf, np.eye(3), shift=(900, 0, 0)) for i, leaf in plant().items()}
    assert kinds(plant() | there) == {}


def test_what_little_speaks_for() -> None:
    shapes = plant() | {5: make_surface(bent_blade().coefficients.numpy(), iou=0.4)}
    sure_views, shares = {1: 5, 2: 1, 3: 2, 4: 0, 5: 4}, {1: 0.01, 2: 0.9, 3: 0.05, 4: float("nan"), 5: 0.9}
    ask = partial(find_rejected, shapes, UP, sure_views=sure_views, visible_shares=shares)
    found = ask(config=CONFIG)
    assert {i: rejection.kind for i, rejection in found.items()} == {
        1: "hardly_visible", 2: "few_sure_views", 4: "few_sure_views", 5: "low_quality"
    }  # fmt: skip
    assert found[1].reason == "its masks cover a share of 0.01 of its surface, asked for is 0.05"
    assert found[2].reason == "1 sure views, asked for are 2"
    assert found[5].reason == "median IoU 0.40 with its masks, asked for is 0.5"
    anything = TraitsConfig(min_sure_views=0, min_quality=0, min_visible_share=0)
    assert ask(config=anything) == {}


@pytest.mark.parametrize(
    ("option", "value"), [("min_sure_views", -1), ("min_quality", 1.5), ("min_visible_share", -0.1)]
)
def test_options_out_of_range(option: str, value: float) -> None:
    with pytest.raises(InputError, match=f"traits.{option} is"):
        TraitsConfig(**{option: value})  # type: ignore[arg-type]
