"""Traits as tables that pandas and spreadsheets open, see `write_table`."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from itertools import chain, zip_longest
from pathlib import Path
from types import MappingProxyType

from mvseg.errors import InputError
from mvseg.formats.text_file import read_table, write_table
from mvseg.traits.filters import Rejection
from mvseg.traits.leaf import Measurement, missing
from mvseg.traits.measure import LeafTraits, Traits
from mvseg.traits.ontology import DEFINITIONS, LEAF_TRAITS, UNIT_ACCESSIONS, UNKNOWN_UNIT, VOXEL_TRAITS, unit_of

COLUMNS = ("plant", "leaf", "trait", "value", "sd", "unit", "method", "ontology", "unit_ontology")
MOST_BYTES = 1 << 30  # of a table that is read
VOXEL_NAMES = {trait.name for trait in VOXEL_TRAITS}
GOOD, REJECTED = "good", "rejected: "


def write_long(path: Path, traits: Traits) -> None:
    """One row per trait: those of the plant, whose leaf is empty, then those of each leaf.

    In the row of a missing number, `method` is the reason. Leaves without voxels have no rows for these.
    """
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


def write_wide(path: Path, traits: Traits, probabilities: Mapping[int, float] = MappingProxyType({})) -> None:
    """One row per leaf: plant, leaf, each trait with its standard deviation beside it, the unit of lengths, the method,
    the quality ("good", or the reasons to doubt the numbers), and how likely it is a leaf, where the views chose it."""
    rows = []
    for leaf in traits.leaves:
        numbers: list[float] = []
        for trait in LEAF_TRAITS:
            number = leaf.numbers[trait.name]
            numbers += [number.value, number.sd] if trait.has_sd else [number.value]
        texts = traits.unit or UNKNOWN_UNIT, leaf.method, "; ".join(leaf.reasons) or GOOD
        rows.append((traits.plant, leaf.leaf, *numbers, *texts, probabilities.get(leaf.leaf)))
    write_table(path, wide_columns(), rows)


def wide_columns() -> list[str]:
    """The columns of `write_wide`."""
    pairs = [[trait.name, f"{trait.name}_sd"] if trait.has_sd else [trait.name] for trait in LEAF_TRAITS]
    return ["plant", "leaf", *chain.from_iterable(pairs), "unit", "method", "quality", "probability"]


def read_traits(
    long: Path, wide: Path, *, plant: str, unit: str, up: tuple[float, float, float] | None
) -> Traits:
    """The traits that `write_long` and `write_wide` wrote, with six digits; what the tables do not say is given.

    Raises:
        InputError: these are no such tables.
    """
    numbers: dict[int, dict[str, Measurement]] = {0: {}}
    try:
        for row in read_csv(long, COLUMNS):
            value, sd = float(row["value"] or "nan"), float(row["sd"] or "nan")
            numbers.setdefault(int(row["leaf"] or 0), {})[row["trait"]] = Measurement(value, sd, row["method"])
        leaves = [
            _read_leaf(int(row["leaf"]), row, numbers[int(row["leaf"])])
            for row in read_csv(wide, ("leaf", "method", "quality"))
        ]
    except (KeyError, ValueError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{long}: is no table of traits that mvseg wrote ({error})") from None
    whole = {name: number for name, number in numbers[0].items() if name in DEFINITIONS}  # others are of older versions
    return Traits(plant=plant, unit=unit, leaves=tuple(leaves), whole=whole, up=up)


def _read_leaf(leaf: int, row: Mapping[str, str], numbers: Mapping[str, Measurement]) -> LeafTraits:
    reasons = () if row["quality"] == GOOD else tuple(row["quality"].split("; "))
    rejection = None
    if reasons and reasons[0].startswith(REJECTED):
        rejection = Rejection.of(reasons[0].removeprefix(REJECTED))
    absent = {name: missing("has no voxels") for name in VOXEL_NAMES}  # the only ones that have no row then
    return LeafTraits(
        leaf=leaf,
        numbers={trait.name: {**absent, **numbers}[trait.name] for trait in LEAF_TRAITS},
        method=row["method"],
        reasons=reasons,
        rejection=rejection,
    )


def read_csv(path: Path, columns: Collection[str] = ()) -> list[dict[str, str]]:
    """The rows of a table that `write_table` wrote, with these columns and perhaps others, as text.

    Raises:
        InputError: it cannot be read, or has no such column.
    """
    (_, found), *rows = read_table(path, "a table that mvseg wrote", most=MOST_BYTES) or [(0, [])]
    missing_ones = [column for column in columns if column not in found]
    if missing_ones:
        raise InputError(f"{path}: has no column '{missing_ones[0]}', expected a table that mvseg wrote")
    return [dict(zip_longest(found, cells[: len(found)], fillvalue="")) for _, cells in rows]
