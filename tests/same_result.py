"""Whether two results are the same, for tests: the first difference is named."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Literal, TypeVar

import torch

from mvseg.masks import Masks
from mvseg.results.result import Result

if TYPE_CHECKING:  # loads trimesh and scikit-image
    from mvseg.traits.measure import Traits

T = TypeVar("T")
Ids = Literal["exact", "renumbered"]


def assert_same_result(
    first: Result, second: Result, *, ids: Ids = "exact", relative: float = 1e-5, absolute: float = 1e-4
) -> None:
    """Check that two results say the same: of the scene, of each mask and instance, and of the run's outcome.

    Masks are compared pixel by pixel and row by row. Not compared: photos and their places, times, versions and
    options, `starts` of the instances and the candidates `left` out.

    Args:
        first, second: the results.
        ids: "renumbered": the instances of `second` may have other numbers, as long as these stand for the same masks.
        relative: tolerance of traits, cameras and shapes, as a share of the number; of matrices, of the largest one.
        absolute: tolerance of match scores, probabilities, and scores of the detector; result folders round them to
            four decimals.

    Raises:
        AssertionError: they differ; the message is the first difference.
    """
    scene, other = first.scene, second.scene
    _check("name of the scene", scene.name, other.name)
    _check("views", [view.name for view in scene.views], [view.name for view in other.views])
    _check("unit", scene.unit, other.unit)
    _check_numbers("up", scene.up or (), other.up or (), relative=relative)
    for name in ("K", "R", "t", "sizes"):
        pair = getattr(scene.cameras, name), getattr(other.cameras, name)
        _check_numbers(f"cameras.{name}", *pair, relative=relative)
    _check("kind of masks", first.mask_kind, second.mask_kind)
    numbers = _compare_masks(first.masks.to("cpu"), second.masks.to("cpu"), ids, absolute)
    for name in ("method", "residual_px"):
        _check(name, getattr(first.matching.report, name), getattr(second.matching.report, name))
    _check("num_instances", first.matching.num_instances, second.matching.num_instances)
    of_leaf = _pair_up("probability", first.instances.probabilities, second.instances.probabilities, numbers)
    for leaf, pair in of_leaf.items():
        _check_numbers(f"probability of leaf {leaf}", *pair, absolute=absolute)
    _compare_shapes(first, second, numbers, relative)
    _check("has traits", first.traits is None, second.traits is None)
    if first.traits is not None and second.traits is not None:
        _compare_traits(first.traits, second.traits, numbers, relative)
    _check("moved masks", first.num_moved, second.num_moved)
    _check("fates of corrections", first.fates, second.fates)
    edits = [() if each.corrections is None else each.corrections.edits for each in (first, second)]
    _check("corrections", *edits)


def _check(what: str, first: object, second: object) -> None:
    if first != second:
        raise AssertionError(f"{what}: {first!r:.200} and {second!r:.200}")


def _check_numbers(what: str, first: Any, second: Any, *, relative: float = 0.0, absolute: float = 0.0) -> None:
    """Of numbers or tensors, NaN in the same places; `relative` is a share of the largest of the numbers."""
    one, other = (torch.as_tensor(each, dtype=torch.float64, device="cpu") for each in (first, second))
    _check(f"shape of {what}", tuple(one.shape), tuple(other.shape))
    size = torch.stack((one, other)).nan_to_num().abs().max() if one.numel() else 0.0
    is_near = (one == other) | ((one - other).abs() <= relative * size + absolute) | (one.isnan() & other.isnan())
    if not is_near.all():
        place = tuple((~is_near).nonzero()[0].tolist())
        raise AssertionError(f"{what}{list(place) or ''}: {float(one[place]):.8g} and {float(other[place]):.8g}")


def _pair_up(
    what: str, first: Mapping[int, T], second: Mapping[int, T], numbers: Mapping[int, int]
) -> dict[int, tuple[T, T]]:
    """{leaf, by its number in the second result: what is known of it in both}."""
    known = {numbers.get(leaf, leaf): each for leaf, each in first.items()}
    _check(f"leaves with {what}", sorted(known), sorted(second))
    return {leaf: (known[leaf], second[leaf]) for leaf in sorted(known)}


def _compare_masks(first: Masks, second: Masks, ids: Ids, absolute: float) -> dict[int, int]:
    """{id in the first table: id in the second}."""
    _check("number of masks", len(first), len(second))
    _check("views of the masks", first.view_index.tolist(), second.view_index.tolist())
    numbers = {-1: -1}
    for row, pair in enumerate(zip(first.instance_ids.tolist(), second.instance_ids.tolist(), strict=True)):
        what = f"mask {row} (view {int(first.view_index[row])})"
        size = torch.maximum(first.regions.boxes[row, 2:], second.regions.boxes[row, 2:]).tolist()
        if not torch.equal(*(each.regions.mask(row, *size) for each in (first, second))):
            raise AssertionError(f"{what}: other pixels")
        _check(f"{what}: instance id", pair[0] if ids == "exact" else numbers.setdefault(*pair), pair[1])
        numbers[pair[0]] = pair[1]
    _check("instances that share a number", len(numbers) - len({*numbers.values()}), 0)
    for name in ("origin", "classes", "match_scores", "detection_scores"):
        _check_numbers(f"{name} of mask", getattr(first, name), getattr(second, name), absolute=absolute)
    merged = [(each.region, numbers.get(each.other, each.other)) for each in first.merged]
    _check("masks of two instances", merged, [(each.region, each.other) for each in second.merged])
    for one, other in zip(first.merged, second.merged, strict=True):
        _check_numbers(f"second part of mask {one.region}", one.part, other.part)
    return numbers


def _compare_shapes(first: Result, second: Result, numbers: Mapping[int, int], relative: float) -> None:
    _check("has surfaces", first.surfaces is None, second.surfaces is None)
    for leaf, pair in _pair_up("surfaces", first.surfaces or {}, second.surfaces or {}, numbers).items():
        for name in ("quality", "is_oriented"):
            _check(f"surface of leaf {leaf}: {name}", *(getattr(each, name) for each in pair))
        for name in ("coefficients", "covariance", "views", "residual_px", "iou"):
            one, other = (getattr(each, name) for each in pair)
            _check_numbers(f"surface of leaf {leaf}: {name}", one, other, relative=relative)
    for leaf, (grid, again) in _pair_up("voxels", first.voxels or {}, second.voxels or {}, numbers).items():
        for name in ("origin", "voxel_size", "votes"):
            one, other = getattr(grid, name), getattr(again, name)
            _check_numbers(f"voxels of leaf {leaf}: {name}", one, other, relative=relative)


def _compare_traits(first: Traits, second: Traits, numbers: Mapping[int, int], relative: float) -> None:
    from mvseg.traits.table import VOXEL_NAMES

    _check("unit of the traits", first.unit, second.unit)
    nodes = [[(stem.source, [numbers.get(node.leaf, node.leaf) for node in stem.nodes]) for stem in first.stems],
             [(stem.source, [node.leaf for node in stem.nodes]) for stem in second.stems]]  # fmt: skip
    _check("nodes of the stems", *nodes)
    tables = {"the plant": (first.whole, second.whole)}
    leaves, again = ({leaf.leaf: leaf for leaf in each.leaves} for each in (first, second))
    for number, (one, other) in _pair_up("traits", leaves, again, numbers).items():
        what = f"leaf {number}"
        for name in ("method", "rejection"):
            _check(f"{what}: {name}", getattr(one, name), getattr(other, name))
        _check(f"{what}: reasons", "; ".join(one.reasons), "; ".join(other.reasons))
        tables[what] = one.numbers, other.numbers
    for what, (before, after) in tables.items():
        _check(f"{what}: names of traits", sorted(before), sorted(after))
        for name, measured in before.items():
            _check_numbers(f"{what}: {name}", measured.value, after[name].value, relative=relative)
            _check_numbers(f"{what}: sd of {name}", measured.sd, after[name].sd, relative=relative)
            if measured.exists or name not in VOXEL_NAMES:  # tables have no rows for voxels that are missing
                _check(f"{what}: method of {name}", measured.method, after[name].method)
