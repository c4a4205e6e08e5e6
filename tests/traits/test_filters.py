from __future__ import annotations

from functools import partial

import numpy as np
import pytest

from known_leaves import bent_blade, flat_leaf, make_surface, move, turn_about
from mvseg.errors import InputError
from mvseg.reconstruction.surface.leaf_surface import LeafSurface
from mvseg.traits.config import TraitsConfig
from mvseg.traits.filters import find_rejected

UP = np.array([0.0, 0.0, 1.0])
CONFIG = TraitsConfig()


def plant() -> dict[int, LeafSurface]:
    """Four leaves of 40 around a stem, at heights 10 to 70."""
    return {i: move(bent_blade(), turn_about(UP, 137 * i), shift=(0, 0, 20 * i - 10)) for i in (1, 2, 3, 4)}


def test_leaves_are_leaves_and_what_is_slender_a_stem_unless_all_instances_are_wanted() -> None:
    for shapes in (plant(), {}, {1: flat_leaf()}):
        assert find_rejected(shapes, config=CONFIG) == {}
    shapes, chances = plant(), {1: 0.95, 2: 0.85, 3: 0.02, 7: 0.99}  # 7 has no shape
    found = find_rejected(shapes, config=CONFIG, stems=chances)
    assert {i: rejection.kind for i, rejection in found.items()} == {1: "stem", 7: "stem"}
    assert found[1].reason == "looks like a stem: it is slender for its plant, probability 0.95"
    assert find_rejected(shapes, config=TraitsConfig(leaves_only=False), stems=chances) == {}


def test_what_little_speaks_for() -> None:
    shapes = plant() | {5: make_surface(bent_blade().coefficients.numpy(), iou=0.4)}
    sure_views, shares = {1: 5, 2: 1, 3: 2, 4: 0, 5: 4}, {1: 0.01, 2: 0.9, 3: 0.05, 4: float("nan"), 5: 0.9}
    ask = partial(find_rejected, shapes, sure_views=sure_views, visible_shares=shares)
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
