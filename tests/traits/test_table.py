from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from csv_rows import read_rows
from mvseg.formats.text_file import escape_text, format_number
from mvseg.traits.leaf import Measurement, missing
from mvseg.traits.measure import LeafTraits, Traits
from mvseg.traits.ontology import DEFINITIONS, LEAF_TRAITS, PLANT_TRAITS, VOXEL_TRAITS
from mvseg.traits.table import COLUMNS, read_traits, write_long, write_wide

NAN = float("nan")


def traits_of(**changes: object) -> Traits:
    """Leaf 1 has numbers, some of them negative; leaf 2 is rejected."""
    rng = np.random.default_rng(0)
    full = {}
    for trait in LEAF_TRAITS:
        value = rng.normal() * 10.0 ** rng.integers(-4, 7)
        full[trait.name] = Measurement(value, 0.25 if trait.has_sd else NAN, "surface")
    full |= {trait.name: missing("only for voxels") for trait in VOXEL_TRAITS}
    reason = "rejected: looks like a stem: 9 times longer than wide, 80 degrees steep"
    nothing = {trait.name: missing(reason) for trait in LEAF_TRAITS}
    first = LeafTraits(leaf=1, numbers=full, method="surface", reasons={}, rejection=None)
    second = LeafTraits(
        leaf=2, numbers=nothing, method="surface", reasons={"first": reason, "second": "two, three"}, rejection="stem"
    )
    whole = {trait.name: Measurement(-3.5, 0.5, "surface") for trait in PLANT_TRAITS}
    traits = Traits(plant="basil", unit="mm", leaves=(first, second), whole=whole, up=(0.0, 0.0, 1.0))
    return replace(traits, **changes)  # type: ignore[arg-type]


@pytest.fixture
def long(tmp_path: Path) -> list[dict[str, str]]:
    write_long(tmp_path / "traits.csv", traits_of())
    return read_rows(tmp_path / "traits.csv")


def test_long_form(long: list[dict[str, str]]) -> None:
    columns = ("plant", "leaf", "trait", "value", "sd", "unit", "method", "ontology", "unit_ontology")
    assert tuple(long[0]) == COLUMNS == columns
    names = [trait.name for trait in LEAF_TRAITS if trait not in VOXEL_TRAITS]
    rows = [(leaf, name) for leaf in ("1", "2") for name in names]
    assert [(row["leaf"], row["trait"]) for row in long] == [("", trait.name) for trait in PLANT_TRAITS] + rows
    assert {row["plant"] for row in long} == {"basil"}


def test_cells_are_numbers_or_empty(long: list[dict[str, str]]) -> None:
    numbers = traits_of().leaves[0].numbers
    for row in long:
        if row["leaf"] == "1":
            assert float(row["value"]) == pytest.approx(numbers[row["trait"]].value, rel=1e-5)
        if row["leaf"] == "2":
            assert (row["value"], row["sd"]) == ("", "")
            assert row["method"].startswith("rejected: looks like a stem")
        assert (row["sd"] != "") == ((row["value"] != "" and DEFINITIONS[row["trait"]].has_sd) or row["leaf"] == "")


def test_units_and_accessions(long: list[dict[str, str]], tmp_path: Path) -> None:
    of_leaf = {row["trait"]: row for row in long if row["leaf"] == "1"}
    expected = {"area": "mm^2", "length": "mm", "inclination": "degree", "greenness_index": "1"}
    assert {name: of_leaf[name]["unit"] for name in expected} == expected
    accessions = {row["trait"]: row["ontology"] for row in long if row["ontology"]}
    assert accessions == {
        "number_of_leaves": "TO:0000241", "length": "TO:0000135", "width": "TO:0000370", "area": "TO:0000540",
        "insertion_angle": "TO:0000206", "height": "TO:0000207",
    }  # fmt: skip
    of_units = {"area": "UO:0000082", "length": "UO:0000016", "inclination": "UO:0000185", "hue": "UO:0000185",
                "greenness_index": "UO:0000186"}  # fmt: skip
    assert {name: of_leaf[name]["unit_ontology"] for name in of_units} == of_units
    write_long(tmp_path / "unknown.csv", traits_of(unit=""))
    assert {row["unit_ontology"] for row in read_rows(tmp_path / "unknown.csv")} == {"", "UO:0000185", "UO:0000186"}
    units = {row["trait"]: row["unit"] for row in read_rows(tmp_path / "unknown.csv")}
    assert (units["area"], units["convex_hull_volume"]) == ("world unit^2", "world unit^3")
    write_wide(tmp_path / "wide.csv", traits_of(unit=""))
    assert {row["unit"] for row in read_rows(tmp_path / "wide.csv")} == {"world unit"}


def test_wide_form(tmp_path: Path) -> None:
    write_wide(tmp_path / "wide.csv", traits_of())
    first, second = read_rows(tmp_path / "wide.csv")
    begin = ["plant", "leaf", "use", "doubts", "area", "area_sd", "length", "length_sd", "width", "width_sd"]
    assert [*first][:12] == [*begin, "length_width_ratio", "length_width_ratio_sd"]
    assert [*first][-6:] == ["sure_views", "iou", "unit", "method", "quality", "probability"]
    leaves = traits_of().leaves[0], replace(traits_of().leaves[1], probability=0.75)
    write_wide(tmp_path / "chosen.csv", traits_of(leaves=leaves))
    assert [row["probability"] for row in read_rows(tmp_path / "chosen.csv")] == ["", "0.75"]
    assert (first["leaf"], first["use"], first["doubts"], first["quality"]) == ("1", "yes", "", "good")
    assert (second["leaf"], second["use"], second["doubts"]) == ("2", "no", "first; second")
    assert second["quality"] == traits_of().leaves[1].quality
    numbers = traits_of().leaves[0].numbers
    assert float(first["azimuth"]) == pytest.approx(numbers["azimuth"].value, rel=1e-5)
    assert {name for name, cell in second.items() if cell} == {
        "plant", "leaf", "use", "doubts", "unit", "method", "quality"
    }  # fmt: skip
    assert {first["plant"], second["plant"]} == {"basil"}
    assert "num_views_sd" not in first


@pytest.mark.parametrize("text", ["=1+2", "+x", "-x", "@sum", "\t=x", "\r\n =x"])
def test_no_text_is_a_formula(text: str, tmp_path: Path) -> None:
    numbers = traits_of().leaves[0].numbers | {"area": missing(text), "length": Measurement(-2.0, 0.5, text)}
    leaf = LeafTraits(leaf=1, numbers=numbers, method=text, reasons={"text": text}, rejection=None)  # type: ignore[arg-type]
    traits = traits_of(plant=text, unit=text, leaves=(leaf,), whole={"number_of_leaves": missing(text)})
    write_long(tmp_path / "long.csv", traits)
    write_wide(tmp_path / "wide.csv", traits)
    for row in read_rows(tmp_path / "long.csv") + read_rows(tmp_path / "wide.csv"):
        for cell in row.values():
            if cell.startswith(("=", "+", "-", "@", "\t", "\r")):
                float(cell)  # a number stays one, with its sign
        assert row.get("plant", "'") in ("'", "'" + text.strip())
        assert len(row) > 5
    assert escape_text("basil-1") == "basil-1"


def test_numbers() -> None:
    assert [format_number(value) for value in (0.0, -1.25, 4e6, 1 / 3, NAN, float("inf"))] == [
        "0", "-1.25", "4e+06", "0.333333", "", ""
    ]  # fmt: skip


def test_pandas_reads_both(tmp_path: Path) -> None:
    pandas = pytest.importorskip("pandas")
    write_long(tmp_path / "long.csv", traits_of())
    write_wide(tmp_path / "wide.csv", traits_of())
    long, wide = pandas.read_csv(tmp_path / "long.csv"), pandas.read_csv(tmp_path / "wide.csv")
    assert long["value"].dtype == long["sd"].dtype == wide["area"].dtype == "float64"
    assert wide["leaf"].tolist() == [1, 2]


def test_traits_of_older_versions_are_passed_over(tmp_path: Path) -> None:
    long, wide, traits = tmp_path / "traits.csv", tmp_path / "traits_wide.csv", traits_of()
    write_long(long, traits)
    write_wide(wide, traits)
    with long.open("a") as file:
        file.write("basil,,leaf_area_decile_1,1251.23,36.093,mm^2,surface,,UO:0000082\n")
        file.write("basil,1,lit_share,1,,1,surface,,UO:0000186\n")
    found = read_traits(long, wide, plant="basil", unit="mm", up=None)
    assert found.whole.keys() == traits.whole.keys()
    assert found.leaves[0].numbers.keys() == traits.leaves[0].numbers.keys()
