"""A batch for MIAPPE and BrAPI: against the published checklist and the published schema."""

from __future__ import annotations

import csv
import json
from datetime import datetime
from pathlib import Path

import pytest

from mvseg.cli import main
from mvseg.traits.ontology import DEFINITIONS

# section, field, cardinality: the rows of "MIAPPE_Checklist-Data-Model-v1.1.tsv" (github.com/MIAPPE/MIAPPE)
CHECKLIST = [line.split("\t") for line in (Path(__file__).parent / "miappe-1.1.tsv").read_text().splitlines()]
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
    ("", "number_of_leaves", "2", "", "1", "matching", "TO:0000241"),
    ("1", "area", "812.5", "3.1", "mm^2", "surface", "TO:0000540"),
    ("2", "area", "", "", "mm^2", "no credible surface", "TO:0000540"),
    ("2", "volume", "90", "", "mm^3", "voxels", ""),
]
# BrAPI v2: the properties of Observation and ObservationNewRequest that are text
BRAPI_TEXT = {
    "observationDbId", "germplasmDbId", "germplasmName", "observationTimeStamp", "observationUnitDbId",
    "observationUnitName", "observationVariableDbId", "observationVariableName", "collector", "studyDbId",
    "uploadedBy", "value",
}  # fmt: skip


def write_batch(folder: Path, rows: list[dict[str, str]]) -> Path:
    """The tables of a batch with the same numbers for each plant."""
    columns = [*rows[0], "leaf", "trait", "value", "sd", "unit", "method", "ontology"]
    (folder / "tables").mkdir(parents=True)
    with (folder / "tables" / "traits.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerows([columns, *([*row.values(), *numbers] for row in rows for numbers in NUMBERS)])
    return folder


def plants(**changes: str) -> list[dict[str, str]]:
    """The dry plant on two days, and a wet one; `changes` of the last row."""
    rows = [
        {"scene": "d1_p1", "plant": "p1", "time": "2026-05-01", "treatment": "dry"} | FACTS,
        {"scene": "d2_p1", "plant": "p1", "time": "2026-05-02T09:30", "treatment": "dry"} | FACTS,
        {"scene": "d1_p2", "plant": "p2", "time": "first day", "treatment": "wet"} | FACTS,
    ]
    return [*rows[:2], rows[2] | changes]


def read_table(path: Path) -> list[dict[str, str]]:
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def complaint(capsys: pytest.CaptureFixture[str]) -> str:
    captured = capsys.readouterr()
    assert captured.out == ""
    return captured.err.removeprefix("mvseg: error: ").rstrip("\n")


def test_the_tables_are_what_the_checklist_asks_for(tmp_path: Path) -> None:
    batch = write_batch(tmp_path / "batch", plants())
    assert main(["export", str(batch), "--miappe", "--factors", "treatment"]) == 0
    out = batch / "export"
    sections = {section for section, *_ in CHECKLIST}
    assert {path.stem for path in out.glob("*.csv")} == {*sections, "observations"}
    for section in sections:
        rows = read_table(out / f"{section}.csv")
        known = {field: cardinality for name, field, cardinality in CHECKLIST if name == section}
        assert set(rows[0]) <= {*known, *LINKS}
        for field, cardinality in known.items():
            if cardinality[0] in "12":
                assert all(row[field] for row in rows), field
    assert [row["Observation unit ID"] for row in read_table(out / "observation_unit.csv")] == ["p1", "p2"]
    (factor,) = read_table(out / "experimental_factor.csv")
    assert factor["Experimental Factor values"] == "dry; wet"
    assert [row["Observation Unit factor value"] for row in read_table(out / "observation_unit.csv")] == [
        "treatment:dry", "treatment:wet",
    ]  # fmt: skip
    assert len(read_table(out / "biological_material.csv")) == 1


def test_every_number_has_its_unit_and_variable(tmp_path: Path) -> None:
    batch = write_batch(tmp_path / "batch", plants())
    assert main(["export", str(batch), "--miappe", "--out", str(tmp_path / "out")]) == 0
    numbers = read_table(tmp_path / "out" / "observations.csv")
    assert len(numbers) == 9  # the missing one is left out
    units = {row["Observation unit ID"] for row in read_table(tmp_path / "out" / "observation_unit.csv")}
    variables = {row["Variable ID"]: row for row in read_table(tmp_path / "out" / "observed_variable.csv")}
    assert {row["Observation unit ID"] for row in numbers} == units
    assert {row["Variable ID"] for row in numbers} == variables.keys()
    assert variables["leaf_area_mvseg_mm2"]["Trait accession number"] == "TO:0000540"
    assert variables["leaf_area_mvseg_mm2"]["Scale"] == "mm^2"
    assert DEFINITIONS["area"].meaning in variables["leaf_area_mvseg_mm2"]["Method description"]
    assert (numbers[1]["leaf"], numbers[1]["value"], numbers[1]["sd"]) == ("1", "812.5", "3.1")
    assert not (tmp_path / "out" / "experimental_factor.csv").exists()


def test_brapi_observations_are_text_under_known_keys(tmp_path: Path) -> None:
    batch = write_batch(tmp_path / "batch", plants())
    assert main(["export", str(batch), "--brapi"]) == 0
    answer = json.loads((batch / "export" / "brapi_observations.json").read_text())
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


def test_what_the_batch_does_not_say_is_asked_for(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rows = [{key: cell for key, cell in row.items() if key not in ("Organism", "Study title")} for row in plants()]
    batch = write_batch(tmp_path / "batch", rows)
    assert main(["export", str(batch), "--miappe"]) == 2
    assert "expected a column for each, filled in every row: Study title, Organism; mvseg batch" in complaint(capsys)
    assert not (batch / "export").exists()
    assert main(["export", str(batch), "--brapi"]) == 0  # which asks for nothing


@pytest.mark.parametrize(
    ("changes", "arguments", "message"),
    [
        ({}, [], "neither --miappe nor --brapi is given, expected one or both"),
        ({}, ["--miappe", "--factors", "light"], "the batch's table has no column 'light', found scene, plant"),
        ({}, ["--miappe", "--factors", "Organism"], "'Organism' is NCBI:39350 for all plants, expected two values"),
        ({"Organism": ""}, ["--miappe"], "filled in every row: Organism"),
        ({"Investigation title": "Another"}, ["--miappe"], "is 'Drought in basil' and 'Another' for one investigation"),
        ({"plant": "p1", "Spatial distribution": "row:5"}, ["--miappe"], "for one Observation unit ID (p1)"),
        ({"Study title": "Another"}, ["--miappe"], "for one Study unique ID (study-1), expected one of them"),
    ],
)  # fmt: skip
def test_wrong_tables_are_named(
    changes: dict[str, str], arguments: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    batch = write_batch(tmp_path / "batch", plants(**changes))
    assert main(["export", str(batch), *arguments]) == 2
    assert message in complaint(capsys)


def test_what_is_no_batch_is_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["export", str(tmp_path), "--brapi"]) == 2
    assert "is not an output of mvseg batch (tables/traits.csv is missing)" in complaint(capsys)


def test_files_of_the_user_stay(tmp_path: Path) -> None:
    batch = write_batch(tmp_path / "batch", plants())
    assert main(["export", str(batch), "--brapi"]) == 0
    (batch / "export" / "notes.txt").write_text("mine")
    assert main(["export", str(batch), "--miappe"]) == 0
    assert (batch / "export" / "notes.txt").read_text() == "mine"
    assert not (batch / "export" / "brapi_observations.json").exists()
