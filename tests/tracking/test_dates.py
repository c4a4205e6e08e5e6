"""Dates from results: times, units, and what is refused."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from known_leaves import make_surface
from mvseg import load_result
from mvseg.errors import InputError
from mvseg.reconstruction.stem.stem_axis import StemAxis
from mvseg.tracking.dates import Number, date_of, name_apart, order_dates, read_date, read_time
from mvseg.tracking.numbers import OBSERVATIONS
from mvseg.traits.leaf import Measurement, missing
from mvseg.traits.measure import LeafTraits, Traits
from mvseg.traits.nodes import UNCLEAR, Node, Stem
from tests.plants_over_days import fit_blade, grow_blades, see, write_result


def test_times_are_days_and_eight_digits_a_date() -> None:
    assert read_time("3.5") == 3.5
    assert read_time("2026-03-02") - read_time("2026-02-27") == 3
    assert read_time("2026-03-02T12:00") - read_time("2026-03-02") == 0.5
    assert (read_time("1e2"), read_time(".5"), read_time(-1e-3), read_time(0)) == (100, 0.5, -0.001, 0)
    assert read_time("20260601") == read_time(20260601) == read_time("2026-06-01")
    dates = [replace(see(grow_blades(4, 0), 0)[0], scene=text, written=text, time=read_time(text))
             for text in ("20260531", "2026-06-06")]  # fmt: skip
    assert [date.time for date in order_dates(dates)] == [0, 6]


def test_times_with_a_zone_are_in_the_order_in_which_they_were() -> None:
    assert read_time("2026-03-02T12:00+00:00") == read_time("2026-03-02T12:00")
    first, second = "2026-03-02T23:00-05:00", "2026-03-03T01:00+02:00"  # the second is 5 hours earlier
    assert 24 * (read_time(first) - read_time(second)) == pytest.approx(5)
    dates = [replace(see(grow_blades(4, 0), 0)[0], scene=text, written=text, time=read_time(text))
             for text in (first, second)]  # fmt: skip
    assert [date.scene for date in order_dates(dates)] == [second, first]
    bare = replace(dates[0], scene="bare", written="2026-03-04", time=read_time("2026-03-04"))
    with pytest.raises(InputError, match="some times have a time zone"):
        order_dates([*dates, bare])


def test_results_of_one_name_are_told_apart_by_their_folders(tmp_path: Path) -> None:
    for place in ("mon/plant", "fri/plant", "fri/other"):
        write_result(tmp_path / place, grow_blades(3, 1))
    dates = [read_date(tmp_path / place, 0) for place in ("mon/plant", "fri/plant", "fri/other")]
    assert [date.scene for date in name_apart(dates)] == ["mon/plant", "fri/plant", "other"]
    assert next(date.scene for date in name_apart([dates[0], dates[0]])).endswith("mon/plant")


NO_TIMES = ["", "noon", "nan", "2026-13-01", "20261301", "2026_04_28", "0428", "260531", "1780000000", "1711121500000"]


@pytest.mark.parametrize("text", [*NO_TIMES, "1e9", "."])
def test_times_that_are_none_are_refused(text: str) -> None:
    with pytest.raises(InputError, match="expected a number"):
        read_time(text)


def test_repeated_and_mixed_times_are_refused() -> None:
    date = see(grow_blades(4, 0), 1)[0]
    with pytest.raises(InputError, match="day-1 and other have the same time 1"):
        order_dates([date, replace(date, scene="other")])
    iso = replace(date, scene="other", time=read_time("2026-03-02"), written="2026-03-02")
    with pytest.raises(InputError, match="numbers and ISO dates"):
        order_dates([date, iso])


def test_points_that_are_no_numbers_are_refused() -> None:
    date = see(grow_blades(4, 0), 0)[0]
    midrib = date.leaves[1].midrib
    assert midrib is not None
    torn = replace(date.leaves[1], midrib=midrib * np.nan)
    later = replace(date, scene="other", time=2.0, written="2", leaves=(date.leaves[0], torn))
    with pytest.raises(InputError, match=f"other: leaf {torn.leaf} has points that are no finite numbers"):
        order_dates([date, later])


def test_units_are_converted_or_refused() -> None:
    first, other = see(grow_blades(4, 0), 0)[0], see(grow_blades(4, 0), 1, unit="cm")[0]
    other = replace(other, leaves=(replace(other.leaves[0], node_place=np.ones(3)), *other.leaves[1:]))
    _, later = order_dates([first, other])
    assert later.unit == "mm"
    assert later.leaves[0].length == pytest.approx(10 * other.leaves[0].length)
    area, before = later.leaves[0].numbers["area"], other.leaves[0].numbers["area"]
    assert (area.unit, later.leaves[0].node_place.tolist()) == ("mm^2", [10, 10, 10])
    assert (area.value, area.sd) == pytest.approx((100 * before.value, 100 * before.sd))
    with pytest.raises(InputError, match="day-0 is in mm and day-1 in no unit"):
        order_dates([first, replace(other, unit="")])


def test_results_are_read(tmp_path: Path) -> None:
    blades = grow_blades(3, 1)
    write_result(tmp_path / "day", blades)
    date = read_date(tmp_path / "day", "4")
    assert [leaf.leaf for leaf in date.leaves] == [1, 2, 3]
    assert date.knows_up
    assert date.whole["total_leaf_area"].value == 5000
    midrib = date.leaves[0].midrib
    assert midrib is not None
    assert midrib.shape == (OBSERVATIONS.stations, 3)
    np.testing.assert_allclose(midrib[[0, -1]], blades[1][[0, -1], 1], atol=1.5)


def test_a_date_read_back_is_that_of_the_result_in_memory(tmp_path: Path) -> None:
    write_result(tmp_path / "day", grow_blades(3, 1))
    read, held = read_date(tmp_path / "day", 3), date_of(load_result(tmp_path / "day"), 3)
    assert (read.scene, read.folder, held.scene, held.folder) == ("day", tmp_path / "day", "p", None)
    for one, other in zip(read.leaves, held.leaves, strict=True):
        assert one.numbers == other.numbers
        np.testing.assert_array_equal(one.points, other.points)


def test_leaves_without_a_shape_and_rejected_ones(tmp_path: Path) -> None:
    write_result(tmp_path / "day", grow_blades(3, 1), shapeless=[2], rejected={3: "low_quality"})
    date = read_date(tmp_path / "day", 0)
    assert [(leaf.leaf, leaf.midrib is None) for leaf in date.leaves] == [(1, False), (2, True)]
    assert date.shaped == [0]
    write_result(tmp_path / "stem", grow_blades(3, 1), rejected={3: "stem"})
    doubted = {leaf.leaf: leaf.is_doubted for leaf in read_date(tmp_path / "stem", 0).leaves}
    assert doubted == {1: False, 2: False, 3: True}


def test_what_is_no_result_with_surfaces_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="is missing, expected a result folder"):
        read_date(tmp_path, 0)
    write_result(tmp_path / "day", grow_blades(3, 1))
    run = tmp_path / "day" / "run.json"
    said = json.loads(run.read_text())
    (tmp_path / "day" / "traits.csv").write_text("no,table\n1,2\n")
    with pytest.raises(InputError, match="expected a table that mvseg wrote"):
        read_date(tmp_path / "day", 0)
    del said["traits"], said["files"]
    run.write_text(json.dumps(said))
    with pytest.raises(InputError, match="has ids but no surfaces, run mvseg infer"):
        read_date(tmp_path / "day", 0)


def test_results_in_memory() -> None:
    surface = make_surface(fit_blade(grow_blades(1, 1)[1]))
    numbers = {"length": Measurement(80.0, 2.0, "surface"), "area": missing("no surface")}
    seen = LeafTraits(leaf=1, numbers=numbers, method="surface", reasons={}, rejection=None)
    none = replace(seen, leaf=2, numbers={})
    traits = Traits("p", "mm", (seen, none), {"total_leaf_area": Measurement(5.0, 1.0, "surface")}, up=(0, 0, 1))
    result: Any = SimpleNamespace(scene=SimpleNamespace(name="p"), traits=traits, surfaces={1: surface}, voxels={})
    date = date_of(result, 3)
    assert [leaf.leaf for leaf in date.leaves] == [1, 2]
    assert date.shaped == [0]
    assert date.leaves[0].numbers == {"length": Number(80.0, 2.0, "mm")}
    assert date.whole["total_leaf_area"].unit == "mm^2"
    angle, nothing = Measurement(137.5, 4.0, "leaf bases"), missing("the lowest one")
    node = Node(2, 1, 2, 1, (0, 0, 1), (0, 1, 1), height=angle, internode=Measurement(9.0, 1.0, "leaf bases"),
                divergence=angle, insertion_angle=nothing, node_azimuth=nothing)  # fmt: skip
    stem = Stem(1, StemAxis.along(np.array([[0.0, 0, 0], [0, 0, 1]])), "leaf bases", (node,), UNCLEAR)
    result.traits = replace(traits, stems=(stem,))
    on_stem, elsewhere = date_of(result, 3).leaves
    assert (on_stem.node, [*on_stem.node_place], elsewhere.node) == ((1, 2), [0, 0, 1], None)
    assert on_stem.numbers["internode"] == Number(9.0, 1.0, "mm")
    assert on_stem.numbers["divergence"] == Number(137.5, 4.0, "degree")
    assert "node_azimuth" not in on_stem.numbers
    with pytest.raises(InputError, match="p: has ids but no surfaces"):
        date_of(SimpleNamespace(scene=result.scene, traits=None), 3)  # type: ignore[arg-type]
