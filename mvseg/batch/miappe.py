"""The traits of a batch by MIAPPE 1.1, the minimum information about a plant phenotyping experiment: a table for each
section of its checklist, with the checklist's own names as columns.

What mvseg does not know (who, where, which species) comes from columns of the batch's table that are named as in the
checklist: "Study title", "Organism", ... Leaves are below the level of observation units, which are plants: their
numbers are observations of the plant, with variables of single leaves.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from mvseg.batch.observations import Observation
from mvseg.errors import InputError
from mvseg.traits.ontology import DEFINITIONS

DATA_FILE = "observations.csv"
DATA_COLUMNS = ("Observation unit ID", "scene", "time", "leaf", "Variable ID", "value", "sd", "method")
STUDY, UNIT = "Study unique ID", "Observation unit ID"
DATA_ABOUT = "CSV in UTF-8, one row per number; leaf: number of the leaf in this scene; sd: standard deviation"
UNIT_ABOUT = "single plants, each photographed from several sides with calibrated cameras"

# The checklist's fields by table; a star: one that must be there. The id of the study links the tables.
FIELDS = {
    "investigation": "Investigation unique ID|Investigation title*|Investigation description|Submission date|"
    "Public release date|License|MIAPPE version*|Associated publication",
    "study": "Study unique ID|Study title*|Study description|Start date of study*|End date of study|"
    "Contact institution*|Geographic location (country)*|Experimental site name*|Geographic location (latitude)|"
    "Geographic location (longitude)|Geographic location (altitude)|Description of the experimental design*|"
    "Type of experimental design|Observation unit level hierarchy|Observation unit description*|"
    "Description of growth facility*|Type of growth facility|Cultural practices|Map of experimental design",
    "person": "Study unique ID|Person name*|Person email|Person ID|Person role*|Person affiliation*",
    "data_file": "Study unique ID|Data file link*|Data file description*|Data file version*",
    "biological_material": "Study unique ID|Biological material ID*|Organism*|Genus|Species|Infraspecific name|"
    "Biological material preprocessing|Material source ID (Holding institute/stock centre, accession)|"
    "Material source DOI|Material source description",
    "observation_unit": "Study unique ID|Biological material ID*|Observation unit ID*|Observation unit type*|"
    "External ID|Spatial distribution|Observation Unit factor value",
    "experimental_factor": "Study unique ID|Experimental Factor type*|Experimental Factor description|"
    "Experimental Factor values*",
    "observed_variable": "Study unique ID|Variable ID*|Variable name|Variable accession number|Trait*|"
    "Trait accession number|Method*|Method accession number|Method description|Reference associated to the method|"
    "Scale*|Scale accession number|Time scale",
}
KNOWN = {
    "MIAPPE version": "1.1",
    STUDY: "study-1",
    "Observation unit description": UNIT_ABOUT,
    "Observation unit type": "plant",
    "Data file link": DATA_FILE,
    "Data file description": DATA_ABOUT,
    "Data file version": "1",
}


@dataclass(frozen=True)
class Table:
    """One table: its columns, and its rows as text."""

    columns: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


def describe_batch(observations: Sequence[Observation], factors: Sequence[str] = ()) -> dict[str, Table]:
    """{name of a file, without suffix: table} of a batch.

    Args:
        observations: one or more.
        factors: columns of the batch's table that are experimental factors.

    Raises:
        InputError: the batch's table lacks what MIAPPE requires (the sentence names all of it); it has no column of
            a factor, a factor with one value, several investigations, or two descriptions of one plant.
    """
    plants = list({tuple(each.facts.items()): each.facts for each in observations}.values())
    for factor in factors:
        if factor not in plants[0]:
            raise InputError(f"--factors: the batch's table has no column '{factor}', found {', '.join(plants[0])}")
    facts = [_complete(plant, factors) for plant in plants]
    missing = _missing(facts)
    if missing:
        what = "the batch's table lacks what MIAPPE requires, expected a column for each, filled in every row"
        raise InputError(f"{what}: {', '.join(missing)}; mvseg batch --resume true copies them")
    sections = ("investigation", "study", "person", "data_file", "biological_material", "observation_unit")
    tables = {section: _table(section, facts) for section in sections}
    _check_once(tables["investigation"], "Investigation title", one="investigation")
    _check_once(tables["study"], STUDY)
    _check_once(tables["observation_unit"], UNIT)
    if factors:
        tables["experimental_factor"] = _table("experimental_factor", _factor_facts(facts, factors))
    tables["observed_variable"] = _table("observed_variable", _variables(observations))
    return tables | {"observations": _data_table(observations)}


def _columns(section: str) -> tuple[str, ...]:
    return tuple(field.rstrip("*") for field in FIELDS[section].split("|"))


def _needed(section: str) -> list[bool]:
    return [field.endswith("*") for field in FIELDS[section].split("|")]


def _complete(plant: Mapping[str, str], factors: Sequence[str]) -> dict[str, str]:
    """What is known of a plant, by the checklist's names; the case of the table's columns is ignored."""
    said = {name.casefold(): cell for name, cell in plant.items() if cell}
    names = {name for section in FIELDS for name in _columns(section)}
    facts = KNOWN | {name: said[name.casefold()] for name in names if name.casefold() in said}
    values = "; ".join(f"{factor}:{plant[factor]}" for factor in factors)
    return facts | {UNIT: plant["plant"]} | ({"Observation Unit factor value": values} if values else {}) | {
        factor: plant[factor] for factor in factors
    }  # fmt: skip


def _missing(facts: Sequence[Mapping[str, str]]) -> list[str]:
    """Required fields that are not filled for every plant."""
    sections = ("investigation", "study", "person", "biological_material", "observation_unit")
    fields = [pair for section in sections for pair in zip(_columns(section), _needed(section), strict=True)]
    needed = dict.fromkeys(name for name, is_needed in fields if is_needed)
    return [name for name in needed if not all(each.get(name) for each in facts)]


def _table(section: str, facts: Iterable[Mapping[str, str]]) -> Table:
    """Each row once; empty columns are left out unless they are required."""
    columns, needed = _columns(section), _needed(section)
    rows = dict.fromkeys(tuple(each.get(name, "") for name in columns) for each in facts)
    kept = [index for index in range(len(columns)) if needed[index] or any(row[index] for row in rows)]
    return Table(
        columns=tuple(columns[index] for index in kept), rows=tuple(tuple(row[index] for index in kept) for row in rows)
    )


def _check_once(table: Table, key: str, one: str = "") -> None:
    """Raises InputError where two rows describe the same thing differently; `one` is what there may be one of only."""
    index = table.columns.index(key)
    seen: dict[str, tuple[str, ...]] = {}
    for row in table.rows:
        other = seen.setdefault(one or row[index], row)
        if other is not row:
            place = next(column for column, pair in enumerate(zip(row, other, strict=True)) if pair[0] != pair[1])
            what = f"{table.columns[place]} is '{other[place]}' and '{row[place]}'"
            whose = one or f"{key} ({row[index]})"
            raise InputError(f"the batch's table: {what} for one {whose}, expected one of them")


def _factor_facts(facts: Sequence[Mapping[str, str]], factors: Sequence[str]) -> list[dict[str, str]]:
    rows = []
    for factor in factors:
        for study in dict.fromkeys(each[STUDY] for each in facts):
            values = list(dict.fromkeys(each[factor] for each in facts if each[STUDY] == study))
            if len(values) < 2 or not all(values):
                found = ", ".join(value or "nothing" for value in values)
                raise InputError(f"--factors: '{factor}' is {found} for all plants, expected two values or more")
            rows.append(
                {STUDY: study, "Experimental Factor type": factor, "Experimental Factor values": "; ".join(values)}
            )
    return rows


def _variables(observations: Sequence[Observation]) -> list[dict[str, str]]:
    rows = []
    for each in {each.variable: each for each in observations}.values():
        definition = DEFINITIONS[each.trait]
        whose = "of one leaf: " if each.leaf else "of the plant: "
        rows.append(
            {
                "Variable ID": each.variable,
                "Variable name": f"{'leaf ' if each.leaf else ''}{each.trait.replace('_', ' ')}",
                "Trait": f"{'leaf ' if each.leaf else ''}{each.trait.replace('_', ' ')}",
                "Trait accession number": each.ontology,
                "Method": "mvseg: multi-view photos, surfaces of leaves",
                "Method description": whose + definition.meaning,
                "Scale": each.unit,
                "Time scale": "Date/Time" if each.time_stamp else "",
            }
        )
    return rows


def _data_table(observations: Sequence[Observation]) -> Table:
    rows = tuple(
        (
            each.facts["plant"], each.facts["scene"], each.facts["time"], each.leaf,
            each.variable, each.value, each.sd, each.method,
        )
        for each in observations
    )  # fmt: skip
    return Table(columns=DATA_COLUMNS, rows=rows)
