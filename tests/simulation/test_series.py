"""One plant over days: the same leaves, growing, born and falling, in pots that move."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from benchmarks.demo_plant import grow_later
from csv_rows import read_rows
from mvseg.errors import InputError
from mvseg.formats.label_png import read_labels
from mvseg.simulation.growth import grow_plant
from mvseg.simulation.series import PotPlace, SeriesSpec, draw_pots, grow_series, plan_plant, write_series

SPEC = SeriesSpec("ovate-00", "ovate", leaves=(5, 3), times=(0.0, 4.0, 9.0), seed=3, falls=0.5)


def test_leaves_grow_new_ones_appear_above_and_old_ones_yellow_and_fall() -> None:
    plants = grow_series(replace(SPEC, turns=False, falls=0.0))
    ids = [[leaf.leaf_id for leaf in plant.leaves] for plant in plants]
    assert len(ids[0]) == 5
    assert len(ids[-1]) == 8
    assert set(ids[0]) < set(ids[-1])
    for leaf in plants[0].leaves:
        lengths = [next(each.length for each in plant.leaves if each.leaf_id == leaf.leaf_id) for plant in plants]
        assert lengths[-1] > 0.9 * lengths[0]
    heights = {leaf.leaf_id: leaf.vertices[0, 2] for leaf in plants[-1].leaves}
    assert min(heights[leaf] for leaf in set(ids[-1]) - set(ids[0])) > np.median([heights[leaf] for leaf in ids[0]])
    growing = plan_plant(replace(SPEC, leaves=(12, 0), falls=1.0, times=(0.0, 30.0)))
    counts = [len(growing.at(day).leaves) for day in (0.0, 15.0, 30.0)]
    assert counts[0] > counts[-1]
    dry = [leaf.dryness for day in (5.0, 10.0, 15.0) for leaf in growing.at(day).leaves]
    assert max(dry) > 0.2


def test_pots_are_turned_rigidly_and_the_same_seed_gives_the_same_series() -> None:
    moved, still = grow_series(SPEC), grow_series(replace(SPEC, turns=False))
    again = grow_series(SPEC)
    for plant, other, twin, pot in zip(moved, still, again, draw_pots(SPEC), strict=True):
        for leaf, straight, same in zip(plant.leaves, other.leaves, twin.leaves, strict=True):
            assert leaf.area == pytest.approx(straight.area)
            np.testing.assert_allclose(leaf.vertices, pot.place(straight.vertices))
            np.testing.assert_array_equal(leaf.vertices, same.vertices)
    assert draw_pots(SPEC)[0] == PotPlace()


def test_scenes_and_truth_over_time_are_written(tmp_path: Path) -> None:
    spec = replace(SPEC, times=(0.0, 4.0), num_views=(2, 3), size=(96, 96))
    write_series(tmp_path / "series", [spec])
    rows = read_rows(tmp_path / "series" / "series.csv")
    assert [(row["plant"], row["time"]) for row in rows] == [("ovate-00", "0"), ("ovate-00", "4")]
    truth = read_rows(tmp_path / "series" / "truth.csv")
    known = {(row["scene"], int(row["leaf"])) for row in truth}
    for row, views in zip(rows, (2, 3), strict=True):
        labels = sorted((tmp_path / "series" / row["scene"] / "truth").glob("*.png"))
        assert len(labels) == views  # another rig
        seen = {(row["scene"], int(leaf)) for path in labels for leaf in np.unique(read_labels(path)) if leaf}
        assert seen
        assert seen <= known
    with pytest.raises(InputError, match="exists already"):
        write_series(tmp_path / "series", [spec])


def test_the_demo_plant_later() -> None:
    plant = grow_plant("ovate", 12, seed=6)
    later = grow_later(plant)
    assert {leaf.leaf_id for leaf in later.leaves} == set(range(1, 14)) - {2}
    before = {leaf.leaf_id: leaf.area for leaf in plant.leaves}
    assert all(leaf.area > 0.99 * before.get(leaf.leaf_id, 0) for leaf in later.leaves)
