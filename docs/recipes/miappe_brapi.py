"""The numbers of a batch by MIAPPE 1.1, one CSV table per section, or as BrAPI v2 observations, in JSON.

    python miappe_brapi.py miappe night/tables/traits.csv night-miappe --factors treatment
    python miappe_brapi.py brapi night/tables/traits.csv night-brapi.json

The output must not exist yet. Sections and fields are those of miappe-1.1.tsv beside this script, which is the
published checklist ("MIAPPE_Checklist-Data-Model-v1.1.tsv", github.com/MIAPPE/MIAPPE): section, field, how often. What
mvseg does not know (who, where, which species) is in columns of the batch's table that are named as the fields.
"""

from __future__ import annotations

import argparse
import csv
import json
import re
import sys
from collections.abc import Sequence
from datetime import datetime
from pathlib import Path

from mvseg.traits.ontology import DEFINITIONS

Row = dict[str, str]
CHECKLIST = [line.split("\t") for line in Path(__file__).with_name("miappe-1.1.tsv").read_text().splitlines()]
OWN_COLUMNS = {"leaf", "trait", "value", "sd", "unit", "method", "ontology", "unit_ontology"}
OF_PLANTS = ("investigation", "study", "person", "biological_material", "observation_unit")
STUDY, MATERIAL, UNIT = "Study unique ID", "Biological material ID", "Observation unit ID"
LINKS = {"investigation": (), "observed_variable": (), "observation_unit": (STUDY, MATERIAL)}  # to other tables
KNOWN = {
    "MIAPPE version": "1.1",
    STUDY: "study-1",
    "Observation unit description": "single plants, each photographed from several sides with calibrated cameras",
    "Observation unit type": "plant",
    "Data file link": "observations.csv",
    "Data file description": "CSV in UTF-8, one row per number; leaf: its number in this scene; sd: standard deviation",
    "Data file version": "1",
}


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("standard", choices=("miappe", "brapi"))
    parser.add_argument("traits", type=Path, help="tables/traits.csv in the --out of mvseg batch")
    parser.add_argument("out", type=Path, help="folder (miappe) or file (brapi) to write")
    parser.add_argument("--factors", default="", help="columns that are experimental factors: treatment,light")
    args = parser.parse_args(arguments)
    if not args.traits.is_file():
        sys.exit(f"{args.traits}: no such file, expected tables/traits.csv of a batch")
    with args.traits.open(newline="", encoding="utf-8") as file:
        table = csv.DictReader(file)
        if not {"scene", "plant", "time", *OWN_COLUMNS} <= set(table.fieldnames or ()):
            sys.exit(f"{args.traits}: is not tables/traits.csv of a batch")
        rows = [row for row in table if row["value"]]
    if not rows:
        sys.exit(f"{args.traits}: holds no numbers")
    if args.out.exists():
        sys.exit(f"{args.out}: exists already, expected a new name")
    if args.standard == "brapi":
        args.out.write_text(json.dumps(brapi_answer(rows), indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
        return
    tables = miappe_tables(rows, [name.strip() for name in args.factors.split(",") if name.strip()])
    args.out.mkdir(parents=True)
    for section, table in tables.items():
        with (args.out / f"{section}.csv").open("x", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, list(table[0]), lineterminator="\n")
            writer.writeheader()
            writer.writerows(table)


def variable(row: Row) -> str:
    """What is observed, by which method, in which scale: leaf_area_mvseg_mm2."""
    return f"{'leaf_' if row['leaf'] else ''}{row['trait']}_mvseg_{re.sub(r'[^0-9A-Za-z]', '', row['unit'])}"


def title(row: Row) -> str:
    return f"{'leaf ' if row['leaf'] else ''}{row['trait'].replace('_', ' ')}"


def time_stamp(row: Row) -> str:
    """ISO 8601 with a time zone (UTC if `time` names none); "" if `time` is no date."""
    try:
        time = datetime.fromisoformat(row["time"])
    except ValueError:
        return ""
    return time.isoformat() + ("" if time.tzinfo else "Z")


def brapi_answer(rows: Sequence[Row]) -> dict[str, object]:
    """What GET /observations answers; POST takes its result.data. All values are text, as BrAPI requires."""
    data = []
    for row in rows:
        said = {name.casefold(): cell for name, cell in row.items()}
        rest = ("scene", "leaf", "sd", "unit", "method", "ontology", "unit_ontology")  # BrAPI has no keys for them
        more = {name: row[name] for name in rest}
        known = {"observationTimeStamp": time_stamp(row), "studyDbId": said.get(STUDY.casefold(), "")}
        known["germplasmDbId"] = said.get(MATERIAL.casefold(), "")
        data.append({
            "observationDbId": f"{row['scene']}:{row['leaf'] or 'plant'}:{row['trait']}",
            "observationUnitDbId": row["plant"], "observationUnitName": row["plant"],
            "observationVariableDbId": variable(row), "observationVariableName": title(row),
            "value": row["value"], "collector": "mvseg",
            **{name: text for name, text in known.items() if text},
            "additionalInfo": {name: text for name, text in (more | {"time": row["time"]}).items() if text},
        })  # fmt: skip
    pages = {"currentPage": 0, "pageSize": len(data), "totalCount": len(data), "totalPages": 1}
    metadata = {"datafiles": [], "pagination": pages, "status": []}
    context = ["https://brapi.org/jsonld/context/metadata.jsonld"]
    return {"@context": context, "metadata": metadata, "result": {"data": data}}


def miappe_tables(rows: Sequence[Row], factors: Sequence[str]) -> dict[str, list[Row]]:
    """{section: its table}; exits where a required field is empty, or one thing is described in two ways."""
    absent = [factor for factor in factors if factor not in rows[0]]
    if absent:
        sys.exit(f"--factors: the table has no column '{absent[0]}', found {', '.join(rows[0])}")
    plants = [describe_plant(row, factors) for row in rows]
    missing = [
        field for section, field, count in CHECKLIST
        if section in OF_PLANTS and count[0] != "0" and not all(plant.get(field) for plant in plants)
    ]  # fmt: skip
    if missing:
        what = f"MIAPPE requires, in every row, {', '.join(missing)}; expected columns of the batch's table"
        sys.exit(f"{what}, which mvseg batch --resume true copies")
    tables = {section: make_table(section, plants) for section in (*OF_PLANTS, "data_file")}
    for section, key in (("investigation", "MIAPPE version"), ("study", STUDY), ("observation_unit", UNIT)):
        first: dict[str, Row] = {}
        for row in tables[section]:
            other = first.setdefault(row[key], row)
            for field in row:
                if row[field] != other[field]:
                    sys.exit(f"{field} is '{other[field]}' and '{row[field]}' for one {section} ({row[key]})")
    if factors:
        tables["experimental_factor"] = make_table("experimental_factor", describe_factors(plants, factors))
    tables["observed_variable"] = make_table("observed_variable", [describe_variable(row) for row in rows])
    tables["observations"] = [
        {UNIT: row["plant"], "scene": row["scene"], "time": row["time"], "leaf": row["leaf"],
         "Variable ID": variable(row), "value": row["value"], "sd": row["sd"], "method": row["method"]}
        for row in rows
    ]  # fmt: skip
    return tables


def make_table(section: str, facts: Sequence[Row]) -> list[Row]:
    """Each row once; empty columns are left out unless they are required."""
    fields = {field: count for name, field, count in CHECKLIST if name == section}
    fields = dict.fromkeys(LINKS.get(section, (STUDY,)), "1") | fields
    kept = [name for name, count in fields.items() if count[0] != "0" or any(each.get(name) for each in facts)]
    rows = dict.fromkeys(tuple(each.get(name, "") for name in kept) for each in facts)
    return [dict(zip(kept, row, strict=True)) for row in rows]


def describe_plant(row: Row, factors: Sequence[str]) -> Row:
    """By the checklist's names; the case of the table's columns is ignored."""
    said = {name.casefold(): cell for name, cell in row.items() if name not in OWN_COLUMNS and cell}
    facts = KNOWN | {field: said[field.casefold()] for _, field, _ in CHECKLIST if field.casefold() in said}
    if factors:
        facts["Observation Unit factor value"] = "; ".join(f"{factor}:{row[factor]}" for factor in factors)
    return facts | {UNIT: row["plant"]} | {factor: row[factor] for factor in factors}


def describe_factors(plants: Sequence[Row], factors: Sequence[str]) -> list[Row]:
    found = []
    for study in dict.fromkeys(plant[STUDY] for plant in plants):
        for factor in factors:
            values = list(dict.fromkeys(plant[factor] for plant in plants if plant[STUDY] == study))
            if len(values) < 2 or not all(values):
                sys.exit(f"--factors: '{factor}' is {', '.join(values)} for all plants, expected two values or more")
            factor_values = "; ".join(values)
            found.append(
                {STUDY: study, "Experimental Factor type": factor, "Experimental Factor values": factor_values}
            )
    return found


def describe_variable(row: Row) -> Row:
    return {
        "Variable ID": variable(row),
        "Variable name": title(row),
        "Trait": title(row),
        "Trait accession number": row["ontology"],
        "Method": "mvseg: multi-view photos, surfaces of leaves",
        "Method description": f"of {'one leaf' if row['leaf'] else 'the plant'}: {DEFINITIONS[row['trait']].meaning}",
        "Scale": row["unit"],
    }


if __name__ == "__main__":
    main()
