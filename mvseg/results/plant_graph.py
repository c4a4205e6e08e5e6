"""The plant as a graph, for programs that model plants: stems, their nodes, and the leaves that these bear.

Each part has its term in a multiscale tree graph (MTG), as "<E2": "/" begins a whole, "<" follows the part before it,
"+" branches off. Classes are plants P, axes A, metamers E (a node, and the internode below it) and leaves L.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from mvseg.formats.text_file import short_number
from mvseg.traits.leaf import Measurement
from mvseg.traits.measure import LeafTraits, Traits
from mvseg.traits.nodes import Stem
from mvseg.traits.ontology import DEFINITIONS, Kind, unit_of

GRAPH_FORMAT = "mvseg-plant/1"
SCALES = {"P": 1, "A": 2, "E": 3, "L": 3}  # definition: scale of each class in the MTG
OF_NODES: dict[str, Kind] = {"internode": "length", "divergence": "degree", "node_azimuth": "degree"}
KINDS = {name: each.kind for name, each in DEFINITIONS.items()} | OF_NODES


def plant_graph(traits: Traits) -> dict[str, Any]:
    """Content of plant.json. Leaves without a node hang on the plant; instances that are no leaves are left out."""
    leaves = {leaf.leaf: leaf for leaf in traits.leaves if leaf.rejection is None}
    on_stems = {node.leaf for stem in traits.stems for node in stem.nodes}
    return {
        "format": GRAPH_FORMAT,
        "mtg": "/P1",
        "mtg_scales": SCALES,
        "plant": traits.plant,
        "unit": traits.unit or None,
        "units": {name: unit_of(kind, traits.unit) for name, kind in KINDS.items()},
        "up": traits.up,
        **_split_numbers(traits.whole),
        "stems": [_describe_stem(stem, leaves) for stem in traits.stems],
        "leaves": [{"mtg": f"/L{id}"} | leaf_extras(leaf) for id, leaf in leaves.items() if id not in on_stems],
    }


def _describe_stem(stem: Stem, leaves: Mapping[int, LeafTraits]) -> dict[str, Any]:
    nodes: dict[int, dict[str, Any]] = {}
    for node in stem.nodes:
        term, place = f"{'<' if nodes else '/'}E{node.number}", [*map(short_number, node.place)]
        numbers = _split_numbers({"height": node.height, "internode": node.internode})
        metamer = {"mtg": term, "node": node.number, "place": place, **numbers, "leaves": []}
        about = {"mtg": f"+L{node.leaf}", "rank": node.rank, "petiole": [place, [*map(short_number, node.base)]]}
        leaf = leaves[node.leaf]
        of_leaf = {**leaf.numbers, "divergence": node.divergence, "node_azimuth": node.node_azimuth}
        nodes.setdefault(node.number, metamer)["leaves"].append(about | leaf_extras(replace(leaf, numbers=of_leaf)))
    suggested = stem.phyllotaxis
    return {
        "mtg": f"/A{stem.number}",
        "stem": stem.number,
        "source": stem.source,
        "probability": short_number(stem.probability),
        "phyllotaxis": suggested.name,
        "phyllotaxis_angle": short_number(suggested.angle),
        "phyllotaxis_probability": short_number(suggested.probability),
        "nodes": [*nodes.values()],
    }


def leaf_extras(leaf: LeafTraits) -> dict[str, Any]:
    """Describe a leaf, here and in scene.glb: id, unit, method, quality, and its numbers with standard deviations."""
    about = {"leaf": leaf.leaf, "unit": leaf.unit or None, "method": leaf.method, "use": leaf.use}
    return {**about, "quality": leaf.quality, **_split_numbers(leaf.numbers)}


def _split_numbers(numbers: Mapping[str, Measurement]) -> dict[str, Any]:
    there = {name: number for name, number in numbers.items() if number.exists}
    return {
        "traits": {name: short_number(number.value) for name, number in there.items()},
        "sd": {name: short_number(number.sd) for name, number in there.items() if np.isfinite(number.sd)},
    }
