"""The whole method on tiny scenes, and what run.json says of a run."""

from __future__ import annotations

import hashlib
import json
import math
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import mvseg
from known_leaves import bent_blade
from mvseg import (
    InputError,
    MatchConfig,
    ReconstructConfig,
    RunConfig,
    demo_scene,
    load_masks,
    load_scene,
    match_regions,
    run_scene,
)
from mvseg.detection.cached_detections import CachedDetections
from mvseg.detection.config import DetectConfig
from mvseg.detection.crops import crop_cameras, place_crops, plant_boxes
from mvseg.detection.detect_scene import detect_scene
from mvseg.detectors.zoo import weights_path
from mvseg.errors import warn
from mvseg.findings.finding import Finding
from mvseg.formats.image_file import read_rgb, write_png
from mvseg.formats.photos import Photos, read_photo
from mvseg.formats.scene_folder import read_masks
from mvseg.pipeline.finish import _find_doubtful, shape_leaves
from mvseg.pipeline.plant import Plant
from mvseg.reconstruction.surface.leaf_surface import LeafSurface
from mvseg.reconstruction.voxels import reconstruct_instances
from mvseg.results.result import Result
from mvseg.runs.one_scene import describe_run
from mvseg.scene import Scene, View
from mvseg.system.file_hash import hash_files
from mvseg.system.running import running
from scene_folders import write_scene
from warned import warns_of

IDS_ONLY = RunConfig(reconstruct=None)
COARSE = RunConfig(reconstruct=ReconstructConfig(shape="voxels", voxel_budget=500))


@pytest.fixture(scope="module")
def plant(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_scene(tmp_path_factory.mktemp("scenes") / "plant")


def test_it_is_the_stages_one_after_another(plant: Path) -> None:
    match, reconstruct = MatchConfig(num_instances=3, seed=7), ReconstructConfig(shape="voxels", voxel_size=1.0)
    result = run_scene(plant, plant / "masks", RunConfig(match=match, reconstruct=reconstruct))
    scene = load_scene(plant)
    regions = load_masks(scene, plant / "masks")
    matching = match_regions(regions, scene.cameras, match)
    shapes = reconstruct_instances(regions, matching.instance_ids, scene.cameras, config=reconstruct)
    assert torch.equal(result.regions.crops, regions.crops)
    assert torch.equal(result.matching.instance_ids, matching.instance_ids)
    assert result.surfaces is None
    assert result.voxels is not None
    assert result.voxels.keys() == shapes.keys() == {1, 2, 3}
    assert all(torch.equal(result.voxels[instance].votes, shapes[instance].votes) for instance in shapes)
    assert [*result.seconds] == ["load", "match", "choose", "check", "voxels", "measure"]


def test_ids_are_those_of_the_balls(plant: Path) -> None:
    result = run_scene(plant, plant / "masks", IDS_ONLY)
    ball = (result.regions.labels - 1 - 9 * result.regions.view_index) % 3  # undoes the shuffled numbers
    pairs = set(zip(ball.tolist(), result.matching.instance_ids.tolist(), strict=True))
    assert len(pairs) == 3
    assert result.matching.num_instances == 3
    result = run_scene(plant, plant / "masks", IDS_ONLY)
    assert (result.surfaces, result.voxels, result.traits) == (None, None, None)
    assert [*result.seconds] == ["load", "match", "choose", "check"]


def test_nothing_is_written_and_photos_are_not_read(tmp_path: Path) -> None:
    plant = write_scene(tmp_path / "plant", images=False)
    before = sorted(tmp_path.rglob("*"))
    assert run_scene(plant, plant / "masks", COARSE).voxels
    assert sorted(tmp_path.rglob("*")) == before


def test_progress_bars_go_to_stderr_when_asked_for(plant: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with running(progress=True):
        run_scene(plant, plant / "masks", COARSE)
    captured = capsys.readouterr()
    assert captured.out == ""
    assert "voxels: instance" in captured.err
    run_scene(plant, plant / "masks", IDS_ONLY)
    assert capsys.readouterr() == ("", "")


def test_wrong_input_is_an_input_error(plant: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="absent: no such scene folder"):
        run_scene(tmp_path / "absent", plant / "masks")
    with pytest.raises(InputError, match="absent: no such masks"):
        run_scene(plant, plant / "absent")
    with pytest.raises(ValueError, match="voxel_size"):  # an InputError is a ValueError
        RunConfig(reconstruct=ReconstructConfig(voxel_size=-1.0))


def test_the_users_word_on_the_world(plant: Path) -> None:
    """Lengths in centimetres: the same plant, ten times smaller, and up where the user says."""
    first = run_scene(plant, plant / "masks", COARSE)
    config = replace(COARSE, scale=0.1, unit="cm", up=(0.0, -2.0, 0.0))
    second = run_scene(plant, plant / "masks", config)
    assert (first.scene.unit, first.scene.up) == ("mm", None)
    assert (second.scene.unit, second.scene.up) == ("cm", (0, -1, 0))
    assert first.traits is not None
    assert second.traits is not None
    assert torch.equal(second.matching.instance_ids, first.matching.instance_ids)
    assert torch.equal(second.matching.match_scores, first.matching.match_scores)
    for leaf, other in zip(first.traits.leaves, second.traits.leaves, strict=True):
        assert other.numbers["volume"].value == pytest.approx(leaf.numbers["volume"].value / 1000, rel=1e-6)
        assert other.numbers["x_min"].value == pytest.approx(leaf.numbers["x_min"].value / 10, abs=1e-9)


def test_units_scales_and_ups_that_the_cameras_contradict(plant: Path, tmp_path: Path) -> None:
    with warns_of("unit_only_renamed"):
        assert run_scene(plant, plant / "masks", replace(IDS_ONLY, unit="cm")).scene.unit == "cm"
    scaled = replace(IDS_ONLY, scale=0.001)
    with pytest.raises(InputError, match=r"scale is 0\.001 without a unit, but the cameras are in mm: expected"):
        run_scene(plant, plant / "masks", scaled)
    assert run_scene(plant, plant / "masks", replace(scaled, unit="mm")).scene.unit == "mm"
    assert run_scene(plant, plant / "masks", replace(scaled, scale=1.0)).scene.unit == "mm"
    unknown = shutil.copytree(plant, tmp_path / "plant")
    rig = json.loads((unknown / "cameras.json").read_text())
    del rig["unit"]
    (unknown / "cameras.json").write_text(json.dumps(rig))
    assert run_scene(unknown, unknown / "masks", scaled).scene.unit == ""
    run_scene(plant, plant / "masks", replace(IDS_ONLY, up=(0.0, -1.0, 0.0)))  # +y is down there
    with warns_of("upside_down"):
        run_scene(plant, plant / "masks", replace(IDS_ONLY, up=(0.0, 1.0, 0.0)))


@pytest.mark.slow
@pytest.mark.parametrize("scale", [1e-3, 412.0])
def test_a_scale_moves_no_relative_result(scale: float) -> None:
    """The shipped plant with its photos: the same ids, scores, doubts, and shares of the areas."""
    plant = demo_scene()
    first, second = (
        run_scene(plant, plant / "masks", RunConfig(scale=each, unit="m", up=(0.0, 0.0, 1.0))) for each in (1.0, scale)
    )
    assert torch.equal(second.matching.instance_ids, first.matching.instance_ids)
    assert second.matching.match_scores.numpy() == pytest.approx(first.matching.match_scores.numpy(), abs=1e-6)
    assert second.traits is not None
    assert first.traits is not None
    for leaf, other in zip(first.traits.leaves, second.traits.leaves, strict=True):
        assert other.reasons == leaf.reasons
        for name, power in {"area": 2, "length": 1, "inclination": 0, "greenness_index": 0, "visible_share": 0}.items():
            expected = leaf.numbers[name].value * scale**power
            assert other.numbers[name].value == pytest.approx(expected, rel=1e-4, nan_ok=True)


@pytest.mark.parametrize("wrong", [{"scale": 0.0}, {"scale": math.inf}, {"up": (0.0, 0.0, 0.0)}])
def test_worlds_that_cannot_be(wrong: dict[str, Any]) -> None:
    with pytest.raises(InputError, match=f"{next(iter(wrong))} is "):
        RunConfig(**wrong)


class TestDescribeRun:
    def test_it_says_where_a_result_comes_from(self, plant: Path) -> None:
        result = run_scene(plant, plant / "masks", IDS_ONLY)
        config = RunConfig(match=MatchConfig(seed=3), reconstruct=None)
        run = describe_run(replace(result, findings=(Finding("no_masks"),)), plant / "masks", config)
        assert run["mvseg"] == mvseg.__version__
        assert run["torch"] == torch.__version__
        assert [each["code"] for each in run["findings"]] == ["no_masks"]
        ran = {"views", "match", "coco_crowd", "categories", "stem_category", "report"}
        assert run["config"].keys() == ran
        assert run["config"]["match"]["seed"] == 3
        rig = plant / "cameras.json"
        assert run["inputs"].keys() == {str(rig), str(plant / "masks")}
        assert run["inputs"][str(rig)] == hashlib.sha256(rig.read_bytes()).hexdigest()
        json.dumps(run)

    def test_weights_of_the_user_are_found_from_any_folder(
        self, plant: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.chdir(tmp_path)
        (tmp_path / "own.safetensors").touch()
        result = run_scene(plant, plant / "masks", IDS_ONLY)
        for stated, recorded in (("own.safetensors", str(tmp_path / "own.safetensors")), ("leaf-lite", "leaf-lite")):
            run = describe_run(result, None, RunConfig(detect=DetectConfig(weights=stated)))
            assert run["config"]["detect"]["weights"] == recorded
        with pytest.raises(InputError, match=r"holds no detector.safetensors, expected a result whose"):
            weights_path(tmp_path)

    def test_hashes_are_of_what_was_read(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        """Masks and cameras change while a run works; and while they are read."""
        plant = write_scene(tmp_path / "plant")
        rig, first = plant / "cameras.json", plant / "masks" / "000.png"
        inputs = {str(path): hash_files(path) for path in (rig, plant / "masks")}

        def change(known: Plant, **options: Any) -> Result:
            for path in (rig, first):
                path.write_bytes(path.read_bytes() + b"\n")
            return shape_leaves(known, **options)

        monkeypatch.setattr(mvseg.pipeline.run_scene, "shape_leaves", change)
        result = run_scene(plant, plant / "masks", IDS_ONLY)
        assert describe_run(result, plant / "masks", IDS_ONLY)["inputs"] == inputs

        def read(*args: Any, **kwargs: Any) -> Any:
            first.write_bytes(first.read_bytes() + b"\n")
            return read_masks(*args, **kwargs)

        monkeypatch.setattr(mvseg.pipeline.open_scene, "read_masks", read)
        with pytest.raises(InputError, match="masks: has changed while it was read"):
            run_scene(plant, plant / "masks", IDS_ONLY)


@pytest.mark.parametrize("is_wanted", [True, False])
def test_surfaces_check_given_ids_where_they_are_wanted(
    plant: Path, monkeypatch: pytest.MonkeyPatch, is_wanted: bool
) -> None:
    fits: list[list[int]] = []

    def fit(_: object, ids: torch.Tensor, *__: object, **___: object) -> dict[int, LeafSurface]:
        fits.append(ids.tolist())
        return {number: LeafSurface.none(torch.arange(2), "test", "a test") for number in (1, 2, 3)}

    monkeypatch.setattr("mvseg.verification.choose.fit_surfaces", fit)
    monkeypatch.setattr("mvseg.reconstruction.surface.fit_surfaces.fit_surfaces", fit)
    config = RunConfig(reconstruct=ReconstructConfig(check_ids=is_wanted, voxel_budget=500))
    result = run_scene(plant, plant / "masks", config)
    assert len(fits) > 1 if is_wanted else len(fits) == 1
    assert fits[-1] == result.matching.instance_ids.tolist()
    assert result.voxels is not None


@pytest.mark.slow
def test_a_small_plant_is_looked_at_again_as_if_its_photos_had_been_cut(tmp_path: Path) -> None:
    whole = load_scene(demo_scene())
    chosen, margin = [0, 3, 6, 8], torch.tensor([700, 500])
    K = whole.cameras.K[chosen].clone()
    K[:, :2, 2] += margin
    cameras = replace(whole.cameras[chosen], K=K, sizes=whole.cameras.sizes[chosen] + 2 * margin)
    views = []
    for view in chosen:
        photo = np.pad(read_photo(whole, view), ((500, 500), (700, 700), (0, 0)), mode="edge")
        views.append(View(f"{view:03d}", tmp_path / f"{view:03d}.png"))
        write_png(views[-1].path, photo)
    scene = Scene("far", tuple(views), cameras)
    kept = tmp_path / "kept"
    first = detect_scene(Photos(scene), DetectConfig(crop="off")).sure.masks
    again = detect_scene(Photos(scene), cache=CachedDetections(kept)).sure.masks
    assert len(again) > len(first)
    assert len([*kept.iterdir()]) == 2 * len(chosen)

    boxes = plant_boxes(first, cameras)
    for view, (x1, y1, x2, y2) in zip(views, boxes.tolist(), strict=True):
        write_png(view.path, np.ascontiguousarray(read_rgb(view.path)[y1:y2, x1:x2]))
    cut = Scene("cut", tuple(views), crop_cameras(cameras, boxes))
    expected = detect_scene(Photos(cut)).sure.masks
    placed = place_crops(expected, boxes)
    assert torch.equal(again.regions.boxes, placed.regions.boxes)
    assert torch.equal(again.regions.crops, placed.regions.crops)
    assert int(again.instance_ids.max()) >= 10  # of 12 leaves


def test_warnings_before_an_error_are_given(plant: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(_: object) -> None:
        warn(Finding("dark_photo", "view 3"))
        raise InputError("view 4 is missing")

    monkeypatch.setattr("mvseg.pipeline.run_scene.match_given", fail)
    with warns_of("dark_photo"), pytest.raises(InputError, match="view 4 is missing"):
        run_scene(plant, plant / "masks", IDS_ONLY)


def test_shapes_with_a_reason_are_doubtful() -> None:
    codes = ([], [], ["two_views"], ["poor_fit"])
    surfaces = {leaf: replace(bent_blade(), reasons=dict.fromkeys(each, "why")) for leaf, each in enumerate(codes, 1)}
    finding = _find_doubtful(surfaces, [])
    assert finding.values == {"count": 2, "total": 4, "leaves": ("3", "4")}
    finding = _find_doubtful(surfaces, [4])
    assert finding.values == {"count": 1, "total": 3, "leaves": ("3",)}
    assert _find_doubtful({1: surfaces[2]}, []) is None
