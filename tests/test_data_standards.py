"""The recipe for MIAPPE and BrAPI: against the published checklist and the published schema."""

from __future__ import annotations

import csv
import json
import re
import runpy
import subprocess
import sys
from datetime import datetime
from pathlib import Path

import pytest

from csv_rows import read_rows
from mvseg.traits.ontology import DEFINITIONS

RECIPE = Path(__file__).parent.parent / "docs" / "recipes" / "miappe_brapi.py"
convert = runpy.run_path(str(RECIPE))["main"]
# section, field, cardinality: the rows of "MIAPPE_Checklist-Data-Model-v1.1.tsv" (github.com/MIAPPE/MIAPPE)
CHECKLIST = [line.split("\t") for line in RECIPE.with_name("miappe-1.1.tsv").read_text().splitlines()]
LINKS = {"Study unique ID", "Biological material ID"}  # to another table, in any table
FACTS = {
    "Investigation title": "Drought in basil",
    "Study title": "Basil, spring 2026",
    "Start date of study": "2026-04-01",
    "Contact institution": "A university, Town",
    "Geographic location (country)": "FR",
    "Experimental site name": "Greenhouse 4",
    "Description of the experimental design": "complete block design",
    "Description of growth facility": "greenhouse",
    "Person name": "A. Person",
    "Person role": "data submitter",
    "Person affiliation": "A university",
    "biological material id": "cv. Genovese",  # capitals do not matter
    "Organism": "NCBI:39350",
    "Spatial distribution": "row:4",
}
NUMBERS = [
    ("", "number_of_leaves", "2", "", "1", "matching", "TO:0000241", "UO:0000186"),
    ("1", "area", "812.5", "3.1", "mm^2", "surface", "TO:0000540", "UO:0000082"),
    ("2", "area", "", "", "mm^2", "no credible surface", "TO:0000540", "UO:0000082"),
    ("2", "volume", "90", "", "mm^3", "voxels", "", ""),
]
# BrAPI v2: the properties of Observation and ObservationNewRequest that are text
BRAPI_TEXT = {
    "observationDbId", "germplasmDbId", "germplasmName", "observationTimeStamp", "observationUnitDbId",
    "observationUnitName", "observationVariableDbId", "observationVariableName", "collector", "studyDbId",
    "uploadedBy", "value",
}  # fmt: skip


def write_traits(path: Path, rows: list[dict[str, str]]) -> Path:
    """The tables/traits.csv of a batch with the same numbers for each plant."""
    columns = [*rows[0], "leaf", "trait", "value", "sd", "unit", "method", "ontology", "unit_ontology"]
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerows([columns, *([*row.values(), *numbers] for row in rows for numbers in NUMBERS)])
    return path


def plants(**changes: str) -> list[dict[str, str]]:
    """The dry plant on two days, and a wet one; `changes` of the last row."""
    rows = [
        {"scene": "d1_p1", "plant": "p1", "time": "2026-05-01", "treatment": "dry"} | FACTS,
        {"scene": "d2_p1", "plant": "p1", "time": "2026-05-02T09:30", "treatment": "dry"} | FACTS,
        {"scene": "d1_p2", "plant": "p2", "time": "first day", "treatment": "wet"} | FACTS,
    ]
    return [*rows[:2], rows[2] | changes]


@pytest.fixture
def traits(tmp_path: Path) -> Path:
    return write_traits(tmp_path / "traits.csv", plants())


def test_the_tables_are_what_the_checklist_asks_for(traits: Path) -> None:
    out = traits.with_name("out")
    words = [sys.executable, "-W", "error", str(RECIPE), "miappe", str(traits), str(out), "--factors", "treatment"]
    subprocess.run(words, cwd=RECIPE.parents[2], check=True)
    sections = {section for section, *_ in CHECKLIST}
    assert {path.stem for path in out.iterdir()} == {*sections, "observations"}
    for section in sections:
        rows = read_rows(out / f"{section}.csv")
        known = {field: cardinality for name, field, cardinality in CHECKLIST if name == section}
        assert set(rows[0]) <= {*known, *LINKS}
        for field, cardinality in known.items():
            if cardinality[0] in "12":
                assert all(row[field] for row in rows), field
    assert [row["Observation unit ID"] for row in read_rows(out / "observation_unit.csv")] == ["p1", "p2"]
    (factor,) = read_rows(out / "experimental_factor.csv")
    assert factor["Experimental Factor values"] == "dry; wet"
    assert [row["Observation Unit factor value"] for row in read_rows(out / "observation_unit.csv")] == [
        "treatment:dry", "treatment:wet",
    ]  # fmt: skip
    assert len(read_rows(out / "biological_material.csv")) == 1


def test_every_number_has_its_unit_and_variable(traits: Path) -> None:
    out = traits.with_name("out")
    convert(["miappe", str(traits), str(out)])
    numbers = read_rows(out / "observations.csv")
    assert len(numbers) == 9  # the missing one is left out
    units = {row["Observation unit ID"] for row in read_rows(out / "observation_unit.csv")}
    variables = {row["Variable ID"]: row for row in read_rows(out / "observed_variable.csv")}
    assert len(variables) == len(read_rows(out / "observed_variable.csv")) == 3
    assert {row["Observation unit ID"] for row in numbers} == units
    assert {row["Variable ID"] for row in numbers} == variables.keys()
    assert variables["leaf_area_mvseg_mm2"]["Trait accession number"] == "TO:0000540"
    assert variables["leaf_area_mvseg_mm2"]["Scale"] == "mm^2"
    assert DEFINITIONS["area"].meaning in variables["leaf_area_mvseg_mm2"]["Method description"]
    assert (numbers[1]["leaf"], numbers[1]["value"], numbers[1]["sd"]) == ("1", "812.5", "3.1")
    assert not (out / "experimental_factor.csv").exists()


def test_brapi_observations_are_text_under_known_keys(traits: Path) -> None:
    convert(["brapi", str(traits), str(traits.with_name("night.json"))])
    answer = json.loads(traits.with_name("night.json").read_text())
    assert answer["metadata"]["pagination"]["totalCount"] == len(answer["result"]["data"]) == 9
    for observation in answer["result"]["data"]:
        more = observation.pop("additionalInfo")
        assert observation.keys() <= BRAPI_TEXT
        assert all(isinstance(text, str) for text in [*observation.values(), *more.values()])
    first, second, *_, last = answer["result"]["data"]
    assert len({each["observationDbId"] for each in answer["result"]["data"]}) == 9
    assert (first["value"], first["observationVariableDbId"]) == ("2", "number_of_leaves_mvseg_1")
    assert first["germplasmDbId"] == "cv. Genovese"
    assert datetime.fromisoformat(second["observationTimeStamp"]).isoformat() == "2026-05-01T00:00:00+00:00"
    assert "observationTimeStamp" not in last  # "first day" is no date


@pytest.mark.parametrize(
    ("changes", "factors", "facts"),
    [
        ({}, "light", "no column 'light', found scene, plant"),
        ({}, "Organism", "'Organism' is NCBI:39350 for all plants, expected two values"),
        ({"Organism": "", "Study title": ""}, "", "in every row, Study title, Organism; expected columns"),
        ({"Investigation title": "Another"}, "", "is 'Drought in basil' and 'Another' for one investigation"),
        ({"plant": "p1", "Spatial distribution": "row:5"}, "", "for one observation_unit (p1)"),
        ({"Study title": "Another"}, "", "for one study (study-1)"),
    ],
)
def test_wrong_tables_are_named(changes: dict[str, str], factors: str, facts: str, tmp_path: Path) -> None:
    traits = write_traits(tmp_path / "traits.csv", plants(**changes))
    with pytest.raises(SystemExit, match=re.escape(facts)):
        convert(["miappe", str(traits), str(tmp_path / "out"), "--factors", factors])
    assert not (tmp_path / "out").exists()


def test_what_is_no_batch_is_said(tmp_path: Path) -> None:
    (tmp_path / "other.csv").write_text("a,b\n1,2\n")
    for name, facts in (("other.csv", "is not tables/traits.csv of a batch"), ("absent.csv", "no such file")):
        with pytest.raises(SystemExit, match=facts):
            convert(["brapi", str(tmp_path / name), str(tmp_path / "out.json")])
