"""The numbers of the leaves and of the plant on the page."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from mvseg.results.overlay import instance_color
from mvseg.results.result import Result
from mvseg.traits.leaf import Measurement
from mvseg.traits.measure import LeafTraits, Traits
from mvseg.traits.ontology import (
    COUNTED_TRAITS,
    LEAF_TRAITS,
    PLANT_TRAITS,
    SEEN_TRAITS,
    SURFACE_TRAITS,
    VOXEL_TRAITS,
    Definition,
    unit_of,
)
from mvseg.traits.table import VOXEL_NAMES, format_number

COLOURS = ("mean_red", "mean_green", "mean_blue")
# The corners of boxes are in traits.csv; in a table they are of no interest.
NO_COLUMNS = {*COLOURS, *(trait.name for trait in VOXEL_TRAITS if trait.name.endswith(("_min", "_max")))}
SIGNS = {"^2": "²", "^3": "³"}


def describe_leaves(result: Result) -> list[dict[str, Any]]:
    """One entry per instance: id, colour, shape, doubts, and its traits, if they were measured."""
    measured = {} if result.traits is None else {leaf.leaf: leaf for leaf in result.traits.leaves}
    found = []
    for instance in range(1, result.matching.num_instances + 1):
        red, green, blue = instance_color(instance)
        about: dict[str, Any] = {"id": instance, "color": f"#{red:02x}{green:02x}{blue:02x}"}
        leaf = measured.get(instance)
        found.append(about | _describe_leaf(leaf) if leaf is not None else about)
    return found


def _describe_leaf(leaf: LeafTraits) -> dict[str, Any]:
    # as in traits.csv, traits of voxels are omitted if there are none
    shown = [trait for trait in LEAF_TRAITS if leaf.numbers[trait.name].exists or trait.name not in VOXEL_NAMES]
    return {
        "shape": leaf.method,
        "doubts": list(leaf.reasons),
        "isRejected": leaf.rejection is not None,
        "traits": describe_numbers(leaf.numbers, shown),
    }


def describe_plant(traits: Traits | None) -> dict[str, Any]:
    """The plant's own numbers; none if no traits were measured."""
    return {} if traits is None else describe_numbers(traits.whole, PLANT_TRAITS)


def describe_numbers(numbers: Mapping[str, Measurement], traits: Iterable[Definition]) -> dict[str, Any]:
    """{trait: its value, standard deviation (None without one), and what it was measured on}; those that are missing
    have only a reason why."""
    found: dict[str, Any] = {}
    for trait in traits:
        number = numbers[trait.name]
        if not number.exists:
            found[trait.name] = {"why": number.method}
            continue
        sd = float(format_number(number.sd)) if np.isfinite(number.sd) else None
        found[trait.name] = {"value": float(format_number(number.value)), "sd": sd, "on": number.method}
    return found


def describe_traits(traits: Traits | None) -> list[dict[str, Any]]:
    """The traits of leaves that at least one leaf has, in the order of the table: what they mean, in which unit, and
    whether the table has a column for them."""
    if traits is None:
        return []
    order = (*SURFACE_TRAITS, *VOXEL_TRAITS, *COUNTED_TRAITS, *SEEN_TRAITS)
    shown = [trait for trait in order if any(leaf.numbers[trait.name].exists for leaf in traits.leaves)]
    return [_describe_trait(trait, traits.unit) | {"isColumn": trait.name not in NO_COLUMNS} for trait in shown]


def describe_plant_traits(traits: Traits | None) -> list[dict[str, Any]]:
    """The traits of the plant, but the deciles of its leaves' areas."""
    if traits is None:
        return []
    return [_describe_trait(trait, traits.unit) for trait in PLANT_TRAITS if "decile" not in trait.name]


def _describe_trait(trait: Definition, unit: str) -> dict[str, Any]:
    written = {"degree": "°", "1": ""}.get(trait.kind) if trait.kind in ("degree", "1") else unit_of(trait.kind, unit)
    for power, sign in SIGNS.items():
        written = (written or "").replace(power, sign)
    return {"name": trait.name, "unit": written, "meaning": trait.meaning}
