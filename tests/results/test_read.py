"""Result folders read back: the way there and back, results of earlier versions, and what is refused."""

from __future__ import annotations

import json
import math
import shutil
import tracemalloc
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from known_leaves import bent_blade, make_surface
from mvseg import load_result
from mvseg.config import RunConfig
from mvseg.corrections.corrected import Fate
from mvseg.corrections.file import Corrections, Reject
from mvseg.crop import Crop
from mvseg.errors import InputError
from mvseg.findings.finding import Finding
from mvseg.formats.run_lengths import decode_crop, decode_rle, encode_mask
from mvseg.masks import Origin
from mvseg.matching.result import MatchReport
from mvseg.reconstruction.surface.leaf_surface import LeafSurface
from mvseg.results.folder import save_result
from mvseg.results.result import Instances, Result
from mvseg.results.run_record import load_run
from mvseg.results.shapes_file import write_surfaces
from mvseg.runs.one_scene import run_one_scene
from mvseg.runs.request import RunRequest
from mvseg.traits.config import TraitsConfig
from mvseg.traits.measure import measure_plant
from same_result import assert_same_result

LAWFUL = ("instances.json", "traits.csv", "surfaces.npz", "voxels.npz")  # the same bytes again, so exact numbers


@pytest.fixture(scope="module")
def rich(result: Result) -> Result:
    """Something of everything that a result may hold: a surface, one with doubts, voxels, and a leaf without a shape;
    masks of every origin, one unmatched; and corrections."""
    masks = result.masks
    origin = torch.arange(len(masks)) % len(Origin)
    ids = masks.instance_ids.clone()
    ids[-1] = -1
    scores = torch.where(origin > 0, torch.linspace(0.11111, 0.99999, len(masks)), torch.nan)
    masks = replace(masks, origin=origin, instance_ids=ids, detection_scores=scores, classes=1 + (ids == 1).long())
    report = MatchReport("nview", True, 2, 0.75, torch.tensor([0.5, math.nan, 0.25, 1.0]))
    matching = replace(result.matching, masks=masks, report=report)
    doubtful = make_surface(bent_blade().coefficients.numpy() + 3, is_oriented=False, iou=0.8)
    doubtful = replace(doubtful, reasons={"one_sided": "seen from one side", "frayed": "frayed"})
    assert result.voxels is not None
    surfaces = {1: bent_blade(), 2: doubtful, 3: LeafSurface.none(torch.tensor([0]), "test", "seen in one view only")}
    scene = replace(result.scene, up=(0.0, 0.6, 0.8))
    config = TraitsConfig(min_sure_views=0, min_visible_share=0, min_quality=0.9, leaves_only=False)
    voxels = {1: result.voxels[1]}
    traits = measure_plant(scene, matching, surfaces=surfaces, voxels=voxels, config=config)
    assert [*traits.rejected.values()] == ["low_quality"]
    return Result(
        scene=scene,
        matching=matching,
        instances=Instances({1: 0.98765, 2: 0.5}, surfaces=surfaces, voxels=voxels, traits=traits),
        seconds={"match": 1.23456},
        mask_kind="label images",
        corrections=Corrections((Reject(view="000", at=(3.0, 4.0), by="me"),)),
        fates=(Fate(1, "reject", "points at nothing", "there is no mask at (3, 4)"),),
    )


@pytest.fixture(scope="module")
def ids_only(result: Result) -> Result:
    return replace(result, instances=Instances())


ODD = Finding("images_missing", "masks.json", {"count": 1, "first": "a", "found": ("b", "c")}, (1,))


@pytest.mark.parametrize("name", ["result", "rich", "ids_only"])
def test_there_and_back(name: str, tmp_path: Path, request: pytest.FixtureRequest) -> None:
    result = request.getfixturevalue(name)
    save_result(result, tmp_path / "out", {"mvseg": "1.2.3", "findings": [ODD.as_json()], "config": {"seed": 5}})
    loaded = load_result(tmp_path / "out")
    assert_same_result(result, loaded)
    assert loaded.run is not None
    assert (loaded.run.mvseg, loaded.run.list_findings(), loaded.run.config) == ("1.2.3", (ODD,), {"seed": 5})
    for view, again in zip(result.scene.views, loaded.scene.views, strict=True):
        assert view.path.resolve() == again.path
        assert (view.lens is None) == (again.lens is None)
    save_result(loaded, tmp_path / "again")
    assert_same_result(loaded, load_result(tmp_path / "again"), relative=0, absolute=0)
    for file in LAWFUL:
        assert (tmp_path / "again" / file).is_file() == (tmp_path / "out" / file).is_file()
        if (tmp_path / "out" / file).is_file():
            assert (tmp_path / "again" / file).read_bytes() == (tmp_path / "out" / file).read_bytes(), file
    before, after = (json.loads((tmp_path / place / "run.json").read_text()) for place in ("out", "again"))
    assert {key for key in before | after if before.get(key) != after.get(key)} <= {"files"}


@given(st.integers(1, 9), st.integers(1, 9), st.lists(st.booleans(), min_size=81, max_size=81))
@settings(deadline=None, max_examples=40)
def test_crops_are_those_of_whole_masks(height: int, width: int, pixels: list[bool]) -> None:
    """The slow twin decodes the whole image."""
    mask = np.array(pixels[: height * width]).reshape(height, width)
    counts = encode_mask(mask)["counts"]
    crop = decode_crop(counts, width, height)
    whole = decode_rle(counts, width, height)
    assert crop.box == Crop.of(whole.copy()).box
    np.testing.assert_array_equal(crop.pixels, crop.cut(whole))


def test_runs_of_no_pixels_change_nothing() -> None:
    crop = decode_crop([3, 0, 1, 2, 0, 1, 5], 4, 3)
    np.testing.assert_array_equal(crop.pixels, crop.cut(decode_rle([3, 0, 1, 2, 0, 1, 5], 4, 3)))


def test_masks_of_large_photos_load_in_little_memory(result: Result, tmp_path: Path) -> None:
    """Five views of twelve megapixels with ten masks each: no frame is filled for any of them."""
    save_result(replace(result, instances=Instances()), tmp_path, report=False)
    path = tmp_path / "instances.json"
    content = json.loads(path.read_text())
    straight, size = content["images"][0], {"width": 4000, "height": 3000}
    frame = np.zeros((3000, 4000), bool)
    frame[1000:1400, 2000:2300] = np.add.outer(np.arange(400), np.arange(300)) % 97 > 30  # in stripes: 2400 runs
    mask = content["annotations"][0] | {"segmentation": encode_mask(frame)}
    content["images"] = [straight | size | {"id": n, "name": f"{n}", "file_name": f"{n}.png"} for n in range(5)]
    content["annotations"] = [mask | {"image_id": n % 5} for n in range(50)]
    path.write_text(json.dumps(content))
    change_run(tmp_path, files={})
    tracemalloc.start()
    result = load_result(tmp_path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < frame.size  # bytes
    assert len(result.masks) == 50
    assert result.regions.areas.unique().tolist() == [int(frame.sum())]


def test_photos_that_moved_with_the_result_are_found(plant: Path, tmp_path: Path) -> None:
    shutil.copytree(plant, tmp_path / "before" / "plant")
    before = tmp_path / "before"
    run_one_scene(RunRequest(before / "plant", before / "plant" / "masks", before / "out", RunConfig(reconstruct=None)))
    before.rename(tmp_path / "after")
    views = load_result(tmp_path / "after" / "out").scene.views
    assert [view.path.parent for view in views] == [tmp_path / "after" / "plant" / "images"] * 4
    assert all(view.path.is_file() for view in views)


@pytest.fixture
def saved(rich: Result, tmp_path: Path) -> Path:
    save_result(rich, tmp_path / "out", report=False)
    return tmp_path / "out"


def change_run(folder: Path, **changes: Any) -> None:
    path = folder / "run.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | changes))


def test_a_newer_format_is_refused(saved: Path) -> None:
    change_run(saved, format=3)
    message = r"out: is a result of format 3, and mvseg \S+ reads those up to 2; expected a newer mvseg$"
    with pytest.raises(InputError, match=message):
        load_result(saved)


@pytest.mark.parametrize("name", ["surfaces.npz", "voxels.npz", "traits.csv"])
def test_a_file_that_is_missing_or_cut_is_named(saved: Path, name: str) -> None:
    data = (saved / name).read_bytes()
    for content in (b"", data[: len(data) // 2], b"PK" + data[2:9] + data[:3]):
        (saved / name).write_bytes(content)
        with pytest.raises(InputError, match=rf"{name[:6]}\S+: "):
            load_result(saved)
    (saved / name).unlink()
    with pytest.raises(InputError, match=f"{name}: is missing, expected the whole result that run.json lists"):
        load_result(saved)


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("surfaces.npz", {"num_views": np.array([9, 9, 9])}),
        ("surfaces.npz", {"coefficients": np.zeros((3, 25, 3))}),
        ("surfaces.npz", {"leaf": np.array([1, 2])}),
        ("voxels.npz", {"origin": np.zeros((0, 3))}),
        ("voxels.npz", {"leaf": np.array([4])}),
        ("surfaces.npz", {"coefficients": np.full((3, 26, 3), np.nan)}),  # and no reason why
        ("surfaces.npz", {"coefficients": np.full((3, 26, 3), np.inf)}),
        ("voxels.npz", {"voxel_size": np.array([np.nan])}),
    ],
)
def test_arrays_that_do_not_fit_are_refused(saved: Path, name: str, change: dict[str, Any]) -> None:
    with np.load(saved / name) as file:
        arrays = dict(file)
    np.savez(saved / name, **(arrays | change))
    with pytest.raises(InputError, match=f"{name}: holds no"):
        load_result(saved)


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("surfaces.npz", lambda path: write_surfaces(path, {1: bent_blade(), 2: bent_blade()})),
        ("traits_wide.csv", lambda path: path.write_text("".join(path.read_text().splitlines(keepends=True)[:-1]))),
        ("instances.json", lambda path: path.write_text(path.read_text().replace('_id": 1', '_id": 2', 1))),
    ],
)
def test_files_that_run_json_does_not_list_are_refused(saved: Path, name: str, change: Callable[[Path], None]) -> None:
    """Each of them can be read: of another result, or cut between two rows."""
    change(saved / name)
    with pytest.raises(InputError, match=f"{name}: is not the file that run.json lists: changed since, or another"):
        load_result(saved)


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("traits", {"unit": 3}, r"run\.json: traits\.unit: "),
        ("findings", "odd", r"run\.json: findings: "),
        ("edits", [{"op": "sparkle"}], "edit 1: "),
        ("format", 0, "format: Input should be greater than or equal to 1"),
    ],
)
def test_what_run_json_says_is_checked(saved: Path, key: str, value: object, message: str) -> None:
    change_run(saved, **{key: value})
    with pytest.raises(InputError, match=message):
        load_result(saved)


def test_ids_of_a_stranger_in_run_json_are_no_numbers_without_an_end(saved: Path) -> None:
    change_run(saved, traits={"unit": "mm", "up": None, "rejected": {"9" * 5000: "stem", "x": "stem", "2": "stem"}})
    assert load_run(saved).traits.kinds == {2: "stem"}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda image: image["camera"].update(R=[[1, 0, 0]] * 3), "view 2: R is not a rotation"),
        (lambda image: image["camera"]["lens"].update(model="EYE"), "image 002: its lens is none of COLMAP's"),
        (lambda image: image.update(file_name="../x.png"), r"image \.\./x\.png: "),
        (lambda image: image.update(name="000"), "views 0 and 2 have the same name"),
    ],
)
def test_broken_cameras_are_named(saved: Path, change: Callable[[Any], object], message: str) -> None:
    content = json.loads((saved / "instances.json").read_text())
    change(content["images"][2])
    (saved / "instances.json").write_text(json.dumps(content))
    with pytest.raises(InputError, match=rf"instances\.json: {message}"):
        load_result(saved)


def test_a_result_of_an_earlier_format_is_refused_with_what_to_do(saved: Path) -> None:
    run = json.loads((saved / "run.json").read_text())
    del run["format"]
    (saved / "run.json").write_text(json.dumps(run))
    with pytest.raises(InputError, match="has the format of an earlier version; mvseg infer --again"):
        load_result(saved)
