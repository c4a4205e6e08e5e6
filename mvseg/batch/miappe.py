"""The traits of a batch by MIAPPE 1.1, the minimum information about a plant phenotyping experiment: a table for each
section of its checklist, with the checklist's own names as columns.

What mvseg does not know (who, where, which species) comes from columns of the batch's table that are named as in the
checklist: "Study title", "Organism", ... Leaves are below the level of observation units, which are plants: their
numbers are observations of the plant, with variables of single leaves.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from mvseg.batch.observations import Observation
from mvseg.errors import InputError
from mvseg.traits.ontology import DEFINITIONS

DATA_FILE = "observations.csv"
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
Table = list[dict[str, str]]  # one row or more of {column: cell}


def describe_batch(observations: Sequence[Observation], factors: Sequence[str] = ()) -> dict[str, Table]:
    """{name of a file, without suffix: table} of a batch with one observation or more; `factors` are columns of the
    batch's table that are experimental factors.

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
    return tables | {"observations": [_numbers(each) for each in observations]}


def _fields(section: str) -> dict[str, bool]:
    """{field of a section: it must be there}."""
    return {field.rstrip("*"): field.endswith("*") for field in FIELDS[section].split("|")}


def _complete(plant: Mapping[str, str], factors: Sequence[str]) -> dict[str, str]:
    """What is known of a plant, by the checklist's names; the case of the table's columns is ignored."""
    said = {name.casefold(): cell for name, cell in plant.items() if cell}
    names = {name for section in FIELDS for name in _fields(section)}
    facts = KNOWN | {name: said[name.casefold()] for name in names if name.casefold() in said}
    if factors:
        facts["Observation Unit factor value"] = "; ".join(f"{factor}:{plant[factor]}" for factor in factors)
    return facts | {UNIT: plant["plant"]} | {factor: plant[factor] for factor in factors}


def _missing(facts: Sequence[Mapping[str, str]]) -> list[str]:
    """Required fields that are not filled for every plant."""
    sections = ("investigation", "study", "person", "biological_material", "observation_unit")
    needed = dict.fromkeys(name for section in sections for name, is_needed in _fields(section).items() if is_needed)
    return [name for name in needed if not all(each.get(name) for each in facts)]


def _table(section: str, facts: Sequence[Mapping[str, str]]) -> Table:
    """Each row once; empty columns are left out unless they are required."""
    kept = [name for name, is_needed in _fields(section).items() if is_needed or any(each.get(name) for each in facts)]
    rows = dict.fromkeys(tuple(each.get(name, "") for name in kept) for each in facts)
    return [dict(zip(kept, row, strict=True)) for row in rows]


def _check_once(table: Table, key: str, one: str = "") -> None:
    """Raises InputError where two rows describe the same thing differently; `one` is what there may be one of only."""
    seen: dict[str, Mapping[str, str]] = {}
    for row in table:
        other = seen.setdefault(one or row[key], row)
        if other is not row:
            column = next(name for name in row if row[name] != other[name])
            what = f"{column} is '{other[column]}' and '{row[column]}'"
            whose = one or f"{key} ({row[key]})"
            raise InputError(f"the batch's table: {what} for one {whose}, expected one of them")


def _factor_facts(facts: Sequence[Mapping[str, str]], factors: Sequence[str]) -> Table:
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


def _variables(observations: Sequence[Observation]) -> Table:
    return [
        {
            "Variable ID": each.variable,
            "Variable name": each.title,
            "Trait": each.title,
            "Trait accession number": each.ontology,
            "Method": "mvseg: multi-view photos, surfaces of leaves",
            "Method description": f"of {'one leaf' if each.leaf else 'the plant'}: {DEFINITIONS[each.trait].meaning}",
            "Scale": each.unit,
            "Time scale": "Date/Time" if each.time_stamp else "",
        }
        for each in {each.variable: each for each in observations}.values()
    ]


def _numbers(each: Observation) -> dict[str, str]:
    facts = {UNIT: each.facts["plant"], "scene": each.facts["scene"], "time": each.facts["time"], "leaf": each.leaf}
    return facts | {"Variable ID": each.variable, "value": each.value, "sd": each.sd, "method": each.method}
