"""The paper's experiments on the smallest preset: what is run, kept, averaged and written up."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

sys.path.insert(0, str(Path(__file__).parents[1]))  # benchmarks are not part of the package

from benchmarks.paper_tables import printed
from benchmarks.paper_tables.__main__ import main
from benchmarks.paper_tables.averages import average_columns, measure
from benchmarks.paper_tables.cells import PRESETS, Cell, list_cells, open_cell, read_cell
from benchmarks.paper_tables.masks import detected_masks, tie_detections, true_masks
from benchmarks.paper_tables.methods import METHODS, PRINTED
from benchmarks.paper_tables.number_of_leaves import DEFAULT, RULES, score_numbers
from benchmarks.paper_tables.shape_error import TrueLeaves, measure_points, measure_shares, unite
from mvseg.detection.config import DetectConfig
from mvseg.errors import InputError
from mvseg.evaluation.id_metrics import matching_metrics
from mvseg.evaluation.shape_distance import shape_distance
from mvseg.matching.config import MatchConfig
from mvseg.matching.match import match_regions
from mvseg.regions import regions_from_label_maps
from mvseg.simulation.dataset import list_scenes


@pytest.fixture(scope="module")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("cache")


@pytest.fixture(scope="module")
def cell(cache: Path) -> Cell:
    return open_cell(list_cells(PRESETS["tiny"])[0], PRESETS["tiny"], cache)


# --- the whole run


SOME_SHAPES = (
    "MVS points on leaves",
    "semantic segmentation, true masks",
    "MVIS (nview), true masks",
    "MVIS (nview), degraded masks, hidden parts",
    "true ids",
    "voxels of the truth",
)


def run(cache: Path, *words: str) -> tuple[str, dict[str, Any]]:
    main(["--preset", "tiny", "--cache", str(cache), "--shapes", *SOME_SHAPES, *words])
    text = (cache / "docs" / "benchmarks.md").read_text(encoding="utf-8")
    return text, json.loads((cache / "docs" / "benchmarks.json").read_text(encoding="utf-8"))


@pytest.mark.slow
def test_the_whole_run_is_written_up_and_goes_on_where_it_stopped(
    cache: Path, cell: Cell, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("matplotlib")
    text, numbers = run(cache, "--real", str(cell.folder))
    for words in ("Table 1: ids, masks true", "masks degraded", "Table 2", "Table 3", "What d is made of", "number of"):
        assert words in text
    for name in (*METHODS, *(f"paper: {name}" for name in PRINTED.values()), *RULES):
        assert name in text
    (record,) = numbers["table 1, true, MVIS (nview)"]
    assert record["s_match"] == record["ari"] == 1
    assert {name for name in numbers if name.startswith("table 3")} == {f"table 3, {name}" for name in SOME_SHAPES}
    plots = {path.stem for path in (cache / "docs").glob("*.png")}
    assert plots == {"benchmarks-true", "benchmarks-degraded", "benchmarks-shapes"}
    # A cell whose record is there is not run again; one that is missing is.
    monkeypatch.setattr("benchmarks.paper_tables.write_up.plot_all", lambda plan, out: [])
    records = sorted((cache / "records").rglob("*.json"))
    records[0].write_text(json.dumps({**json.loads(records[0].read_text()), "marked": 1}), encoding="utf-8")
    records[1].unlink()
    times = {path: path.stat().st_mtime_ns for path in records if path != records[1]}
    assert "![" in text
    assert "![" not in run(cache, "--real", str(cell.folder))[0]
    assert records[1].is_file()
    assert {path: path.stat().st_mtime_ns for path in times} == times


def test_the_papers_cells_with_three_fresh_test_plants_each() -> None:
    specs = list_cells(PRESETS["paper"])
    assert len(specs) == 4 * 4 * 3
    assert {spec.split for spec in specs} == {"test"}
    assert not {spec.seed for spec in specs} & {spec.seed for spec in list_scenes(PRESETS["paper"], seed=0)}
    costs = [spec.num_leaves * spec.num_views for spec in specs]
    assert costs == sorted(costs)


# --- what the paper prints


def test_printed_averages_of_table_1_follow_from_the_columns() -> None:
    for values in [row for rows in printed.TABLE_1.values() for row in rows.values()]:
        for columns in (values[:4], values[4:8]):
            assert np.mean(columns) == pytest.approx(values[8], abs=0.006 if values[8] > 1 else 0.001)


def test_printed_leaf_columns_of_table_3_are_those_of_10_cameras() -> None:
    for values in printed.TABLE_3.values():
        assert np.mean(values[4:]) == pytest.approx(values[1], abs=0.001)


# --- averages


def test_cells_count_once_and_missing_values_are_counted() -> None:
    records = [
        {"views": 3, "leaves": 4, "ari": 1.0},
        {"views": 3, "leaves": 4, "ari": 0.5},
        {"views": 3, "leaves": 8, "ari": 0.25},
        {"views": 5, "leaves": 4, "na": "no points"},
        {"views": 5, "leaves": 8, "na": "no points"},
    ]
    columns = average_columns(records, measure("ari"), views=(3, 5, 10), leaves=(4, 8))
    texts = [column.text(2) for column in columns]
    assert texts == ["0.50", "N/A", "-", "0.75 (2 of 3)", "0.25 (1 of 2)", "0.50 (3 of 5)"]
    at_three = average_columns(records, measure("ari"), views=(), leaves=(4,), leaves_at=3)
    assert at_three[0].text(2) == "0.75"


# --- masks


def test_a_detection_shows_the_leaf_that_is_half_of_their_union() -> None:
    truth = np.zeros((20, 20), np.uint16)
    truth[:10, :10], truth[:10, 10:], truth[15:] = 1, 2, 65535
    detected = np.zeros((20, 20), np.uint16)
    detected[:10, :6] = 1  # 0.6 of leaf 1
    detected[:10, 16:] = 2  # 0.4 of leaf 2
    detected[15:] = 3  # all ignored pixels
    masks = tie_detections(regions_from_label_maps([detected]), (truth,))
    assert masks.true_ids.tolist() == [1, 0, 0]
    assert masks.num_missed == 1


def test_a_perfect_detector_gives_the_true_masks(cell: Cell, monkeypatch: pytest.MonkeyPatch) -> None:
    views = iter(cell.truth)

    def detect(model: str, photo: torch.Tensor) -> tuple[dict[str, torch.Tensor], list[torch.Tensor]]:
        labels = torch.from_numpy(next(views).astype(np.int64))
        assert model == "leaf"
        assert photo.shape == (3, *labels.shape)
        masks = [(labels == leaf).float() for leaf in labels.unique().tolist() if leaf]
        unsure = torch.ones_like(masks[0])
        return {"scores": torch.tensor([0.9] * len(masks) + [DetectConfig().min_score - 0.01])}, [*masks, unsure]

    monkeypatch.setattr("mvseg.detectors.run.detect", detect)
    monkeypatch.setattr("mvseg.detectors.zoo.load_detector", lambda name: name)
    detected, true = detected_masks(cell, "leaf"), true_masks(cell)
    assert detected.num_missed == 0
    assert sorted(detected.true_ids.tolist()) == sorted(true.true_ids.tolist())
    assert detected.regions.areas.sum() == true.regions.areas.sum()


# --- the number of leaves


def test_the_default_range_is_what_match_regions_does(cell: Cell) -> None:
    masks = true_masks(cell)
    record = score_numbers(cell, masks)
    ids = match_regions(masks.regions, cell.scene.cameras, MatchConfig(method="symnmf")).instance_ids
    expected = matching_metrics(ids, masks.true_ids)
    assert record[DEFAULT]["ari"] == expected.ari
    assert record[DEFAULT]["e_k"] == expected.e_k
    assert record["k given"]["k"] == expected.num_true


# --- shapes


def test_d_is_the_mean_of_its_halves() -> None:
    rng = np.random.default_rng(0)
    points, truth = rng.random((50, 3)), rng.random((70, 3))
    leaves = TrueLeaves(truth, mean_length=2.0)
    measures = measure_points(points, leaves)
    assert measures["d"] == pytest.approx(shape_distance(torch.from_numpy(points), torch.from_numpy(truth)) / 2)
    assert measures["d"] == pytest.approx((measures["excess"] + measures["gaps"]) / 2)
    assert "na" in measure_points(points[:0], leaves)
    by_share = measure_shares(points, np.linspace(0, 1, 50), leaves, thresholds=(0.5, 1.0))
    assert by_share["0.5"] == measure_points(points[25:], leaves)
    assert "na" in by_share["1"]


def test_united_leaves_have_each_voxel_once_with_its_largest_share() -> None:
    first = torch.tensor([[0.25, 0.25, 0.25], [0.75, 0.25, -0.25]]).double()
    parts = [(first, torch.tensor([0.6, 0.9])), (first[:1], torch.tensor([1.0]))]
    points, shares = unite(parts, 0.5)
    assert sorted(zip(points.tolist(), shares.tolist(), strict=True)) == [
        ([0.25, 0.25, 0.25], 1.0),
        ([0.75, 0.25, -0.25], pytest.approx(0.9)),
    ]
    assert len(unite([], 0.5)[0]) == 0


def test_a_scene_without_truth_is_refused(tmp_path: Path, cell: Cell) -> None:
    (tmp_path / "cameras.json").write_bytes((cell.folder / "cameras.json").read_bytes())
    with pytest.raises(InputError, match="the mask file is missing"):
        read_cell(tmp_path, "bare", {})
