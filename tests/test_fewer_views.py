"""Runs that take some of a scene's views: the same as of a scene that has no others, and nothing is lost in silence."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from mvseg import Corrections, InputError, ReconstructConfig, RunConfig, run_scene
from mvseg.cli import main
from mvseg.corrections.file import FORMAT, parse_corrections
from mvseg.pipeline.open_scene import open_scene
from mvseg.reconstruction.spread_views import find_repeated
from mvseg.server.open_result import OpenResult
from mvseg.server.saved_edits import CORRECTIONS_FILE
from scene_folders import write_scene
from warned import warns_of

IDS_ONLY = RunConfig(reconstruct=None)
SHAPES = ["--reconstruct.shape", "voxels", "--reconstruct.voxel_budget", "500"]
COARSE = RunConfig(reconstruct=ReconstructConfig(shape="voxels", voxel_budget=500))


@pytest.fixture(scope="module")
def plant(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_scene(tmp_path_factory.mktemp("scenes") / "plant", num_views=9)


def taken(folder: Path, views: Any, **how: Any) -> list[str]:
    """Names of the views that a run from photos takes."""
    opened = open_scene(folder, None, replace(IDS_ONLY, views=views), **how)
    names = [view.name for view in opened.scene.views]
    assert sorted([*names, *opened.views_left_out]) == [f"{view:03d}" for view in range(9)]
    return names


def with_views(folder: Path, copy: Path, views: list[int]) -> Path:
    """A copy of a scene whose rig file lists these views, in this order."""
    shutil.copytree(folder, copy)
    rig = json.loads((copy / "cameras.json").read_text())
    (copy / "cameras.json").write_text(json.dumps(rig | {"views": [rig["views"][view] for view in views]}))
    return copy


def rejects(*views: str) -> Corrections:
    edits = [{"op": "reject", "view": view, "at": [1, 1]} for view in views]
    return parse_corrections({"format": FORMAT, "edits": edits})


def test_views_of_one_place_count_once(plant: Path, tmp_path: Path) -> None:
    """Of a burst, or of a film with equal frames."""
    twice = tmp_path / "twice"
    shutil.copytree(plant, twice)
    rig = json.loads((twice / "cameras.json").read_text())
    for view in [*rig["views"]]:
        copy = view["file"].replace("images/", "images/again-")
        shutil.copy(twice / view["file"], twice / copy)
        rig["views"].append(view | {"file": copy})
        mask = twice / "masks" / f"{Path(view['file']).stem}.png"
        shutil.copy(mask, mask.with_name(f"again-{mask.name}"))
    (twice / "cameras.json").write_text(json.dumps(rig))
    with warns_of("views_repeated"):
        opened = open_scene(twice, None, replace(IDS_ONLY, views="all"))
    assert [view.name for view in opened.scene.views] == [f"{view:03d}" for view in range(9)]
    assert len(opened.views_left_out) == 9
    assert not find_repeated(opened.scene.cameras).any()
    with warns_of("views_repeated"):
        once = run_scene(twice, twice / "masks", IDS_ONLY)
    assert torch.equal(once.masks.instance_ids, run_scene(plant, plant / "masks", IDS_ONLY).masks.instance_ids)
    assert len(open_scene(twice, twice / "masks", replace(IDS_ONLY, views="all")).scene.views) == 18


def test_it_is_the_run_of_a_scene_without_the_other_views(plant: Path, tmp_path: Path) -> None:
    with warns_of("masks_of_other_views"):
        some = run_scene(plant, plant / "masks", replace(COARSE, views=4))
    names = [view.name for view in some.scene.views]
    assert names == taken(plant, 4) != ["000", "001", "002", "003"]
    alone = run_scene(with_views(plant, tmp_path / "plant", [*map(int, names)]), plant / "masks", COARSE)
    assert torch.equal(some.masks.instance_ids, alone.masks.instance_ids)
    assert torch.equal(some.regions.crops, alone.regions.crops)
    assert torch.equal(some.scene.cameras.R, alone.scene.cameras.R)
    assert some.voxels is not None
    assert alone.voxels is not None
    assert all(torch.equal(some.voxels[instance].votes, alone.voxels[instance].votes) for instance in alone.voxels)
    assert (len(some.views_left_out), alone.views_left_out) == (5, ())


@pytest.mark.parametrize("most", [2, 4, 7])
def test_the_order_of_the_views_does_not_matter(plant: Path, tmp_path: Path, most: int) -> None:
    """The scene is the mirror image of itself, so that many choices are equally good."""
    order = [3, 8, 0, 5, 1, 7, 2, 6, 4]
    assert sorted(taken(with_views(plant, tmp_path / "plant", order), most)) == taken(plant, most)


def test_photos_alone_are_as_many_as_are_enough_and_given_masks_are_all(
    plant: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert len(taken(plant, None)) == 9
    monkeypatch.setattr("mvseg.pipeline.open_scene.ENOUGH_VIEWS", 5)
    assert taken(plant, None) == taken(plant, 5)
    assert len(taken(plant, "all")) == len(taken(plant, 9)) == len(taken(plant, 500)) == 9
    assert len(run_scene(plant, plant / "masks", IDS_ONLY).regions) == 27


def test_views_that_corrections_name_are_taken_besides(plant: Path) -> None:
    few = taken(plant, 4)
    absent, other, *_ = (f"{view:03d}" for view in range(9) if f"{view:03d}" not in few)
    assert taken(plant, 4, corrections=rejects(few[1])) == few
    assert taken(plant, 4, corrections=rejects(absent, f"{other}.png", "nowhere")) == sorted([*few, absent, other])
    with warns_of("masks_of_other_views", "edit") as noticed:  # not of the views: the edits find their photos
        run_scene(plant, plant / "masks", replace(IDS_ONLY, views=4), corrections=rejects(absent))
    of_code = {each.code: each for each in noticed}
    assert [of_code["masks_of_other_views"].values[name] for name in ("count", "total", "taken")] == [12, 27, 5]
    assert f"there is no mask at (1, 1) in view {absent}" in str(of_code["edit"])


def test_a_result_says_which_views_it_shows_and_is_made_again_with_them(
    plant: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    plain = ["--out", str(out), "--quiet", "--report", "false", *SHAPES]
    assert main(["infer", str(plant), "--masks", "masks", "--views", "5", *plain]) == 0
    said = capsys.readouterr()
    assert "mvseg: 5 of 9 views are taken\n" in said.err
    assert "12 of 27 masks are left out" in said.err
    assert "from 15 masks (label images) in 5 views" in said.out
    run = json.loads((out / "run.json").read_text())
    assert run["views"]["taken"] == taken(plant, 5)
    assert sorted(run["views"]["taken"] + run["views"]["left_out"]) == [f"{view:03d}" for view in range(9)]
    assert [image["name"] for image in json.loads((out / "instances.json").read_text())["images"]] == taken(plant, 5)
    assert sorted(path.stem for path in (out / "labels").iterdir()) == taken(plant, 5)
    assert main(["infer", "--again", str(out), "--quiet"]) == 0
    assert json.loads((out / "run.json").read_text())["views"] == run["views"]
    assert main(["match", str(plant), "--masks", "masks", *plain[2:5], "--out", str(tmp_path / "all")]) == 0
    run = json.loads((tmp_path / "all" / plant.name / "run.json").read_text())
    assert run["views"] == {"taken": taken(plant, "all"), "left_out": []}


def test_a_result_is_corrected_in_its_own_views_and_in_those_that_were_corrected_before(
    plant: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    words = ["--masks", "masks", "--views", "4", "--out", str(out), "--quiet", "--report", "false", *SHAPES]
    assert main(["infer", str(plant), *words]) == 0
    few = taken(plant, 4)
    with warns_of("masks_of_other_views"):
        assert [view.name for view in OpenResult(out).scene.views] == few
    other = next(f"{view:03d}" for view in range(9) if f"{view:03d}" not in few)
    edits = [{"op": "reject", "view": other, "at": [1, 1]}]
    (out / CORRECTIONS_FILE).write_text(json.dumps({"format": FORMAT, "edits": edits}))
    with warns_of("masks_of_other_views"):
        assert [view.name for view in OpenResult(out).scene.views] == sorted([*few, other])


@pytest.mark.parametrize("views", [1, 0, -3])
def test_ids_need_two_views(views: int) -> None:
    with pytest.raises(InputError, match=f"views is {views}, expected 2 or more, or all"):
        RunConfig(views=views)


def test_a_wrong_number_is_one_sentence(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["infer", "--views", "some"]) == 2
    assert capsys.readouterr().err.startswith("mvseg: error: --views is some, expected ")
