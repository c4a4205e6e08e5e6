"""Numbers of leaves as the page gets them."""

from __future__ import annotations

from dataclasses import replace

from mvseg.results.overlay import instance_color
from mvseg.results.report.leaves import describe_leaves, describe_numbers, describe_traits
from mvseg.results.result import Instances, Result
from mvseg.traits.leaf import Measurement, missing
from mvseg.traits.ontology import DEFINITIONS


def test_a_number_has_its_deviation_or_the_reason_why_it_is_missing() -> None:
    numbers = {
        "area": Measurement(1234.56789, 9.87654321, "surface"),
        "num_views": Measurement(4.0, float("nan"), "masks"),
        "azimuth": missing("up is not known"),
    }
    assert describe_numbers(numbers, [DEFINITIONS[name] for name in numbers]) == {
        "area": {"value": 1234.57, "sd": 9.87654, "on": "surface"},
        "num_views": {"value": 4.0, "sd": None, "on": "masks"},
        "azimuth": {"why": "up is not known"},
    }


def test_leaves_have_the_colours_of_the_overlays(balls: Result) -> None:
    for leaf in describe_leaves(balls):
        assert leaf["color"] == "#" + bytes(instance_color(leaf["id"])).hex()
        assert (leaf["shape"], leaf["doubts"], leaf["isRejected"]) == ("voxels", [], False)
        assert leaf["traits"]["volume"]["value"] > 100


def test_units_are_written_as_people_do_and_columns_chosen(balls: Result) -> None:
    described = describe_traits(balls.traits)
    traits = {trait["name"]: trait for trait in described["traits"]}
    assert (traits["volume"]["unit"], traits["num_views"]["unit"], traits["x_min"]["unit"]) == ("mm³", "", "mm")
    assert (traits["volume"]["isColumn"], traits["x_min"]["isColumn"]) == (True, False)
    assert "area" not in traits  # no leaf has one
    assert [traits[name]["label"] for name in ("volume", "num_views", "x_min")] == ["volume", "views", "x min"]
    plant = {trait["name"]: trait["unit"] for trait in described["plantTraits"]}
    assert (plant["total_leaf_area"], plant["number_of_leaves"]) == ("mm²", "")
    assert described["whole"]["number_of_leaves"]["value"] == 3


def test_ids_alone_have_no_numbers(balls: Result) -> None:
    ids = replace(balls, instances=Instances())
    assert [set(leaf) for leaf in describe_leaves(ids)] == [{"id", "color"}] * 3
    assert describe_traits(None) == {"traits": [], "plantTraits": [], "whole": {}}
