"""The leaves, the stems and the plant on the page: their numbers, and lines of stems in the photos."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from mvseg.formats.text_file import short_number
from mvseg.results.overlay import instance_color
from mvseg.results.report.pictures import Picture
from mvseg.results.result import Result
from mvseg.results.stem_shapes import parts_of
from mvseg.traits.leaf import Measurement
from mvseg.traits.measure import Traits
from mvseg.traits.ontology import (
    COUNTED_TRAITS,
    LEAF_TRAITS,
    NODE_TRAITS,
    PLANT_TRAITS,
    SEEN_TRAITS,
    SURFACE_TRAITS,
    VOXEL_TRAITS,
    Definition,
    unit_of,
)
from mvseg.traits.table import VOXEL_NAMES

COLOURS = ("mean_red", "mean_green", "mean_blue")
# Not shown until they are asked for.
NO_COLUMNS = {*COLOURS, *(trait.name for trait in VOXEL_TRAITS if trait.name.endswith(("_min", "_max")))}
LABELS = {  # as people say it; of the others the name, with spaces
    "length_width_ratio": "length / width", "iou": "IoU", "num_views": "views", "num_pieces": "pieces",
    "mean_red": "red", "mean_green": "green", "mean_blue": "blue",
}  # fmt: skip
UNITLESS = {"degree": "°", "1": ""}


def describe_leaves(result: Result) -> list[dict[str, Any]]:
    """One entry per instance that has masks: id, colour, how likely it is a leaf (where the views chose it), shape,
    doubts, and its traits, if they were measured."""
    measured = {} if result.traits is None else {leaf.leaf: leaf for leaf in result.traits.leaves}
    leaves = []
    ids = result.masks.instance_ids
    for instance in ids[ids > 0].unique().tolist():
        about: dict[str, Any] = {"id": instance, "color": f"#{bytes(instance_color(instance)).hex()}"}
        if (chance := result.instances.probabilities.get(instance)) is not None:
            about["probability"] = round(chance, 3)
        if (leaf := measured.get(instance)) is not None:
            # as in traits.csv, traits of voxels are omitted if there are none
            shown = [each for each in LEAF_TRAITS if leaf.numbers[each.name].exists or each.name not in VOXEL_NAMES]
            about |= {"shape": leaf.method, "use": leaf.use, "doubts": list(leaf.reasons.values())}
            about["isRejected"] = leaf.rejection is not None
            about["traits"] = describe_numbers(leaf.numbers, shown)
        leaves.append(about)
    return leaves


def describe_numbers(numbers: Mapping[str, Measurement], traits: Iterable[Definition]) -> dict[str, Any]:
    """{trait: its value, standard deviation (None without one), and shape}; missing ones only have a reason."""

    def describe(number: Measurement) -> dict[str, Any]:
        if not number.exists:
            return {"why": number.method}
        return {"value": short_number(number.value), "sd": short_number(number.sd), "on": number.method}

    return {trait.name: describe(numbers[trait.name]) for trait in traits}


def describe_traits(traits: Traits | None) -> dict[str, Any]:
    """The traits of leaves that at least one leaf has, in the order of the table: meaning, unit, and whether the table
    has a column for them; those of the plant; and its numbers."""
    if traits is None:
        return {"traits": [], "plantTraits": [], "whole": {}}
    order = (*SURFACE_TRAITS, *NODE_TRAITS, *VOXEL_TRAITS, *COUNTED_TRAITS, *SEEN_TRAITS)
    shown = [trait for trait in order if any(leaf.numbers[trait.name].exists for leaf in traits.leaves)]
    return {
        "traits": [_describe_trait(trait, traits.unit) | {"isColumn": trait.name not in NO_COLUMNS} for trait in shown],
        "plantTraits": [_describe_trait(trait, traits.unit) for trait in PLANT_TRAITS],
        "whole": describe_numbers(traits.whole, PLANT_TRAITS),
    }


def _describe_trait(trait: Definition, unit: str) -> dict[str, Any]:
    written = UNITLESS.get(trait.kind, unit_of(trait.kind, unit)).replace("^2", "²").replace("^3", "³")
    label = LABELS.get(trait.name, trait.name.replace("_", " "))
    return {"name": trait.name, "label": label, "unit": written, "meaning": trait.meaning, "hasSd": trait.has_sd}


def draw_lines(result: Result, view: int, picture: Picture) -> list[dict[str, Any]]:
    """Stems and petioles in one photo: paths of SVG in the units of its picture, and the leaf of a petiole."""
    px_from_world, lines = result.scene.cameras.px_from_world[view].cpu().numpy(), []
    for part in parts_of(result):
        cam = part.points @ px_from_world[:, :3].T + px_from_world[:, 3]
        if (cam[:, 2] > 0).all():
            places = picture.place(cam[:, :2] / cam[:, 2:], result.scene.cameras.sizes[view].tolist())
            path = "M" + "L".join(f"{x} {y}" for x, y in places)
            line = {"name": part.name, "path": path, "isGuessed": part.is_guessed}
            lines.append(line if part.leaf is None else line | {"leaf": part.leaf})
    return lines
