"""Traits as tables that pandas and spreadsheets open, see `write_table`."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from itertools import zip_longest
from pathlib import Path
from types import MappingProxyType

import numpy as np

from mvseg.errors import InputError
from mvseg.formats.text_file import read_table, write_table
from mvseg.reconstruction.stem.stem_axis import StemAxis
from mvseg.traits.filters import Kind
from mvseg.traits.leaf import Measurement, missing
from mvseg.traits.measure import GOOD, LeafTraits, Traits, UpFrom
from mvseg.traits.nodes import NODE_COLUMNS, NODE_NUMBERS, Node, Phyllotaxis, Stem
from mvseg.traits.ontology import DEFINITIONS, LEAF_TRAITS, UNIT_ACCESSIONS, VOXEL_TRAITS, unit_of

COLUMNS = ("plant", "leaf", "trait", "value", "sd", "unit", "method", "ontology", "unit_ontology")
MOST_BYTES = 1 << 30  # limit: of a table that is read
VOXEL_NAMES = {trait.name for trait in VOXEL_TRAITS}


def write_long(path: Path, traits: Traits) -> None:
    """Write one row per trait: those of the plant, whose leaf is empty, then those of each leaf. In the row of a
    missing number, `method` is the reason. Leaves without voxels have no rows for these."""
    rows = []
    tables: list[tuple[str | int, Mapping[str, Measurement]]] = [("", traits.whole)]
    for leaf, numbers in [*tables, *((leaf.leaf, leaf.numbers) for leaf in traits.leaves)]:
        for name, number in numbers.items():
            if number.exists or name not in VOXEL_NAMES:
                trait = DEFINITIONS[name]
                unit = unit_of(trait.kind, traits.unit)
                about = unit, number.method, trait.ontology, UNIT_ACCESSIONS.get(unit, "")
                rows.append((traits.plant, leaf, name, number.value, number.sd, *about))
    write_table(path, COLUMNS, rows)


def write_wide(path: Path, traits: Traits) -> None:
    """One row per leaf, see `Traits.table`."""
    columns = traits.table()
    write_table(path, list(columns), list(zip(*columns.values(), strict=True)))


def write_nodes(path: Path, traits: Traits) -> None:
    """One row per leaf of a stem, see `Traits.node_table`."""
    columns = traits.node_table()
    write_table(path, list(columns), list(zip(*columns.values(), strict=True)))


def read_nodes(path: Path) -> tuple[Stem, ...]:
    """The stems that `write_nodes` wrote, with straight axes from node to node; none of an older version, which counted
    nodes otherwise. Raises InputError for another table."""
    nodes: dict[int, list[Node]] = {}
    about: dict[int, tuple[str, float, Phyllotaxis]] = {}
    table = [row for row in read_csv(path, NODE_COLUMNS[:3]) if "leaves_per_node" in row]
    try:
        for row in table:
            numbers = {
                name: Measurement(_number(row[name]), _number(row[f"{name}_sd"]), row["source"])
                for name in NODE_NUMBERS
            }
            place = _number(row["x"]), _number(row["y"]), _number(row["z"])
            base = _number(row["base_x"]), _number(row["base_y"]), _number(row["base_z"])
            stem, number, leaf, rank = (int(row[name]) for name in ("stem", "node", "leaf", "rank"))
            node = Node(number, int(row["leaves_per_node"]), rank, leaf, place, base, **numbers)
            nodes.setdefault(stem, []).append(node)
            angle, probability = _number(row["phyllotaxis_angle"]), _number(row["phyllotaxis_probability"])
            likely = _number(row["stem_probability"])
            about[stem] = row["source"], likely, Phyllotaxis(row["phyllotaxis"], angle, probability)
    except (KeyError, ValueError) as error:
        raise InputError(f"{path}: is no table of nodes that mvseg wrote ({error})") from None
    stems = []
    for number, rows in nodes.items():
        (source, probability, phyllotaxis), axis = about[number], StemAxis.along(np.array([row.place for row in rows]))
        stems.append(Stem(number, axis, source, tuple(rows), phyllotaxis, probability))
    return tuple(stems)


def _number(text: str) -> float:
    return float(text or "nan")


def wide_columns() -> list[str]:
    """The columns of `write_wide`."""
    return [*Traits(plant="", unit="", leaves=(), whole={}, up=None).table()]


def read_traits(
    long: Path,
    wide: Path,
    nodes: Path | None = None,
    *,
    plant: str,
    unit: str,
    up: tuple[float, float, float] | None,
    up_from: UpFrom = "",
    rejected: Mapping[int, Kind] = MappingProxyType({}),
) -> Traits:
    """The traits that `write_long`, `write_wide` and `write_nodes` wrote, with six digits; what the tables do not say
    is given, as {leaf: kind of its rejection}. Raises InputError if these are no such tables."""
    numbers: dict[int, dict[str, Measurement]] = {0: {}}
    try:
        for row in read_csv(long, COLUMNS[:7]):  # ontologies are for readers of tables
            value, sd = float(row["value"] or "nan"), float(row["sd"] or "nan")
            numbers.setdefault(int(row["leaf"] or 0), {})[row["trait"]] = Measurement(value, sd, row["method"])
        leaves = [
            _read_leaf(int(row["leaf"]), row, numbers[int(row["leaf"])], rejected.get(int(row["leaf"])), unit=unit)
            for row in read_csv(wide, ("leaf", "method", "quality"))
        ]
    except (KeyError, ValueError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{long}: is no table of traits that mvseg wrote ({error})") from None
    whole = {name: number for name, number in numbers[0].items() if name in DEFINITIONS}  # others are of older versions
    stems = () if nodes is None else read_nodes(nodes)
    return Traits(plant=plant, unit=unit, leaves=tuple(leaves), whole=whole, up=up, stems=stems, up_from=up_from)


def _read_leaf(
    leaf: int, row: Mapping[str, str], numbers: dict[str, Measurement], rejection: Kind | None, *, unit: str
) -> LeafTraits:
    texts = [] if row["quality"] == GOOD else row["quality"].split("; ")
    codes = row["doubts"].split("; ") if "doubts" in row else texts  # an older version has none
    # where there are no voxels, and in tables of older versions, some have no row
    numbers = dict.fromkeys(VOXEL_NAMES, missing("has no voxels")) | numbers
    of_trait = {trait.name: numbers.get(trait.name, missing("of an older version")) for trait in LEAF_TRAITS}
    reasons, chance = dict(zip(codes, texts, strict=False)), row.get("probability")
    probability = float(chance) if chance else None
    return LeafTraits(leaf, of_trait, row["method"], reasons, rejection, unit=unit, probability=probability)


def read_csv(path: Path, columns: Collection[str] = ()) -> list[dict[str, str]]:
    """The rows of a table that `write_table` wrote, with these columns and perhaps others, as text. Raises InputError
    if it cannot be read, or has no such column."""
    (_, header), *rows = read_table(path, "a table that mvseg wrote", most=MOST_BYTES) or [(0, [])]
    missing_ones = [column for column in columns if column not in header]
    if missing_ones:
        raise InputError(f"{path}: has no column '{missing_ones[0]}', expected a table that mvseg wrote")
    return [dict(zip_longest(header, cells[: len(header)], fillvalue="")) for _, cells in rows]
