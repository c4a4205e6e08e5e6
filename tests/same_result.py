"""Whether two results are the same, for tests: the first difference is named."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch

from mvseg.results.result import Result
from mvseg.traits.measure import Traits
from mvseg.traits.table import VOXEL_NAMES

ROUNDED = ("match_scores", "detection_scores", "probabilities")  # result folders keep four decimals


def assert_same_result(first: Result, second: Result, *, relative: float = 1e-5, absolute: float = 1e-4) -> None:
    """Check that two results say the same: of the scene, of each mask and instance, and of the run's outcome.

    Not compared: photos and their places, times, versions, options, `starts` and the candidates `left` out. `relative`
    is for traits, cameras and shapes (of matrices: of the largest number), `absolute` for what is `ROUNDED`.
    """
    compared = describe(first), describe(second)
    for what, value in compared[0].items():
        tolerance = {"absolute": absolute} if what in ROUNDED else {"relative": relative}
        _compare(what, value, compared[1][what], **tolerance)


def describe(result: Result) -> dict[str, Any]:
    """{name: what is compared}, as values, tensors, and mappings and lists of these."""
    scene, masks, instances, report = result.scene, result.masks.to("cpu"), result.instances, result.matching.report
    sizes = masks.regions.boxes[:, 2:].tolist()
    surfaces = ("reasons", "is_oriented", "coefficients", "covariance", "views", "residual_px", "iou")
    return {
        "scene": [scene.name, scene.unit, scene.up, [view.name for view in scene.views], result.mask_kind],
        "cameras": {name: getattr(scene.cameras, name) for name in ("K", "R", "t", "sizes")},
        "masks": [masks.regions.mask(row, *size) for row, size in enumerate(sizes)],
        **{name: getattr(masks, name) for name in ("view_index", "instance_ids", "origin", "classes")},
        **{name: getattr(masks, name) for name in ROUNDED[:2]},
        "report": [report.method, report.residual_px, result.matching.num_instances],
        "probabilities": instances.probabilities,
        "surfaces": _attributes(result.surfaces, surfaces),
        "voxels": _attributes(result.voxels, ("origin", "voxel_size", "votes")),
        "traits": None if result.traits is None else _describe_traits(result.traits),
        "outcome": [result.fates, result.corrections and result.corrections.edits],
    }


def _attributes(of_leaf: Mapping[int, Any] | None, names: Sequence[str]) -> dict[int, dict[str, Any]] | None:
    return of_leaf and {leaf: {name: getattr(each, name) for name in names} for leaf, each in of_leaf.items()}


def _describe_traits(traits: Traits) -> dict[Any, Any]:
    said: dict[Any, Any] = {"unit": traits.unit}
    said["stems"] = [[stem.source, [node.leaf for node in stem.nodes]] for stem in traits.stems]
    tables = {0: traits.whole, **{leaf.leaf: leaf.numbers for leaf in traits.leaves}}
    for leaf, numbers in tables.items():
        said[leaf] = {name: torch.tensor([number.value, number.sd]) for name, number in numbers.items()}
        has_row = [name for name, number in numbers.items() if number.exists or name not in VOXEL_NAMES]
        said[leaf, "methods"] = {name: numbers[name].method for name in has_row}
        said[leaf, "about"] = [[each.method, each.rejection, each.quality]
                               for each in traits.leaves if each.leaf == leaf]  # fmt: skip
    return said


def _compare(what: str, first: Any, second: Any, *, relative: float = 0.0, absolute: float = 0.0) -> None:
    """Numbers have NaN in the same places; `relative` is a share of the largest of them."""
    if isinstance(first, Mapping) and isinstance(second, Mapping):
        assert first.keys() == second.keys(), f"{what}: {sorted(map(str, first))} and {sorted(map(str, second))}"
        for key, value in first.items():
            _compare(f"{what}[{key}]", value, second[key], relative=relative, absolute=absolute)
    elif isinstance(first, list) and isinstance(second, list):
        assert len(first) == len(second), f"number of {what}: {len(first)} and {len(second)}"
        for place, pair in enumerate(zip(first, second, strict=True)):
            _compare(f"{what}[{place}]", *pair, relative=relative, absolute=absolute)
    elif isinstance(first, torch.Tensor | float) and isinstance(second, torch.Tensor | float):
        one, other = (torch.as_tensor(each, dtype=torch.float64, device="cpu") for each in (first, second))
        assert one.shape == other.shape, f"shape of {what}: {tuple(one.shape)} and {tuple(other.shape)}"
        size = torch.stack((one, other)).nan_to_num().abs().max() if one.numel() else 0.0
        is_near = (one == other) | ((one - other).abs() <= relative * size + absolute) | (one.isnan() & other.isnan())
        place = tuple((~is_near).nonzero()[0].tolist()) if not is_near.all() else ()
        assert is_near.all(), f"{what}{list(place)}: {float(one[place]):.8g} and {float(other[place]):.8g}"
    else:
        assert first == second, f"{what}: {first!r:.200} and {second!r:.200}"
