"""The result folder: every file, what it says, and that it is there whole or not at all."""

from __future__ import annotations

import csv
import errno
import json
import os
import re
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
import trimesh

import mvseg.results.folder
import mvseg.results.plant_files
import mvseg.results.report.page
from known_leaves import bent_blade
from mvseg.config import RunConfig
from mvseg.errors import InputError
from mvseg.formats.label_png import read_label_png
from mvseg.formats.scene_folder import load_masks
from mvseg.pipeline.run_scene import run_scene
from mvseg.reconstruction.surface.leaf_surface import LeafSurface
from mvseg.results.earlier import RESULT, Output, check_out, replace_result
from mvseg.results.folder import save_result
from mvseg.results.overlay import instance_color
from mvseg.results.read import read_instances
from mvseg.results.result import Instances, Result
from mvseg.system.file_hash import hash_files
from mvseg.traits.measure import measure_plant
from scene_folders import BALLS, HEIGHT, RADIUS, WIDTH, arc_pose, draw_labels, rig_content, write_image, write_scene
from warned import warns_of

Patch = pytest.MonkeyPatch
DISTORTED = 2  # the view
IDS_FILES = {
    *(f"labels/{view:03d}.png" for view in range(4)),
    *(f"overlay/{view:03d}.png" for view in range(4)),
    "before_edits.bin",
    "instances.json",
    "report.html",
    "run.json",
}
SHAPE_FILES = {
    *(f"leaves/leaf_{leaf:03d}.ply" for leaf in (1, 2, 3)),
    "plant.json", "scene.glb", "traits.csv", "traits_wide.csv", "voxels.npz",
}  # fmt: skip


@pytest.fixture(scope="module")
def saved(result: Result, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("results") / "new" / "plant"
    save_result(result, out, {"mvseg": "1.2.3", "config": {"seed": 5}})
    return out


def ids_only(result: Result) -> Result:
    return replace(result, instances=Instances())


def files_below(folder: Path) -> set[str]:
    return {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()}


def read_rows(folder: Path) -> list[dict[str, str]]:
    return list(csv.DictReader((folder / "traits_wide.csv").read_text().splitlines()))


def label_of_balls(folder: Path, plant: Path) -> list[list[int]]:
    """Per view, the label that covers most of each ball."""
    labels_of_balls = []
    for view in range(4):
        truth = read_label_png(plant / "truth" / f"{view:03d}.png", WIDTH, HEIGHT)
        labels = read_label_png(folder / "labels" / f"{view:03d}.png", WIDTH, HEIGHT)
        labels_of_balls.append([int(np.bincount(labels[truth == ball]).argmax()) for ball in (1, 2, 3)])
    return labels_of_balls


class TestContent:
    def test_what_the_matcher_is_unsure_of_is_said(self, result: Result, tmp_path: Path) -> None:
        report = replace(result.matching.report, residual_px=2)
        is_unsure = result.masks.view_index < result.masks.instance_ids - 1  # instance 2 in one view, 3 in two
        scores = torch.where(is_unsure, 0.1, 0.9)
        masks = replace(result.masks, match_scores=scores)
        matching = replace(result.matching, masks=masks, report=report)
        traits = measure_plant(result.scene, matching, surfaces=None, voxels=result.voxels or {})
        instances = replace(result.instances, traits=traits)
        save_result(replace(result, matching=matching, instances=instances), tmp_path / "out", {})
        assert [row["sure_views"] for row in read_rows(tmp_path / "out")] == ["4", "3", "2"]
        assert json.loads((tmp_path / "out" / "run.json").read_text())["residual_px"] == 2

    def test_labels_are_ids_in_the_frame_of_the_photo(self, saved: Path, plant: Path, result: Result) -> None:
        for view in range(4):
            labels = read_label_png(saved / "labels" / f"{view:03d}.png", WIDTH, HEIGHT)
            masks = read_label_png(plant / "masks" / f"{view:03d}.png", WIDTH, HEIGHT)
            expected = np.zeros_like(masks)
            for index in (result.regions.view_index == view).nonzero()[:, 0].tolist():
                expected[masks == int(result.regions.labels[index])] = result.matching.instance_ids[index]
            if view == DISTORTED:  # there and back through the lens
                assert (labels != expected).mean() < 0.01
            else:
                np.testing.assert_array_equal(labels, expected)

    def test_instances_agree_with_labels(self, saved: Path, result: Result) -> None:
        content = json.loads((saved / "instances.json").read_text())
        assert [image["file_name"] for image in content["images"]] == [f"{view:03d}.png" for view in range(4)]
        assert len(content["annotations"]) == len(result.regions) == 12
        for index, entry in enumerate(content["annotations"]):
            view = entry["image_id"] - 1
            labels = read_label_png(saved / "labels" / f"{view:03d}.png", WIDTH, HEIGHT)
            assert entry["instance_id"] == entry["track_id"] == result.matching.instance_ids[index]
            assert entry["attributes"] == {"instance_id": entry["instance_id"], "track_id": entry["instance_id"]}
            assert (labels == entry["instance_id"]).sum() == entry["area"]
            assert 0 < entry["match_score"] <= 1
            assert entry["source_label"] == result.regions.labels[index]

    def test_shapes(self, saved: Path, plant: Path, result: Result) -> None:
        rows = read_rows(saved)
        scene = trimesh.load_scene(saved / "scene.glb")
        assert set(scene.graph.nodes_geometry) == {"leaf_001", "leaf_002", "leaf_003"}
        for leaf, row in enumerate(rows, start=1):
            assert (row["leaf"], row["num_views"], row["unit"]) == (str(leaf), "4", "mm")
            mesh = trimesh.load_mesh(saved / "leaves" / f"leaf_{leaf:03d}.ply")
            assert mesh.is_watertight
            assert float(row["volume"]) == pytest.approx(mesh.volume, rel=0.1)
            assert float(row["volume"]) > 0.9 * 4 / 3 * np.pi * RADIUS**3  # a hull of four silhouettes
            low, high = ([float(row[f"{axis}_{end}"]) for axis in "xyz"] for end in ("min", "max"))
            np.testing.assert_allclose(mesh.bounds, [low, high], atol=1.5)
            ball = label_of_balls(saved, plant)[0].index(leaf)
            np.testing.assert_allclose((np.array(low) + high) / 2, BALLS[ball], atol=2)
            np.testing.assert_array_equal(mesh.visual.vertex_colors[0], [*instance_color(leaf), 255])

    def test_run_file(self, saved: Path) -> None:
        run = json.loads((saved / "run.json").read_text())
        assert (run["mvseg"], run["config"]) == ("1.2.3", {"seed": 5})
        assert run["counts"] == {"regions": 12, "instances": 3}
        assert set(run["seconds"]) == {"load", "match", "choose", "check", "voxels", "measure"}

    def test_every_file_and_field_is_described(self, saved: Path) -> None:
        described = (Path(__file__).parents[2] / "docs" / "results.md").read_text(encoding="utf-8")
        content = json.loads((saved / "instances.json").read_text())
        rows = (saved / "traits.csv").read_text().splitlines()
        names = {*content["annotations"][0], *content["images"][0], *rows[0].split(","), "score"}
        names |= json.loads((saved / "run.json").read_text()).keys() - {"config"}
        names |= {path.name for path in saved.iterdir() if path.is_file()}
        assert [name for name in sorted(names) if f"`{name}`" not in described] == []


class TestVariants:
    def test_without_a_report(self, result: Result, tmp_path: Path) -> None:
        save_result(ids_only(result), tmp_path / "out", {}, report=False)
        assert files_below(tmp_path / "out") == IDS_FILES - {"report.html"}
        assert (tmp_path / "out").stat().st_mode & 0o777 == 0o755  # other people can read it

    def test_leaves_have_few_triangles_in_the_scene_and_all_in_their_files(
        self, result: Result, tmp_path: Path, monkeypatch: Patch
    ) -> None:
        monkeypatch.setattr(mvseg.results.plant_files, "MAX_FACES", 300)
        save_result(result, tmp_path / "out", {})
        shown = trimesh.load_scene(tmp_path / "out" / "scene.glb")
        for leaf in (1, 2, 3):
            full = trimesh.load_mesh(tmp_path / "out" / "leaves" / f"leaf_{leaf:03d}.ply")
            small = shown.geometry[f"leaf_{leaf:03d}"]
            assert len(small.faces) <= 300 < len(full.faces)
            assert small.volume == pytest.approx(full.volume, rel=0.05)

    def test_unmatched_regions(self, result: Result, tmp_path: Path) -> None:
        ids = result.matching.instance_ids.clone()
        ids[ids == 2] = -1
        matching = result.matching.with_masks(replace(result.masks, instance_ids=ids))
        save_result(replace(ids_only(result), matching=matching), tmp_path / "out", {})
        annotations = json.loads((tmp_path / "out" / "instances.json").read_text())["annotations"]
        assert [entry["instance_id"] for entry in annotations].count(-1) == 4
        assert {entry["instance_id"] for entry in annotations} == {-1, 1, 3}
        assert {entry.get("track_id") for entry in annotations} == {None, 1, 3}
        unmatched = [entry["attributes"] for entry in annotations if "track_id" not in entry]
        assert unmatched == [{"instance_id": -1}] * 4
        paths = (tmp_path / "out" / "labels").iterdir()
        numbers_per_view = [np.unique(read_label_png(path, WIDTH, HEIGHT)) for path in paths]
        assert [numbers.tolist() for numbers in numbers_per_view] == [[0, 1, 3]] * 4

    def test_an_instance_without_shape_has_a_row_but_no_mesh(self, result: Result, tmp_path: Path) -> None:
        assert result.voxels is not None
        voxels = {instance: grid for instance, grid in result.voxels.items() if instance != 2}
        traits = measure_plant(result.scene, result.matching, surfaces=None, voxels=voxels)
        save_result(replace(result, instances=Instances(voxels=voxels, traits=traits)), tmp_path / "out", {})
        rows = read_rows(tmp_path / "out")
        assert [row["leaf"] for row in rows] == ["1", "2", "3"]
        assert [row["quality"] == "good" for row in rows] == [True, False, True]
        assert [row["volume"] == "" for row in rows] == [False, True, False]
        assert files_below(tmp_path / "out" / "leaves") == {"leaf_001.ply", "leaf_003.ply"}

    def test_surfaces_and_voxels_side_by_side(self, result: Result, tmp_path: Path) -> None:
        """Leaf 1 has both, leaf 2 a surface only, leaf 3 a surface that is none, and voxels."""
        assert result.voxels is not None
        blade = bent_blade()
        none = LeafSurface.none(torch.tensor([0]), "test", "seen in one view only")
        surfaces, voxels = {1: blade, 2: blade, 3: none}, {1: result.voxels[1], 3: result.voxels[3]}
        instances = replace(result.instances, surfaces=surfaces, voxels=voxels)
        save_result(replace(result, instances=instances), tmp_path / "out", {})
        folder = tmp_path / "out" / "leaves"
        assert files_below(folder) == {*(f"leaf_00{leaf}.ply" for leaf in (1, 2, 3)), "leaf_001_voxels.ply"}
        closed = [trimesh.load_mesh(folder / f"leaf_00{leaf}.ply").is_watertight for leaf in (1, 2, 3)]
        assert closed == [False, False, True]
        assert trimesh.load_mesh(folder / "leaf_001_voxels.ply").is_watertight
        scene = trimesh.load_scene(tmp_path / "out" / "scene.glb")
        sizes = {name: len(mesh.faces) for name, mesh in scene.geometry.items()}
        assert sizes["leaf_001"] == sizes["leaf_002"] == len(blade.mesh().faces) != sizes["leaf_003"]

    def test_scene_glb_is_in_metres_with_y_up(self, result: Result, tmp_path: Path) -> None:
        placed = replace(result, scene=replace(result.scene, unit="mm", up=(0.0, 0.0, 1.0)))
        save_result(placed, tmp_path / "out", {})
        shown = trimesh.load_scene(tmp_path / "out" / "scene.glb")
        for leaf in (1, 2, 3):
            x, y, z = np.moveaxis(trimesh.load_mesh(tmp_path / "out" / "leaves" / f"leaf_{leaf:03d}.ply").bounds, 1, 0)
            pose, name = shown.graph[f"leaf_{leaf:03d}"]
            back = shown.geometry[name].copy().apply_transform(pose)
            np.testing.assert_allclose(back.bounds, np.sort(np.stack([x, z, -y], 1) / 1000, axis=0), atol=1e-6)

    def test_without_photos_overlays_are_drawn_on_grey(self, tmp_path: Path) -> None:
        plant = write_scene(tmp_path / "plant", images=False)
        save_result(run_scene(plant, plant / "masks", RunConfig(reconstruct=None)), tmp_path / "out", {})
        assert files_below(tmp_path / "out") == IDS_FILES
        overlay = cv2.imread(str(tmp_path / "out" / "overlay" / "000.png"))
        assert overlay[0, 0].tolist() == [40, 40, 40]
        assert overlay.max() > 200

    def test_views_in_subfolders(self, tmp_path: Path) -> None:
        rig, names = rig_content(), ("left/1", "left/2", "right/1", "right/2")
        plant = tmp_path / "plant"
        for view, name in enumerate(names):
            rig["views"][view]["file"] = f"images/{name}.jpg"
            write_image(plant / "masks" / f"{name}.png", draw_labels(*arc_pose(view, 4)))
        (plant / "cameras.json").write_text(json.dumps(rig))
        result = run_scene(plant, plant / "masks", RunConfig(reconstruct=None))
        save_result(result, tmp_path / "out", {})
        for kind in ("labels", "overlay"):
            assert files_below(tmp_path / "out" / kind) == {f"{name}.png" for name in names}
        again = load_masks(result.scene, tmp_path / "out" / "instances.json")
        assert torch.equal(again.crops, result.regions.crops)
        assert torch.equal(again.view_index, result.regions.view_index)


WRITERS = [
    "write_label_png", "draw_overlay", "draw_picture", "write_png", "write_coco",
    "write_voxels", "write_ply", "write_glb", "write_long", "write_wide", "write_report",
]  # fmt: skip


OF_A_PLANT = ("write_voxels", "write_ply", "write_glb", "write_long", "write_wide")
SEVERAL_TIMES = ("write_label_png", "draw_overlay", "draw_picture", "write_png", "write_ply")


class TestWholeOrNotAtAll:
    @pytest.mark.parametrize(
        ("writer", "error"),
        [
            *((writer, OSError(28, "No space left on device")) for writer in WRITERS),
            ("write_ply", RuntimeError("bug")),
            ("draw_picture", KeyboardInterrupt()),
        ],
    )
    def test_a_failure_half_way_leaves_nothing(
        self, writer: str, error: BaseException, result: Result, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        home = mvseg.results.plant_files if writer in OF_A_PLANT else mvseg.results.folder
        home = mvseg.results.report.page if writer == "write_report" else home
        original, calls = getattr(home, writer), []

        def fail_at_the_second_call(*args: object, **named: object) -> object:
            calls.append(args)
            if len(calls) == 2 or writer not in SEVERAL_TIMES:
                raise error
            return original(*args, **named)

        monkeypatch.setattr(home, writer, fail_at_the_second_call)
        expected = InputError if isinstance(error, OSError) else type(error)
        with pytest.raises(expected):
            save_result(result, tmp_path / "out", {})
        assert list(tmp_path.iterdir()) == []

        monkeypatch.undo()
        save_result(ids_only(result), tmp_path / "out", {"first": True})
        before = {name: (tmp_path / "out" / name).read_bytes() for name in files_below(tmp_path / "out")}
        calls.clear()
        monkeypatch.setattr(home, writer, fail_at_the_second_call)
        with pytest.raises(expected):
            save_result(result, tmp_path / "out", {"first": False})
        assert [path.name for path in tmp_path.iterdir()] == ["out"]
        assert {name: (tmp_path / "out" / name).read_bytes() for name in files_below(tmp_path / "out")} == before

    def test_files_of_the_user_stay(self, result: Result, tmp_path: Path) -> None:
        out = tmp_path / "out"
        save_result(result, out, {})
        (out / "metrics.json").write_text("{}")
        (out / "notes").mkdir()
        (out / "notes" / "day 1.txt").write_text("watered")
        (out / "notes" / "photos").symlink_to(tmp_path / "nowhere")
        (out / ".git" / "refs").mkdir(parents=True)
        (out / ".corrections.json.partial").touch()  # of a program that saves edits at this moment
        kept = [out, out / "metrics.json", out / "notes" / "day 1.txt", out / ".git" / "refs"]
        before = [path.stat().st_ino for path in kept]
        for _ in range(2):
            save_result(ids_only(result), out, {})
            assert files_below(out) == IDS_FILES | {".corrections.json.partial", "metrics.json", "notes/day 1.txt"}
            assert (out / "notes" / "photos").is_symlink()
            assert [path.stat().st_ino for path in kept] == before  # not even copied

    def test_an_edit_that_is_saved_meanwhile_stays(self, result: Result, tmp_path: Path) -> None:
        out = tmp_path / "out"
        save_result(result, out, {})
        for moment in ("first", "last"):
            with replace_result(out, {}, RESULT) as folder:
                (folder / "instances.json").write_text("{}")
                (out / "corrections.json").write_text(moment)
            assert (out / "corrections.json").read_text() == moment

    @pytest.mark.parametrize("name", ["../mine.txt", "labels/../../mine.txt", "/mine.txt", ".."])
    def test_files_outside_of_the_folder_are_never_replaced(self, name: str, result: Result, tmp_path: Path) -> None:
        save_result(ids_only(result), tmp_path / "out", {})
        (tmp_path / "mine.txt").write_text("mine")
        run = json.loads((tmp_path / "out" / "run.json").read_text())
        path = str(tmp_path / "mine.txt") if name.startswith("/") else name
        run["files"][path] = hash_files(tmp_path / "mine.txt")
        (tmp_path / "out" / "run.json").write_text(json.dumps(run))
        with pytest.raises(InputError, match="which is not in this folder"):
            save_result(ids_only(result), tmp_path / "out", {})
        assert (tmp_path / "mine.txt").read_text() == "mine"

    def test_a_folder_that_is_a_link_now_is_not_written_into(self, result: Result, tmp_path: Path) -> None:
        out = tmp_path / "out"
        save_result(ids_only(result), out, {})
        (out / "labels").rename(tmp_path / "theirs")
        (out / "labels").symlink_to(tmp_path / "theirs")
        with pytest.raises(InputError, match="labels"):
            save_result(ids_only(result), out, {})
        assert (out / "labels").is_symlink()

    def test_a_changed_file_of_an_earlier_result_is_not_replaced(self, result: Result, tmp_path: Path) -> None:
        out = tmp_path / "out"
        save_result(ids_only(result), out, {})
        (out / "labels" / "001.png").write_bytes(b"painted by hand")
        with pytest.raises(InputError, match=r"001\.png: was changed after mvseg wrote it, move"):
            save_result(result, out, {})
        assert (out / "labels" / "001.png").read_bytes() == b"painted by hand"
        assert files_below(out) == IDS_FILES

    def test_a_file_of_the_user_with_a_name_of_the_new_result(self, result: Result, tmp_path: Path) -> None:
        out = tmp_path / "out"
        save_result(ids_only(result), out, {})
        (out / "traits.csv").write_text("mine")
        with pytest.raises(InputError, match=r"traits\.csv: was not written by mvseg, but the new result has a file"):
            check_out(out, Output("result", names=("traits.csv",)))  # before the work
        with pytest.raises(InputError, match=r"traits\.csv: was not written .*; the new result is in .*out-1"):
            save_result(result, out, {})
        assert (out / "traits.csv").read_text() == "mine"
        assert sorted(path.name for path in tmp_path.iterdir()) == ["out", "out-1"]
        assert files_below(tmp_path / "out-1") == IDS_FILES | SHAPE_FILES

    def test_a_folder_of_the_user_with_the_name_of_a_written_file(self, result: Result, tmp_path: Path) -> None:
        out = tmp_path / "out"
        save_result(ids_only(result), out, {})
        (out / "instances.json").unlink()
        (out / "instances.json").mkdir()
        (out / "instances.json" / "thesis.txt").write_text("mine")
        with pytest.raises(InputError, match=r"instances\.json: is a folder now"):
            save_result(result, out, {})
        assert (out / "instances.json" / "thesis.txt").read_text() == "mine"

    def test_a_disk_of_its_own_is_refused_before_the_work(self, tmp_path: Path, monkeypatch: Patch) -> None:
        replace, place = os.replace, tmp_path / "out"
        place.mkdir()

        def refuse(source: Any, target: Any) -> None:
            if Path(target).is_relative_to(place):
                raise OSError(errno.EXDEV, "Invalid cross-device link", str(source), None, str(target))
            replace(source, target)

        monkeypatch.setattr(os, "replace", refuse)
        with pytest.raises(InputError, match=r"out: is a disk of its own \(a mount point\)"):
            check_out(place)
        assert list(tmp_path.iterdir()) == [place]
        assert list(place.iterdir()) == []

    def test_an_empty_folder_and_a_link_to_it_are_taken(self, result: Result, tmp_path: Path) -> None:
        (tmp_path / "disk" / "out").mkdir(parents=True)
        (tmp_path / "link").symlink_to(tmp_path / "disk" / "out")
        for _ in range(2):
            save_result(ids_only(result), tmp_path / "link", {})
            assert files_below(tmp_path / "disk" / "out") == IDS_FILES
            assert (tmp_path / "link").is_symlink()
            assert sorted(path.name for path in tmp_path.iterdir()) == ["disk", "link"]


class TestPlaces:
    def test_a_folder_of_other_files_is_refused(self, result: Result, tmp_path: Path) -> None:
        (tmp_path / "thesis.tex").write_text("ten years of work")
        others = "", "{}", "[1]", '{"files": 3}', '{"files": {"\\u0000": ""}}', '{"mvseg": "0.1.0"}'
        for run in (None, *others):  # other programs write run.json, too
            if run is not None:
                (tmp_path / "run.json").write_text(run)
            with pytest.raises(InputError, match="holds files that are not a result of mvseg infer"):
                save_result(result, tmp_path, {})
            assert (tmp_path / "thesis.tex").read_text() == "ten years of work"

    def test_no_right_to_write(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        def refuse(dir: Path) -> None:
            raise PermissionError(13, "Permission denied", str(dir / "tmp"))

        monkeypatch.setattr("mvseg.system.atomic.TemporaryFile", refuse)
        message = f"new/out: the output folder is not writable (Permission denied: {tmp_path})"
        with pytest.raises(InputError, match=re.escape(message)):
            check_out(tmp_path / "new" / "out")

    def test_new_empty_and_earlier_places_are_fine(self, tmp_path: Path) -> None:
        check_out(tmp_path / "a" / "b")
        check_out(tmp_path)
        (tmp_path / "run.json").write_text('{"files": {}}')
        check_out(tmp_path)
        assert [path.name for path in tmp_path.iterdir()] == ["run.json"]


class TestReadInstances:
    def test_no_truth(self, saved: Path, tmp_path: Path) -> None:
        with pytest.raises(InputError, match="absent: no such folder of true labels"):
            read_instances(saved, tmp_path / "absent")

    @pytest.mark.parametrize(
        ("key", "value", "message"),
        [
            ("image_id", 99, r"annotations\[3\]: there is no image 99"),
            ("instance_id", "first", r"annotations\[3\]\.instance_id: Input should be a valid integer"),
            ("segmentation", {"size": [HEIGHT, WIDTH], "counts": "0"}, r"annotations\[3\]: its run lengths do not add"),
            ("segmentation", None, r"annotations\[3\]\.segmentation"),
        ],
    )
    def test_edited(self, saved: Path, tmp_path: Path, plant: Path, key: str, value: object, message: str) -> None:
        broken = shutil.copytree(saved, tmp_path / "broken")
        content = json.loads((broken / "instances.json").read_text())
        content["annotations"][3][key] = value
        (broken / "instances.json").write_text(json.dumps(content))
        with pytest.raises(InputError, match=rf"instances\.json: {message}"):
            read_instances(broken, plant / "truth")

    def test_photos_without_truth_are_left_out_and_counted(self, saved: Path, plant: Path, tmp_path: Path) -> None:
        for view in (0, 3):
            shutil.copy(plant / "truth" / f"{view:03d}.png", tmp_path)
        with warns_of("no_true_labels"):
            regions, truth = read_instances(saved, tmp_path)
        every, all_truth = read_instances(saved, plant / "truth")
        assert regions.num_per_view.tolist() == every.num_per_view[[0, 3]].tolist()
        np.testing.assert_array_equal(truth, [all_truth[0], all_truth[3]])

    def test_truth_of_another_size(self, saved: Path, tmp_path: Path) -> None:
        for view in range(4):
            write_image(tmp_path / f"{view:03d}.png", np.zeros((HEIGHT, WIDTH + 1), np.uint16))
        with pytest.raises(InputError, match=r"000\.png: the mask is 129 x 96, its camera says 128 x 96"):
            read_instances(saved, tmp_path)
