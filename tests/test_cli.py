"""The command line: what a person types, sees and gets; bad input above all."""

from __future__ import annotations

import csv
import io
import json
import os
import re
import runpy
import shutil
import subprocess
import sys
import warnings
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

import mvseg
from mvseg.cli import main
from mvseg.cli.command import VERBS
from mvseg.config import RunConfig
from mvseg.demo import demo_scene
from mvseg.detection.cached_detections import SCENE_FILE
from mvseg.detection.config import DetectConfig
from mvseg.errors import InputWarning, warn
from mvseg.findings.finding import Finding
from mvseg.formats.label_png import read_label_png, write_label_png
from mvseg.formats.run_lengths import encode_mask
from mvseg.matching.config import MatchConfig
from mvseg.matching.match import match_masks
from mvseg.matching.result import Matching
from mvseg.reconstruction.config import ReconstructConfig
from mvseg.traits.config import TraitsConfig
from scene_folders import HEIGHT, WIDTH, cut_file, edit_rig, write_image, write_scene

ROOT = Path(__file__).parent.parent
NAN = float("nan")
Said, Patch = pytest.CaptureFixture[str], pytest.MonkeyPatch
NO_PAGE = ["--report", "false"]
# for tests that look at no shape and at no page
COARSE = ["--reconstruct.shape", "voxels", "--reconstruct.voxel_budget", "500", *NO_PAGE]
SMALL = ["--detect.image_size", "128"]  # for those that look at no detection: one size, and as large as the photos are
WEIGHTS = str(ROOT / "models" / "leaf-lite" / "weights.safetensors")
Break = Callable[[Path], None]


@pytest.fixture
def plant(tmp_path: Path) -> Path:
    return write_scene(tmp_path / "plant")


def complaint(capsys: pytest.CaptureFixture[str]) -> str:
    """The one line on stderr, without its prefix."""
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.count("\n") == 1
    assert captured.err.startswith("mvseg: error: ")
    assert "Traceback" not in captured.err
    return captured.err.removeprefix("mvseg: error: ").rstrip("\n")


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The result of `mvseg infer --masks masks`: the shipped scene with its true masks."""
    folder = tmp_path_factory.mktemp("demo")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        said = io.StringIO()
        patch.setattr("sys.stderr", said)
        assert main(["infer", "--quiet", "--masks", "masks"]) == 0
    assert said.getvalue() == "mvseg: no SCENE given: this is the plant that ships with mvseg\n"
    return folder / "results" / "demo_plant"


def test_demo_finds_every_leaf(demo: Path) -> None:
    names = {path.relative_to(demo).as_posix() for path in demo.rglob("*") if path.is_file()}
    views = [f"{view:03d}.png" for view in range(9)]
    assert names == {
        *(f"labels/{name}" for name in views),
        *(f"overlay/{name}" for name in views),
        *(f"leaves/leaf_{leaf:03d}.ply" for leaf in range(1, 13)),
        *("before_edits.bin", "instances.json", "report.html", "run.json", "scene.glb", "surfaces.npz"),
        *("traits.csv", "traits_wide.csv", "nodes.csv", "plant.json"),
    }
    leaf_of_label: dict[int, set[int]] = {}
    for name in views:
        labels = read_label_png(demo / "labels" / name, 640, 480)
        truth = read_label_png(demo_scene() / "truth" / name, 640, 480)
        np.testing.assert_array_equal(labels > 0, truth > 0)
        for label in np.unique(labels)[1:].tolist():
            leaf_of_label.setdefault(label, set()).update(np.unique(truth[labels == label]).tolist())
    assert sorted(leaf_of_label) == list(range(1, 13))
    assert sorted(leaf for leaves in leaf_of_label.values() for leaf in leaves) == list(range(1, 13))


def test_demo_has_a_stem_whose_leaves_come_in_pairs(demo: Path) -> None:
    nodes = list(csv.DictReader((demo / "nodes.csv").read_text().splitlines()))
    assert sorted(int(node["leaf"]) for node in nodes) == list(range(1, 13))
    assert {(node["stem"], node["source"], node["phyllotaxis"]) for node in nodes} == {("1", "leaf bases", "decussate")}
    wide = {row["leaf"]: row for row in csv.DictReader((demo / "traits_wide.csv").read_text().splitlines())}
    assert all(wide[node["leaf"]]["node_height"] == node["height"] for node in nodes)
    traits = mvseg.load_result(demo).traits
    assert traits is not None
    assert [node.leaf for node in traits.stems[0].nodes] == [int(node["leaf"]) for node in nodes]


def test_demo_has_its_traits(demo: Path) -> None:
    """Area, length and width of every leaf against the simulator's; width there counts the teeth of the edge, too."""
    labels = [read_label_png(path / "001.png", 640, 480) for path in (demo / "labels", demo_scene() / "truth")]
    rows = {int(row["leaf"]): row for row in csv.DictReader((demo / "traits_wide.csv").read_text().splitlines())}
    lines = (demo_scene() / "truth" / "traits.csv").read_text().splitlines()
    truth = {int(row["leaf_id"]): row for row in csv.DictReader(lines)}
    errors = []
    for leaf in np.unique(labels[1][labels[1] > 0]).tolist():
        row = rows[int(np.bincount(labels[0][labels[1] == leaf]).argmax())]
        assert (row["method"], row["quality"], row["unit"]) == ("surface", "good", "mm")
        errors.append([float(row[name]) / float(truth[leaf][name]) - 1 for name in ("area", "length", "width")])
        assert 0 < float(row["area_sd"]) < 0.06 * float(row["area"])
        mesh = trimesh.load_mesh(demo_scene() / "truth" / "leaves" / f"leaf_{leaf:03d}.ply")
        upright = np.abs((mesh.area_faces @ mesh.face_normals)[2]) / np.linalg.norm(mesh.area_faces @ mesh.face_normals)
        assert float(row["inclination"]) == pytest.approx(np.degrees(np.arccos(upright)), abs=1.5)
    assert (np.median(np.abs(errors), 0) < (0.015, 0.01, 0.045)).all()
    assert np.abs(errors).max() < 0.08
    mesh = trimesh.load_mesh(demo / "leaves" / "leaf_001.ply")
    assert not mesh.is_watertight
    assert mesh.area == pytest.approx(float(rows[1]["area"]), rel=1e-3)
    long = list(csv.DictReader((demo / "traits.csv").read_text().splitlines()))
    whole = {row["trait"]: float(row["value"]) for row in long if not row["leaf"]}
    assert whole["number_of_leaves"] == 12
    assert whole["total_leaf_area"] == pytest.approx(sum(float(row["area"]) for row in truth.values()), rel=0.02)
    assert json.loads((demo / "run.json").read_text())["traits"] == {
        "unit": "mm", "up": [0, 0, 1], "up_from": "scene", "rejected": {}
    }  # fmt: skip


def test_demo_evaluates_to_one(demo: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["eval", str(demo), "--truth", str(demo_scene() / "truth")]) == 0
    printed = dict(line.split() for line in capsys.readouterr().out.splitlines())
    metrics = json.loads((demo / "metrics.json").read_text())
    assert printed.keys() == metrics.keys()
    assert (metrics["s_match"], metrics["e_k"], metrics["ari"]) == (1, 0, 1)
    assert (metrics["num_regions"], metrics["num_estimated"], metrics["num_true"]) == (108, 12, 12)
    assert (metrics["no_instance"], metrics["ignored"]) == (0, 0)
    assert printed["s_match"] == "1.0000"


@pytest.mark.slow
def test_demo_from_pixels(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out"
    assert main(["infer", "--quiet", *COARSE, "--out", str(out)]) == 0
    detections = json.loads((out / "instances.json").read_text())["annotations"]
    assert all(0.05 <= entry["score"] <= 1 for entry in detections)
    assert all(0 <= entry["probability"] <= 1 for entry in detections)
    assert not any("source_label" in entry for entry in detections)
    run = json.loads((out / "run.json").read_text())
    assert run["config"]["masks"] is None
    assert run["config"]["detect"]["weights"] == DetectConfig().weights
    assert any(path.endswith("weights.safetensors") for path in run["inputs"])
    assert run["counts"]["regions"] == len(detections)
    capsys.readouterr()
    assert main(["eval", str(out), "--truth", str(demo_scene() / "truth")]) == 0
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics["num_regions"] >= 85  # of 108 visible leaves
    assert metrics["ari"] >= 0.85
    assert metrics["e_k"] <= 2
    assert metrics["no_instance"] <= 6


def test_config_file_then_command_line(plant: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    config = tmp_path / "run.yaml"
    config.write_text(
        "masks: masks\nquiet: true\nmatch:\n  num_instances: 3\n  seed: 4\n"
        "reconstruct: {shape: voxels, voxel_size: 1.5, threshold: 0.4}\n"
    )
    arguments = ["infer", str(plant), "--config", str(config), "--match.seed", "9", "--out", str(tmp_path / "out")]
    assert main(arguments) == 0
    captured = capsys.readouterr()
    assert captured.out == f"{tmp_path / 'out'}: 3 instances from 12 masks (label images) in 4 views\n"
    assert captured.err == ""
    run = json.loads((tmp_path / "out" / "run.json").read_text())
    said = run["config"]
    assert (said["scene"], said["masks"], said["out"]) == (str(plant), str(plant / "masks"), str(tmp_path / "out"))
    assert said["from_here"] == {"scene": "../plant", "out": ".", "masks": "../plant/masks"}
    match, shapes = MatchConfig(num_instances=3, seed=9), ReconstructConfig("voxels", voxel_size=1.5, threshold=0.4)
    for name, config in (("match", match), ("reconstruct", shapes), ("traits", TraitsConfig())):
        assert said[name] == asdict(config)
    unasked = ("corrections", "categories", "stem_category", "views", "scale", "unit", "up")
    assert [said[name] for name in unasked] == [None] * 7
    assert (said["coco_crowd"], said["report"], len(said)) == ("mask", True, 16)
    assert run["mvseg"] == mvseg.__version__
    assert run["mask_kind"] == "label images"
    assert run["inputs"].keys() == {str(plant / "cameras.json"), str(plant / "masks")}
    assert [each for each in run["findings"] if each["level"] != "note"] == []


@pytest.mark.parametrize(
    ("words", "up"),
    [
        (["--up", "-2", "0", "0", "--unit", "cm", "--scale", "0.1"], (-2, 0, 0)),
        (["--up", "0 -1 0"], (0, -1, 0)),
        (["--config", "up: [0, 1, 0]"], (0, 1, 0)),
    ],
)
def test_which_way_is_up(words: list[str], up: tuple[float, ...], tmp_path: Path, monkeypatch: Patch) -> None:
    asked: list[RunConfig] = []
    monkeypatch.setattr("mvseg.runs.one_scene.run_one_scene", lambda request, **_: asked.append(request.config))
    if "--config" in words:
        (tmp_path / "run.yaml").write_text(words[1])
        words = ["--config", str(tmp_path / "run.yaml")]
    assert main(["infer", *words, str(tmp_path)]) == 0
    assert asked[0].up == up
    assert asked[0].unit == ("cm" if "cm" in words else None)


@pytest.mark.parametrize("words", [["up"], ["board"], ["0", "1"], ["0 0 0"], ["0 0 x"], ["nan", "0", "1"]])
def test_up_that_is_no_direction(words: list[str], plant: Path, tmp_path: Path, capsys: Said) -> None:
    out = ["--out", str(tmp_path / "out"), "--quiet"]
    assert main(["infer", str(plant), "--masks", "masks", "--up", *words, *out]) == 2
    assert complaint(capsys).startswith("--up is ")
    assert not (tmp_path / "out").exists()


def test_the_papers_config_serves_both_verbs(plant: Path, tmp_path: Path) -> None:
    """As test_house.py reads it for `infer`."""
    words = ["--match.num_instances", "3", "--config", str(ROOT / "configs" / "paper.yaml")]
    assert main(["match", str(plant), "--out", str(tmp_path / "out"), "--quiet", *NO_PAGE, *words]) == 0
    assert json.loads((tmp_path / "out" / "plant" / "run.json").read_text())["config"]["match"]["method"] == "symnmf"


def test_no_stage_is_silent(tmp_path: Path, capsys: Said, monkeypatch: pytest.MonkeyPatch) -> None:
    """Every stage that takes minutes on a large scene has a bar, matching between detections and shapes too."""
    monkeypatch.setattr("mvseg.system.progress.LINE_SECONDS", -1.0)
    plant = write_scene(tmp_path / "plant", 3)
    options = [*SMALL, "--detect.min_score", "0.05", "--out", str(tmp_path / "out"), *COARSE[:-2]]
    assert main(["infer", str(plant), *options]) == 0
    said = capsys.readouterr().err
    stages = ["detection", "comparing outlines", "matching, 1 px", "choosing ids", "voxels"]
    stages += ["writing pictures", "writing masks"]
    assert [stage for stage in stages if f"{stage}:" not in said] == []
    assert sorted(path.name for path in tmp_path.iterdir()) == ["out", "plant"]


def test_detections_of_a_run_that_was_cut_off_are_announced_and_deleted(tmp_path: Path, capsys: Said) -> None:
    plant, unverified = write_scene(tmp_path / "plant", 2), [*COARSE, *SMALL, "--detect.verify", "false"]
    kept, said = tmp_path / "out.detections", "mvseg: going on from the detections in"
    kept.mkdir()
    (kept / f"{'0' * 64}.safetensors").touch()
    (kept / SCENE_FILE).write_bytes(os.fsencode(os.path.realpath(plant)))
    assert main(["infer", str(plant), "--quiet", "--out", str(tmp_path / "out"), *unverified]) == 0
    assert f"{said} {kept}, for equal photos and options" in capsys.readouterr().err
    assert not kept.exists()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--help"], ["{" + ",".join(VERBS) + "}"]),
        (["--version"], [f"mvseg {mvseg.__version__}"]),
        (["infer", "--help"], ["--masks", "--detect.weights", "--help_all"]),
        (["infer", "--help_all"], ["--masks", "--detect.weights", "--match.method", "--reconstruct.seen_share"]),
        (["batch", "--help"], ["--resume", "--num_workers", "--part", "--detect.weights", "--scale", "--up"]),
        (["batch", "--help_all"], ["--traits.min_quality", "--report"]),
        (["match", "--help"], ["[options] scenes", "--masks", "--match.method"]),
        (["train", "--help"], ["--photos", "--labels", "--resume"]),
        ([], ["{" + ",".join(VERBS) + "}"]),
    ],
)
def test_help_and_version(arguments: list[str], words: list[str], capsys: Said) -> None:
    with pytest.raises(SystemExit) if arguments else nullcontext() as stop:
        assert main(arguments) == 0
    assert stop is None or stop.value.code == 0
    shown = capsys.readouterr().out
    assert [word for word in words if word not in shown] == []


@pytest.mark.parametrize(
    ("words", "config", "message"),
    [
        ("infr plant", "", "there is no verb 'infr', did you mean infer?"),
        ("--verson", "", "unrecognized arguments: --verson: did you mean --version?"),
        ("eval", "", "eval needs result, truth: mvseg eval --help says more"),
        ("eval results", "", "eval needs truth: mvseg eval --help says more"),
        ("quux", "", f"there is no verb 'quux', expected one of {', '.join(VERBS)}"),
        ("infer . --num_pionts 3", "", "unrecognized arguments: --num_pionts 3: did you mean --match.num_points?"),
        ("correct . --no_brower", "", "unrecognized arguments: --no_brower: did you mean --no_browser?"),
        ("infer . --config run.yaml", "scael: 2", "does not accept option 'scael': did you mean --scale?"),
        ("infer . --config run.yaml", "match: {num_pionts: 3}", "match.num_pionts"),
        ("infer . --config run.yaml", "match: {num_points: [3", "run.yaml: is not a YAML file"),
        ("infer . --config run.yaml", 'out: "a\\0b"', "out is 'a\\x00b', expected text without null characters"),
        ("infer . --config run.yaml", "scale: -1", "scale is -1, expected a positive number"),
        ("infer . --config absent.yaml", "", "absent.yaml"),
        ("infer . surplus", "", "surplus"),
        ("infer . --match.num_points many", "", "--match.num_points is many, expected a whole number or null"),
        ("infer . --match.num_points 0", "", "--match.num_points is 0"),
        ("infer . --match.search_range [5,3]", "", "match.search_range is"),
        ("infer . --report=maybe", "", "--report is maybe, expected true or false"),
        ("infer . --reconstruct.shape ball", "", "--reconstruct.shape is ball, expected surface, voxels, both"),
        ("infer . --detect.min_score 3", "", "--detect.min_score is 3, expected a number from 0 to 1"),
    ],
)
def test_wrong_words_are_named_as_they_were_typed(
    words: str, config: str, message: str, plant: Path, monkeypatch: Patch, capsys: Said
) -> None:
    monkeypatch.chdir(plant)
    Path("run.yaml").write_text(config)
    before = sorted(plant.iterdir())
    assert main(words.split()) == 2
    assert message in complaint(capsys)
    assert sorted(plant.iterdir()) == before


@pytest.mark.parametrize("verb", ["", *VERBS])
def test_help_fits_a_screen(verb: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    with pytest.raises(SystemExit):
        main([*verb.split(), "--help"])
    shown = capsys.readouterr().out
    assert len(shown.splitlines()) <= 45
    assert "<class" not in shown


@pytest.mark.parametrize(("script", "option"), [("infer.py", "--masks"), ("train.py", "--photos")])
def test_scripts_of_the_checkout_are_verbs(script: str, option: str, monkeypatch: Patch, capsys: Said) -> None:
    monkeypatch.setattr(sys, "argv", [script, "--help"])
    with pytest.raises(SystemExit) as stop:
        runpy.run_path(str(ROOT / script), run_name="__main__")
    assert stop.value.code == 0
    assert option in capsys.readouterr().out


def test_match_takes_several_scenes(plant: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    other = write_scene(tmp_path / "other", 3)
    out = tmp_path / "out"
    assert main(["match", str(plant), str(other), "--out", str(out), "--quiet"]) == 0
    assert (out / "other" / "report.html").exists()
    assert capsys.readouterr().out.splitlines() == [
        f"{out / 'plant'}: 3 instances from 12 masks (label images) in 4 views",
        f"{out / 'other'}: 3 instances from 9 masks (label images) in 3 views",
    ]
    assert sorted(path.name for path in out.iterdir()) == ["other", "plant"]
    assert not (out / "plant" / "scene.glb").exists()
    assert json.loads((out / "other" / "run.json").read_text())["scene"] == "other"


def test_a_broken_scene_does_not_stop_the_others(plant: Path, tmp_path: Path, capsys: Said) -> None:
    broken = write_scene(tmp_path / "broken")
    (broken / "masks" / "001.png").unlink()
    assert main(["match", str(broken), str(plant), "--out", str(tmp_path / "out"), "--quiet", *NO_PAGE]) == 2
    captured = capsys.readouterr()
    assert captured.err == f"mvseg: error: {broken}/masks/001.png: the mask file is missing (view 1)\n"
    assert captured.out.startswith(f"{tmp_path}/out/plant: 3 instances")
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["plant"]


def test_scenes_of_one_name_are_refused(plant: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    shutil.copytree(plant, tmp_path / "more" / "plant")
    assert main(["match", str(plant), str(tmp_path / "more" / "plant"), "--out", str(tmp_path / "out")]) == 2
    assert "two scenes are called 'plant'" in complaint(capsys)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("verb", ["infer", "match"])
def test_an_empty_pot_is_data(verb: str, plant: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for path in (plant / "masks").iterdir():
        write_image(path, np.zeros((HEIGHT, WIDTH), np.uint16))
    assert main([verb, str(plant), "--masks", "masks", "--out", str(tmp_path / "out"), "--quiet"]) == 0
    captured = capsys.readouterr()
    assert captured.err == "mvseg: warning: the masks of all views are empty: there are no instances to match\n"
    assert captured.out.endswith(": 0 instances from 0 masks (label images) in 4 views\n")
    out = tmp_path / "out" if verb == "infer" else tmp_path / "out" / "plant"
    content = json.loads((out / "instances.json").read_text())
    assert len(content["images"]) == 4
    assert content["annotations"] == []
    assert not read_label_png(out / "labels" / "002.png", WIDTH, HEIGHT).any()
    assert json.loads((out / "run.json").read_text())["counts"] == {"regions": 0, "instances": 0}
    if verb == "infer":
        assert list(csv.DictReader((out / "traits_wide.csv").read_text().splitlines())) == []
        rows = list(csv.DictReader((out / "traits.csv").read_text().splitlines()))
        assert {row["leaf"] for row in rows} == {""}
        assert [row["value"] for row in rows if row["trait"] == "number_of_leaves"] == ["0"]
        assert not trimesh.load_scene(out / "scene.glb").geometry
        assert list((out / "leaves").iterdir()) == []
    assert main(["eval", str(out), "--truth", str(plant / "masks")]) == 0


def rig(view: int | None = None, **changes: Any) -> Break:
    return lambda folder: edit_rig(folder, view, **changes)


def remove(name: str) -> Break:
    return lambda folder: (folder / name).unlink()


def cut(name: str, share: float) -> Break:
    return lambda folder: cut_file(folder / name, share)


def as_jpeg(share: float) -> Break:
    """Photo 2 as a JPEG of which only a part is there."""

    def change(folder: Path) -> None:
        edit_rig(folder, 2, file="images/002.jpg")
        noise = np.random.default_rng(0).integers(0, 255, (HEIGHT, WIDTH, 3), dtype=np.uint8)
        write_image(folder / "images" / "002.jpg", noise)
        cut_file(folder / "images" / "002.jpg", share)

    return change


def colmap(folder: Path) -> None:
    """The cameras as a COLMAP model whose files end early."""
    (folder / "sparse").mkdir()
    for name in ("cameras", "images", "points3D"):
        (folder / "sparse" / f"{name}.txt").write_text("1 PINHOLE 128")
    (folder / "cameras.json").unlink()


def coco(text: str) -> Break:
    """Masks as a COCO file; the test passes `--masks masks.json`."""
    return lambda folder: (folder / "masks.json").write_text(text)


IMAGES = [{"id": v, "file_name": f"{v:03d}.png", "width": WIDTH, "height": HEIGHT} for v in range(4)]
BAD_RLE = {"id": 7, "image_id": 2, "segmentation": {"size": [HEIGHT, WIDTH], "counts": "zz"}}
# What is read late, or by a library that writes to stderr itself; all other faults are tested where files are read.
BAD_INPUT: dict[str, tuple[Break, str]] = {
    "missing image": (remove("images/002.png"), "images/002.png: the image of view 2 is missing"),
    "JPEG cut": (as_jpeg(0.6), "images/002.jpg: the image of view 2 cannot be read"),
    "NaN in a pose": (rig(1, t=[0, NAN, 50]), "cameras.json: views[1].t[1]: Input should be a finite number"),
    "mask cut": (cut("masks/001.png", 0.6), "masks/001.png: cannot be read, expected a whole label PNG: it is"),
    "COCO mask broken": (
        coco(json.dumps({"images": IMAGES, "annotations": [BAD_RLE]})),
        "masks.json: annotation 7: its run lengths do not add up",
    ),
    "COLMAP model cut": (colmap, "sparse: cannot be read as a COLMAP model"),
}


@pytest.mark.parametrize("name", BAD_INPUT)
def test_bad_input(name: str, plant: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """What libraries write to stderr by themselves would show, too."""
    change, message = BAD_INPUT[name]
    change(plant)
    before = sorted(tmp_path.rglob("*"))
    masks = "masks.json" if "COCO" in name else "masks"
    assert main(["infer", str(plant), "--masks", masks, "--out", str(tmp_path / "out"), "--quiet", *COARSE]) == 2
    assert message in complaint(capfd)
    assert sorted(tmp_path.rglob("*")) == before  # no result, and nothing half of one


@pytest.mark.parametrize("place", ["file", "file/below", "full"])
def test_output_that_cannot_be_written(place: str, plant: Path, tmp_path: Path, capsys: Said) -> None:
    (tmp_path / "file").touch()
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "thesis.tex").touch()
    before = sorted(tmp_path.rglob("*"))
    assert main(["infer", str(plant), "--masks", "masks", "--out", str(tmp_path / place), "--quiet"]) == 2
    reason = "holds files that are not a result" if place == "full" else "the output folder is not writable"
    assert f"{tmp_path / place}: {reason}" in complaint(capsys)
    assert sorted(tmp_path.rglob("*")) == before


def test_scene_or_masks_that_are_not_there(plant: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = ["--out", str(tmp_path / "out")]
    assert main(["infer", str(tmp_path / "absent"), "--masks", "masks", *out]) == 2
    assert complaint(capsys) == f"{tmp_path / 'absent'}: no such scene folder"
    assert main(["infer", str(plant), "--masks", "absent", *out]) == 2
    there = f"in {plant}, which holds cameras.json, images, masks and 1 more, nor in {Path.cwd()}"
    assert complaint(capsys) == f"absent: no such masks {there}; --masks says where they are"
    for photo in (plant / "images").iterdir():
        photo.rename(photo.with_suffix(".HEIC"))
    assert main(["infer", str(plant), *out]) == 2
    neither = f"{plant}: there are neither photos nor masks (--masks), expected one of them"
    assert complaint(capsys).startswith(f"{neither}; found 000.HEIC, 001.HEIC")
    shutil.rmtree(plant / "images")
    assert main(["infer", str(plant), *out]) == 2
    assert complaint(capsys) == neither
    assert main(["eval", str(plant), "--truth", str(plant / "truth")]) == 2
    assert complaint(capsys) == f"{plant / 'instances.json'}: is missing, expected a result folder"
    assert not (tmp_path / "out").exists()


def test_masks_are_looked_for_in_two_places(plant: Path, tmp_path: Path, monkeypatch: Patch, capsys: Said) -> None:
    monkeypatch.chdir(tmp_path)
    shutil.copytree(plant / "masks", tmp_path / "annotations")
    match = ["match", str(plant), "--out", "out", "--quiet", *NO_PAGE, "--masks"]
    assert main([*match, "annotations"]) == 0
    shutil.copytree(plant / "masks", plant / "annotations")
    capsys.readouterr()
    assert main([*match, "annotations"]) == 2
    assert "expected --masks with the full path of one" in capsys.readouterr().err
    assert main([*match, str(tmp_path / "annotations")]) == 0


@pytest.mark.parametrize("verb", ["match", "infer"])
def test_another_scenes_result_is_replaced_only_when_asked_for(
    verb: str, plant: Path, tmp_path: Path, monkeypatch: Patch, capsys: Said
) -> None:
    monkeypatch.chdir(tmp_path)
    other = write_scene(tmp_path / "day-2" / "plant", 3)  # of the same name
    command = [verb, "--masks", "masks", "--out", "out", "--quiet", *(COARSE if verb == "infer" else NO_PAGE)]
    place = Path("out", *(["plant"] if verb == "match" else []))
    assert main([*command, "plant"]) == 0
    before = (place / "run.json").read_bytes()
    capsys.readouterr()
    assert main([*command, str(other)]) == 2
    message = f"{place}: holds a result of mvseg infer, match or batch, made of {plant}, not of {other}"
    assert complaint(capsys) == f"{message}; expected another folder, or --overwrite true"
    assert (place / "run.json").read_bytes() == before
    (tmp_path / "link").symlink_to(plant)
    if verb == "infer":
        assert main([*command, "link"]) == 0  # the same scene, by another path
    assert main([*command, str(other), "--overwrite", "true"]) == 0
    assert json.loads((place / "run.json").read_text())["config"]["scene"] == str(other)


@pytest.mark.slow
def test_a_second_run_does_not_take_the_detections_of_the_first(
    tmp_path: Path, monkeypatch: Patch, capsys: Said
) -> None:
    plant = write_scene(tmp_path / "plant", 2)
    kept, command = tmp_path / "out.detections", ["infer", "--quiet", "--out", str(tmp_path / "out"), *COARSE]

    def interrupt(*_: object, **__: object) -> None:
        capsys.readouterr()
        assert main([*command, str(plant)]) == 2
        assert complaint(capsys) == f"{kept}: another run is writing to this folder, expected one at a time"
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr("mvseg.runs.one_scene.save_scene", interrupt)
        assert main([*command, str(plant)]) == 130
    before = sorted(kept.iterdir())
    assert len(before) > 2  # two photos, and whose they are
    other = write_scene(tmp_path / "other", 2)
    capsys.readouterr()
    assert main([*command, str(other)]) == 2
    assert f"found in the photos of {plant}, not of {other}; expected another --out" in complaint(capsys)
    assert sorted(kept.iterdir()) == before
    assert main([*command, str(other), "--overwrite", "true"]) == 0
    assert not kept.exists()


@pytest.mark.parametrize("verb", ["infer", "match", "batch", "pose"])
def test_an_output_that_links_to_itself(verb: str, plant: Path, tmp_path: Path, capsys: Said) -> None:
    (tmp_path / "self").symlink_to("self")
    given = {"pose": plant / "images", "batch": tmp_path}.get(verb, plant)
    assert main([verb, str(given), "--out", str(tmp_path / "self"), "--quiet"]) == 2
    assert "self" in (said := complaint(capsys))
    assert said.endswith("its links form a loop, expected a folder or a new name")


def test_a_full_disk_while_detecting_is_named(plant: Path, tmp_path: Path, monkeypatch: Patch, capsys: Said) -> None:
    def fill(path: Path, content: bytes) -> int:
        if ".safetensors." in path.name:
            raise OSError(28, "No space left on device")
        with path.open("wb") as file:
            return file.write(content)

    monkeypatch.setattr(Path, "write_bytes", fill)
    assert main(["infer", str(plant), "--out", str(tmp_path / "out"), "--quiet"]) == 2
    said = complaint(capsys)
    assert re.fullmatch(rf"{tmp_path}/out\.detections/[0-9a-f]{{64}}\.safetensors: No space left on device", said)


def test_masks_that_show_no_true_leaf_are_counted(plant: Path, tmp_path: Path, capsys: Said) -> None:
    out, truth = tmp_path / "out", tmp_path / "truth"
    assert main(["match", str(plant), "--out", str(out), "--quiet", *NO_PAGE]) == 0
    shutil.copytree(plant / "masks", truth)
    labels = read_label_png(truth / "001.png", WIDTH, HEIGHT)
    write_label_png(truth / "001.png", np.zeros_like(labels))
    capsys.readouterr()
    assert main(["eval", str(out / "plant"), "--truth", str(truth)]) == 0
    assert "3 of 12 masks show no true leaf" in capsys.readouterr().err


def test_two_annotators_are_compared(plant: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A result with another one, and label images with label images."""
    out, other = tmp_path / "out", tmp_path / "other"
    assert main(["match", str(plant), "--out", str(out), "--quiet", *NO_PAGE]) == 0
    shutil.copytree(plant / "truth", other)
    for path in other.iterdir():
        labels = read_label_png(path, WIDTH, HEIGHT)
        write_label_png(path, np.where(labels == 1, 0, labels))
    assert main(["eval", str(out / "plant"), "--truth", str(out / "plant")]) == 0
    content = json.loads((out / "plant" / "metrics.json").read_text())
    assert content["mv_pq"] == 1
    assert (content["iou_1_1"], content["iou_2_2"], content["iou_3_3"], content["missed"]) == (1, 1, 1, [])
    capsys.readouterr()
    assert main(["eval", str(other), "--truth", str(plant / "truth")]) == 0
    said = capsys.readouterr().out.splitlines()
    assert "missed             1" in said
    assert not (other / "metrics.json").exists()


def test_eval_takes_the_folder_that_match_wrote(plant: Path, tmp_path: Path, capsys: Said) -> None:
    out = tmp_path / "out"
    assert main(["match", str(plant), "--out", str(out), "--quiet", *NO_PAGE]) == 0
    capsys.readouterr()
    assert main(["eval", str(out), "--truth", str(plant / "truth")]) == 0
    assert capsys.readouterr().err == f"mvseg: {out / 'plant'}: the only result in {out}\n"
    assert (out / "plant" / "metrics.json").is_file()
    shutil.copytree(out / "plant", out / "other")
    assert main(["eval", str(out), "--truth", str(plant / "truth")]) == 2
    assert complaint(capsys) == f"{out}: holds 2 results (other, plant), expected one of them: {out / 'other'}"


def test_categories_are_selected(plant: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    labels = {view: read_label_png(plant / "masks" / f"{view:03d}.png", WIDTH, HEIGHT) for view in range(4)}
    annotations = [
        {"image_id": view, "category_id": 1 + place // 2, "segmentation": encode_mask(labels[view] == number)}
        for view in labels
        for place, number in enumerate(np.unique(labels[view])[1:].tolist())
    ]
    categories = [{"id": 1, "name": "leaf"}, {"id": 2, "name": "flower pot"}]
    content = {"images": IMAGES, "annotations": annotations, "categories": categories}
    (plant / "masks.json").write_text(json.dumps(content))
    arguments = ["match", str(plant), "--masks", "masks.json", "--out", str(tmp_path / "out"), "--quiet", *NO_PAGE]
    assert main([*arguments, "--categories", "leaf,flower pot"]) == 0
    captured = capsys.readouterr()
    assert "from 12 masks (COCO) in 4 views" in captured.out
    assert "categories" not in captured.err
    assert main(arguments) == 0
    assert "masks of 2 categories are taken alike (8 leaf, 4 flower pot)" in capsys.readouterr().err
    again = [str(tmp_path / "stems") if word == str(tmp_path / "out") else word for word in arguments[1:]]
    infer = ["infer", *again, "--stem_category", "flower pot", *COARSE]
    assert main([*infer, "--categories", "leaf"]) == 0
    capsys.readouterr()
    result = mvseg.load_result(tmp_path / "stems")
    of_stems = set(result.masks.instance_ids[result.masks.classes == 2].tolist()) - {-1}
    assert {leaf for leaf, kind in result.traits.rejected.items() if kind == "stem"} == of_stems
    of_leaves = set(result.masks.instance_ids[result.masks.classes == 1].tolist()) - {-1}
    assert of_stems
    assert of_leaves
    assert not of_stems & of_leaves
    assert main(infer) == 2
    assert "stem_category is given without categories" in complaint(capsys)
    assert main([*arguments, "--categories", "pot"]) == 2
    assert "there is no category 'pot', expected of these: leaf, flower pot" in complaint(capsys)


@pytest.mark.parametrize(
    "words",
    [
        ["--detect.image_size", "300", "--detect.crop", "off", "--detect.verify", "false"], ["--learn", "2"],
        ["--detect.weights", WEIGHTS, "--learn", "off"],
    ],
    ids=lambda words: " ".join(words[::2]),
)  # fmt: skip
def test_options_that_do_not_apply_lose_no_run(plant: Path, tmp_path: Path, words: list[str]) -> None:
    """A file of weights beside masks, and so on: everything is written, as without them."""
    out = tmp_path / "out"
    assert main(["infer", str(plant), "--masks", "masks", "--out", str(out), "--quiet", *COARSE, *words]) == 0
    run = json.loads((out / "run.json").read_text())
    assert not {"detect", "learn"} & run["config"].keys()
    is_said = "detect_options_unused" in [each["code"] for each in run["findings"]]
    assert is_said == any(word.startswith("--detect.") for word in words)


def test_a_repeated_warning_is_given_once(plant: Path, tmp_path: Path, monkeypatch: Patch, capsys: Said) -> None:
    def warn_twice(*args: Any, **options: Any) -> Matching:
        for _ in range(2):
            warn(Finding("one_number", "look here"))
        return match_masks(*args, **options)

    monkeypatch.setattr("mvseg.pipeline.plant.match_masks", warn_twice)
    assert main(["match", str(plant), "--out", str(tmp_path / "out"), "--quiet", *NO_PAGE]) == 0
    assert capsys.readouterr().err.count("look here") == 1
    findings = json.loads((tmp_path / "out" / "plant" / "run.json").read_text())["findings"]
    assert [each["where"] for each in findings].count("look here") == 1


def test_match_without_masks_is_refused(plant: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["match", str(plant), "--masks", "null", "--out", str(tmp_path / "out")]) == 2
    assert "masks is null" in complaint(capsys)


def test_a_detector_that_finds_nothing_says_so(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    plant = write_scene(tmp_path / "plant", 2)
    command = ["infer", str(plant), *SMALL, "--detect.min_score", "1", "--quiet", "--out", str(tmp_path / "out")]
    assert main([*command, *COARSE]) == 0
    assert "no detection scores 1 or more" in capsys.readouterr().err


def test_a_file_in_the_place_of_a_folder(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "file").write_text("")
    assert main(["simulate", "paper-eval", "--out", str(tmp_path / "file")]) == 2
    assert complaint(capsys) == f"{tmp_path / 'file'}: File exists"
    assert main(["infer", str(tmp_path / "file"), "--out", str(tmp_path / "out")]) == 2
    assert "is a file, expected the scene's folder" in complaint(capsys)


def test_simulate_says_what_it_needs(tmp_path: Path, monkeypatch: Patch, capsys: Said) -> None:
    for name in [name for name in sys.modules if name.startswith(("embreex", "mvseg.simulation"))]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "embreex", None)
    assert main(["simulate", "paper-eval", "--out", str(tmp_path / "out")]) == 2
    assert "pip install 'mvseg[simulate]'" in complaint(capsys)


def test_metrics_are_written_in_place_of_a_link_and_stay(plant: Path, tmp_path: Path, capsys: Said) -> None:
    """A link must not lead to somebody else's file; and what `eval` writes belongs to the user from then on."""
    precious, out = tmp_path / "precious", tmp_path / "out" / "plant"
    precious.write_text("mine")
    match = ["match", str(plant), "--out", str(tmp_path / "out"), "--quiet", *NO_PAGE]
    assert main(match) == 0
    (out / "metrics.json").symlink_to(precious)
    (out / "notes.txt").write_text("three leaves")
    assert main(["eval", str(out), "--truth", str(plant / "truth")]) == 0
    assert precious.read_text() == "mine"
    metrics = (out / "metrics.json").read_bytes()
    assert main(match) == 0
    assert (out / "metrics.json").read_bytes() == metrics
    assert json.loads(metrics)["ari"] == 1
    assert (out / "notes.txt").read_text() == "three leaves"


def test_names_in_a_result_do_not_lead_out_of_the_truth(plant: Path, tmp_path: Path, capsys: Said) -> None:
    assert main(["match", str(plant), "--out", str(tmp_path / "out"), "--quiet", *NO_PAGE]) == 0
    shutil.copy(plant / "truth" / "000.png", plant / "secret.png")
    path = tmp_path / "out" / "plant" / "instances.json"
    content = json.loads(path.read_text())
    capsys.readouterr()
    for name, reason in (("../secret", "leads out of the folder"), ("a\0", "not the name of")):
        content["images"][0]["name"] = name
        path.write_text(json.dumps(content))
        assert main(["eval", str(path.parent), "--truth", str(plant / "truth")]) == 2
        assert reason in complaint(capsys)


@pytest.mark.parametrize("name", ["RANK", "WORLD_SIZE", "LOCAL_RANK"])
def test_an_environment_that_torchrun_did_not_set(name: str, tmp_path: Path, monkeypatch: Patch, capsys: Said) -> None:
    monkeypatch.setenv(name, "abc")
    folders = [f"--{option}={tmp_path}" for option in ("photos", "labels", "output")]
    assert main(["train", *folders]) == 2
    assert complaint(capsys) == f"the environment variable {name} is 'abc', expected a number as torchrun sets it"


def test_too_little_memory_is_one_sentence(plant: Path, tmp_path: Path, monkeypatch: Patch, capsys: Said) -> None:
    def fail(*_: object, **__: object) -> None:
        raise MemoryError

    monkeypatch.setattr("mvseg.pipeline.plant.match_masks", fail)
    assert main(["match", str(plant), "--out", str(tmp_path / "out"), "--quiet"]) == 2
    assert complaint(capsys).startswith("there is not enough memory")


@pytest.mark.parametrize("is_another_error", [False, True])
def test_interrupted(is_another_error: bool, monkeypatch: Patch, plant: Path, capsys: Said) -> None:
    """Also where a library makes another error of it."""

    def stop(*_: object, **__: object) -> None:
        try:
            raise KeyboardInterrupt
        except KeyboardInterrupt as error:
            if is_another_error:
                raise ImportError("cannot load C++") from error
            raise

    monkeypatch.setattr("mvseg.runs.one_scene.run_one_scene", stop)
    assert main(["infer", str(plant)]) == 130
    assert capsys.readouterr().err == "mvseg: interrupted\n"
    monkeypatch.setattr("mvseg.runs.one_scene.run_one_scene", lambda *_, **__: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        main(["infer", str(plant)])


INTERRUPTED_IMPORT = """
import os, signal, sys

class Interrupt:
    def find_spec(self, name, path, target=None):
        if name == sys.argv[1]:
            sys.meta_path.remove(self)
            os.kill(os.getpid(), signal.SIGINT)

signal.signal(signal.SIGINT, signal.default_int_handler)  # background jobs of a shell ignore it
sys.meta_path.insert(0, Interrupt())
from mvseg.cli import main

sys.exit(main(["models"]))
"""


@pytest.mark.skipif(sys.platform == "win32", reason="signals of POSIX systems")
@pytest.mark.parametrize("library", ["mvseg.system.sigterm", "pycolmap._core", "torch"])
def test_an_interruption_while_libraries_are_loaded(library: str) -> None:
    command = [sys.executable, "-c", INTERRUPTED_IMPORT, library]
    checkout = os.environ | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run(command, env=checkout, capture_output=True, text=True, timeout=120, check=False)
    assert (done.stderr, done.returncode) == ("mvseg: interrupted\n", 130)


def test_a_warning_is_one_line(plant: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also in verbs that do not gather them, as adapt."""

    def warn(*_: object, **__: object) -> None:
        warnings.warn("odd", InputWarning, stacklevel=1)
        warnings.warn("for developers", UserWarning, stacklevel=1)

    said = io.StringIO()
    monkeypatch.setattr("mvseg.runs.one_scene.run_one_scene", warn)
    monkeypatch.setattr(sys, "stderr", said)
    with warnings.catch_warnings():
        warnings.simplefilter("default")
        assert main(["infer", str(plant)]) == 0
    first, *others = said.getvalue().splitlines()
    assert first == "mvseg: warning: odd"
    assert others[0].endswith("UserWarning: for developers")


@pytest.mark.parametrize(("given", "expected"), [(["--num_workers", "3"], 3), ([], 4)])
def test_infer_fits_in_so_many_processes(given: list[str], expected: int, tmp_path: Path, monkeypatch: Patch) -> None:
    asked: list[int] = []
    monkeypatch.setattr("mvseg.system.worker_pool.default_workers", lambda: 4)
    monkeypatch.setattr("mvseg.runs.one_scene.run_one_scene", lambda *_, num_workers, **__: asked.append(num_workers))
    assert main(["infer", str(tmp_path), *given]) == 0
    assert asked == [expected]
