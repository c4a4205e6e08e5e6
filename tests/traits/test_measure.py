from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from blade_scene import SIZE, ring_cameras
from known_leaves import bent_blade, move, turn_about
from matched import matched
from mvseg.matching.result import Matching
from mvseg.reconstruction.surface.leaf_surface import LeafSurface
from mvseg.reconstruction.voxels import VoxelGrid
from mvseg.regions import regions_from_label_maps
from mvseg.scene import Scene, View
from mvseg.traits.config import TraitsConfig
from mvseg.traits.leaf import Measurement
from mvseg.traits.measure import LeafTraits, Traits, measure_plant, tilt
from mvseg.traits.ontology import LEAF_TRAITS, PLANT_TRAITS

CAMERAS = ring_cameras(3)
SCENE = Scene("plant", tuple(View(str(view), Path(f"absent/{view}.png")) for view in range(3)), CAMERAS, "mm",
              up=(0.0, 0.0, 1.0))  # fmt: skip
UP = np.array([0, 0, 1.0])


def small_leaf(number: int) -> LeafSurface:
    """Leaves around the origin, of different sizes."""
    leaf = bent_blade(length=0.5 + 0.1 * number, half_width=0.15)
    return move(leaf, turn_about(UP, 110 * number), shift=(0, 0, 0.1 * number))


def make_inputs(order: list[int]) -> tuple[Matching, dict[int, LeafSurface]]:
    """Leaf n gets the id `order[n - 1]`; its masks are its projections, the nearest id on top."""
    surfaces = {instance: small_leaf(number) for number, instance in enumerate(order, start=1)}
    maps = []
    for view in range(3):
        labels = np.zeros((SIZE, SIZE), np.int64)
        for surface_id, surface in sorted(surfaces.items(), key=lambda item: item[1].length):
            labels[surface.project(CAMERAS)[view].numpy()] = surface_id
        maps.append(labels)
    regions = regions_from_label_maps(maps)
    return matched(regions, scores=1.0), dict(sorted(surfaces.items()))


def rod() -> VoxelGrid:
    votes = torch.ones(3, 3, 4)
    return VoxelGrid(origin=torch.zeros(3).double(), voxel_size=0.1, votes=votes, num_views=3, threshold=0.5)


def numbers_of(leaf: LeafTraits) -> list[tuple[str, float, float]]:
    return [(name, n.value, n.sd) for name, n in leaf.numbers.items() if n.exists]


@pytest.fixture(scope="module")
def traits() -> Traits:
    matching, surfaces = make_inputs([1, 2, 3, 4])
    return measure_plant(SCENE, matching, surfaces=surfaces, voxels={})


def test_every_leaf_has_every_trait(traits: Traits) -> None:
    names = [trait.name for trait in LEAF_TRAITS]
    assert [leaf.leaf for leaf in traits.leaves] == [1, 2, 3, 4]
    assert all([*leaf.numbers] == names for leaf in traits.leaves)
    assert traits.whole.keys() == {trait.name for trait in PLANT_TRAITS}
    for leaf in traits.leaves:
        assert (leaf.method, leaf.use, leaf.quality, leaf.rejection) == ("surface", "yes", "good", None)
        missing = {name for name, number in leaf.numbers.items() if not number.exists}
        assert missing == {"mean_red", "mean_green", "mean_blue", "greenness_index", "senescent_share", "hue", "volume",
                           "x_min", "y_min", "z_min", "x_max", "y_max", "z_max", "num_pieces"}  # fmt: skip
        assert {leaf.numbers[name].method for name in missing} == {
            "not measured: there are no photos", "not measured: only voxels have it"
        }  # fmt: skip
        assert leaf.numbers["num_views"].value == leaf.numbers["sure_views"].value == 3
        assert leaf.numbers["insertion_height"].value >= 0
        assert leaf.numbers["visible_share"].value > 0.6
    assert traits.whole["total_leaf_area"].value == pytest.approx(sum(x.numbers["area"].value for x in traits.leaves))


def test_ids_may_be_permuted(traits: Traits) -> None:
    order = [3, 1, 4, 2]
    matching, surfaces = make_inputs(order)
    other = measure_plant(SCENE, matching, surfaces=surfaces, voxels={})
    for leaf, instance in zip(traits.leaves, order, strict=True):
        found = other.leaves[instance - 1]
        assert found.leaf == instance
        for (name, value, sd), (same, value2, sd2) in zip(numbers_of(leaf), numbers_of(found), strict=True):
            assert name == same
            assert (value2, sd2) == pytest.approx((value, sd), nan_ok=True, rel=1e-6)
    for name, number in traits.whole.items():
        assert other.whole[name].value == pytest.approx(number.value)


def test_a_leaf_without_a_credible_surface_has_voxels_and_a_reason() -> None:
    matching, surfaces = make_inputs([1, 2, 3, 4])
    surfaces[2] = LeafSurface.none(torch.arange(3), "no_common_point", "its masks agree on no point")
    surfaces[4] = LeafSurface.none(torch.arange(1), "one_view", "seen in one view only")
    surfaces[3] = replace(surfaces[3], reasons={"two_views": "seen in two views only"})
    traits = measure_plant(SCENE, matching, surfaces=surfaces, voxels={2: rod()})
    good, voxels, doubted, nothing = traits.leaves
    assert [leaf.method for leaf in traits.leaves] == ["surface", "voxels", "surface", "none"]
    assert (good.use, good.reasons) == ("yes", {})
    assert (doubted.use, doubted.quality) == ("look", "seen in two views only")
    assert doubted.numbers["iou"].method == "surface; seen in two views only"
    assert (voxels.use, [*voxels.reasons]) == ("look", ["no_surface", "no_common_point"])
    assert (nothing.use, nothing.quality) == ("no", "no credible surface; seen in one view only")
    assert {name for name, n in voxels.numbers.items() if n.exists} == {
        "volume", "x_min", "y_min", "z_min", "x_max", "y_max", "z_max", "num_pieces", "num_views", "sure_views"
    }  # fmt: skip
    assert {name for name, number in nothing.numbers.items() if number.exists} == {"num_views", "sure_views"}
    assert nothing.numbers["area"].method == "no credible surface; seen in one view only"
    assert traits.whole["number_of_leaves"].value == 4
    assert traits.whole["total_leaf_area"].method == "surface (2 of 4 leaves)"


@pytest.mark.parametrize(
    ("method", "codes", "use"),
    [
        ("surface", [], "yes"),
        ("surface", ["two_views"], "look"),
        ("surface", ["poor_fit"], "no"),
        ("voxels", ["no_blade", "poor_fit"], "look"),  # voxels do not depend on the surface
        ("none", ["one_view"], "no"),
    ],
)
def test_numbers_are_used_by_their_method_and_reasons(method: str, codes: list[str], use: str) -> None:
    traits = LeafTraits(1, {}, method, dict.fromkeys(codes, "why"), None)
    assert traits.use == use
    assert replace(traits, rejection="stem").use == "no"


def test_rejected_leaves_are_empty_counted_and_left_out() -> None:
    matching, surfaces = make_inputs([1, 2, 3, 4])
    is_doubtful = (matching.instance_ids == 2) & (matching.masks.view_index > 0)
    scores = matching.match_scores.masked_fill(is_doubtful, 0.1)  # so instance 2 is surely seen by one view
    matching = matching.with_masks(replace(matching.masks, match_scores=scores))
    traits = measure_plant(SCENE, matching, surfaces=surfaces, voxels={2: rod()})
    assert traits.rejected == {2: "few_sure_views"}
    leaf = traits.leaves[1]
    assert leaf.reasons == {"few_sure_views": "rejected: 1 sure views, asked for are 2"}
    assert leaf.use == "no"
    assert {name for name, n in leaf.numbers.items() if n.exists} == {"num_views", "sure_views", "iou"}
    assert leaf.numbers["area"].method == leaf.quality
    assert traits.whole["number_of_leaves"].value == 3
    kept = measure_plant(SCENE, matching, surfaces=surfaces, voxels={}, config=TraitsConfig(min_sure_views=1))
    assert kept.rejected == {}
    assert kept.whole["number_of_leaves"].value == 4


def test_voxels_only() -> None:
    matching, _ = make_inputs([1, 2])
    traits = measure_plant(SCENE, matching, surfaces=None, voxels={1: rod()})
    first, second = traits.leaves
    assert (first.method, first.use, first.quality) == ("voxels", "look", "good")
    assert first.numbers["volume"].value == pytest.approx(36e-3)
    assert first.numbers["area"].method == "no surface was asked for"
    assert second.method == "none"
    assert [*second.reasons] == ["no_shape"]
    assert not traits.whole["total_leaf_area"].exists


@pytest.mark.parametrize("asked_for", [True, False])
def test_a_shape_of_several_pieces_says_so(asked_for: bool) -> None:
    matching, surfaces = make_inputs([1, 2, 3, 4])
    surfaces[2] = LeafSurface.none(torch.arange(3), "no_common_point", "its masks agree on no point")
    apart = rod().votes.clone()
    apart[:, :, 1] = 0
    voxels = {2: replace(rod(), votes=apart)}
    found = measure_plant(SCENE, matching, surfaces=surfaces if asked_for else None, voxels=voxels)
    leaf = found.leaves[1]
    assert leaf.method == "voxels"
    assert leaf.numbers["num_pieces"].value == 2
    assert leaf.reasons["pieces"] == "in 2 pieces"
    why = "no credible surface; its masks agree on no point" if asked_for else "no surface was asked for"
    assert leaf.numbers["iou"].method == f"{why}; in 2 pieces"
    assert leaf.numbers["area"].method == why


def test_the_stem_tells_up_less_surely() -> None:
    names = ("inclination", "area", "insertion_height", "height")
    numbers = {name: Measurement(30.0, 3.0, "surface") for name in names}
    assert tilt(numbers, 0.0, extent=100) == numbers
    tilted = tilt(numbers, 4.0, extent=100)
    assert tilted["area"] == numbers["area"]
    assert tilted["inclination"] == Measurement(30.0, 5.0, "surface, up from the stem")
    height_sd = np.hypot(3, 50 * np.radians(4))
    assert [tilted[name].sd for name in ("insertion_height", "height")] == pytest.approx([height_sd] * 2)
