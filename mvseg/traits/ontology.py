"""The names of the traits, what they mean and in which unit; docs/traits.md has the formulas.

Accessions of traits are of the Plant Trait Ontology (TO), those of units of the Units of Measurement Ontology (UO);
"" where none is for exactly this.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Kind = Literal["length", "area", "volume", "degree", "1"]


@dataclass(frozen=True)
class Definition:
    """One trait. `kind` is what its unit is made of, "1" for counts, shares and ratios; `ontology` the accession, ""
    without one; `has_sd` says whether there is a standard deviation (and a column for it)."""

    name: str
    kind: Kind
    meaning: str
    ontology: str = ""
    has_sd: bool = True


def _counted(name: str, meaning: str, ontology: str = "") -> Definition:
    return Definition(name, "1", meaning, ontology, has_sd=False)


SURFACE_TRAITS = (
    Definition("area", "area", "one side of the blade", "TO:0000540"),
    Definition("length", "length", "along the midrib from base to tip", "TO:0000135"),
    Definition("width", "length", "along the surface from edge to edge, at the widest place", "TO:0000370"),
    Definition("length_width_ratio", "1", "length / width"),
    Definition("inclination", "degree", "between the mean normal and up: 0 = horizontal blade, 90 = vertical"),
    Definition("base_inclination", "degree", "of the midrib at the base against the horizontal, positive = rising"),
    Definition("tip_inclination", "degree", "of the midrib at the tip against the horizontal, positive = rising"),
    Definition("azimuth", "degree", "direction from base to tip, counterclockwise seen from above, in [0, 360)"),
    Definition("insertion_height", "length", "of the base above the lowest point of all measured leaves"),
    Definition("insertion_angle", "degree", "between the midrib at the base and the stem, or up", "TO:0000206"),
    Definition("curvature", "degree", "between the midrib's directions at base and tip: 0 = straight"),
    Definition("fold_angle", "degree", "between the two halves of the blade at mid length: 180 = flat"),
)
NODE_TRAITS = (Definition("node_height", "length", "of its node, along the stem, from the lowest one"),)
SEEN_TRAITS = (
    _counted("visible_share", "share of the surface's projections that the leaf's own masks cover"),
    Definition("mean_red", "1", "mean red of the surely seen pixels, 0 to 1"),
    Definition("mean_green", "1", "mean green of the surely seen pixels, 0 to 1"),
    Definition("mean_blue", "1", "mean blue of the surely seen pixels, 0 to 1"),
    Definition("greenness_index", "1", "green leaf index (2G - R - B) / (2G + R + B), -1 to 1"),
    Definition("senescent_share", "1", "share of its sure pixels whose hue is below 60 degrees: yellow, brown or red"),
    Definition("hue", "degree", "hue of its mean colour, 0 red, 60 yellow, 120 green"),
)
VOXEL_TRAITS = (
    Definition("volume", "volume", "of the occupied voxels", has_sd=False),
    *(
        Definition(f"{axis}_{end}", "length", f"{word} {axis} of the voxels in the world", has_sd=False)
        for end, word in (("min", "least"), ("max", "largest"))
        for axis in "xyz"
    ),
    _counted("num_pieces", "connected components of the voxels"),
)
COUNTED_TRAITS = (
    _counted("num_views", "views with a mask of the leaf"),
    _counted("sure_views", "views with a sure match"),
    _counted("iou", "median IoU of the surface with the leaf's masks"),
)
LEAF_TRAITS = (*SURFACE_TRAITS, *NODE_TRAITS, *SEEN_TRAITS, *VOXEL_TRAITS, *COUNTED_TRAITS)
PLANT_TRAITS = (
    _counted("number_of_leaves", "instances that are not rejected", "TO:0000241"),
    Definition("total_leaf_area", "area", "of the leaves that have a surface; the method says how many have none"),
    Definition("height", "length", "from the lowest to the highest point of the leaves", "TO:0000207"),
    Definition("convex_hull_volume", "volume", "of the convex hull of the leaves"),
)
DEFINITIONS = {definition.name: definition for definition in (*LEAF_TRAITS, *PLANT_TRAITS)}
POWERS = {"length": "", "area": "^2", "volume": "^3"}
UNKNOWN_UNIT = "world unit"  # where the cameras do not say what their lengths are
UNIT_ACCESSIONS = {
    "m": "UO:0000008", "cm": "UO:0000015", "mm": "UO:0000016", "um": "UO:0000017", "µm": "UO:0000017",
    "m^2": "UO:0000080", "cm^2": "UO:0000081", "mm^2": "UO:0000082",
    "m^3": "UO:0000096", "cm^3": "UO:0000097", "dm^3": "UO:0000100",
    "degree": "UO:0000185", "1": "UO:0000186",
}  # fmt: skip


def unit_of(kind: Kind, unit: str) -> str:
    """The unit of a kind of number in a world whose lengths are in `unit`; "" is the unknown one."""
    return (unit or UNKNOWN_UNIT) + POWERS[kind] if kind in POWERS else kind
