"""Corrections in a whole run: the masks and ids that a person names are those of the result."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch

from blade_scene import as_regions
from leafy_scene import write_leafy_scene
from mvseg import Corrections, InputError, ReconstructConfig, RunConfig, run_scene
from mvseg.cli import main
from mvseg.corrections.file import FORMAT, load_corrections, parse_corrections
from mvseg.formats.label_png import read_labels, write_label_png
from mvseg.formats.rig import write_rig
from mvseg.masks import Masks, Origin
from mvseg.matching.match import match_masks
from mvseg.matching.result import Matching
from mvseg.pipeline.apply_edits import apply_edits
from mvseg.pipeline.open_scene import open_scene
from mvseg.pipeline.plant import match_given
from mvseg.results.result import Result
from mvseg.verification.choose import Edited, Judges, choose_leaves
from scene_folders import write_scene
from three_leaves import CAMERAS, LEAVES, true_maps
from verified import verify_ids

Said = pytest.CaptureFixture[str]
IDS_ONLY = RunConfig(reconstruct=None)
SQUARE = np.array([[-9.0, -9], [-9, 9], [9, 9], [9, -9]])


def corrections(*edits: dict[str, Any]) -> Corrections:
    return parse_corrections({"format": FORMAT, "edits": list(edits)})


def middle(plant: Path, view: int, ball: int) -> list[float]:
    """The middle of a ball in a photo."""
    rows, columns = np.nonzero(read_labels(plant / "truth" / f"{view:03d}.png") == ball)
    return [float(columns.mean()) + 0.5, float(rows.mean()) + 0.5]


def at(plant: Path, view: int, ball: int) -> dict[str, Any]:
    return {"view": f"{view:03d}", "at": middle(plant, view, ball)}


def place(plant: Path, view: int, ball: int) -> list[Any]:
    return [f"{view:03d}", *middle(plant, view, ball)]


@pytest.fixture(scope="module")
def plant(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_scene(tmp_path_factory.mktemp("scenes") / "plant")


def test_without_edits_it_is_todays_result(plant: Path) -> None:
    plain, empty = (run_scene(plant, plant / "masks", IDS_ONLY, corrections=c) for c in (None, Corrections()))
    agreeing = corrections({"op": "same", "at": [place(plant, 0, 1), place(plant, 2, 1)]})
    agreed = run_scene(plant, plant / "masks", IDS_ONLY, corrections=agreeing)
    stem = corrections({"op": "reject", "stem": True} | at(plant, 1, 3))
    for other in (empty, agreed, run_scene(plant, plant / "masks", IDS_ONLY, corrections=stem)):
        assert torch.equal(plain.masks.instance_ids, other.masks.instance_ids)
        is_same = ~other.masks.is_linked
        assert torch.equal(plain.masks.match_scores[is_same], other.masks.match_scores[is_same])
        assert torch.equal(plain.masks.regions.crops, other.masks.regions.crops)
    assert empty.fates == ()
    assert [each.fate for each in agreed.fates] == ["applied"]


def test_ids_follow_what_a_person_says(plant: Path) -> None:
    said = corrections(
        {"op": "reject", "everywhere": True} | at(plant, 1, 3),
        {"op": "different", "at": [place(plant, 0, 1), place(plant, 3, 1)]},
        {"op": "confirm"} | at(plant, 2, 2),
    )
    result = run_scene(plant, plant / "masks", IDS_ONLY, corrections=said)
    assert len(result.masks) == 8
    ids = {(view, ball): id_at(result, plant, view, ball) for view in range(4) for ball in (1, 2)}
    assert ids[0, 1] != ids[3, 1]
    assert len({ids[view, 2] for view in range(4)}) == 1
    assert result.masks.is_corrected.sum() == 1


def test_edits_do_not_estimate_the_reprojection_error_again(plant: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[int | None] = []

    def match(*args: Any, residual_px: int | None = None, **options: Any) -> Matching:
        asked.append(residual_px)
        return match_masks(*args, residual_px=residual_px, **options)

    monkeypatch.setattr("mvseg.pipeline.apply_edits.match_masks", match)
    matched = match_given(open_scene(plant, plant / "masks", IDS_ONLY))
    drawn = [
        {"op": "outline", "view": f"{view:03d}", "polygon": (middle(plant, view, ball) + SQUARE).tolist()}
        for view in range(4) for ball in (1, 2)
    ]  # fmt: skip
    apply_edits(matched, corrections({"op": "different", "at": [place(plant, 0, 1), place(plant, 3, 1)]}))
    apply_edits(matched, corrections(*drawn))
    assert asked == [matched.matching.report.residual_px, None]
    assert asked[0] is not None


def id_at(result: Result, plant: Path, view: int, ball: int) -> int:
    x, y = (int(each) for each in middle(plant, view, ball))
    labels = result.regions.label_map(view, torch.arange(1, len(result.masks) + 1), (128, 96))
    return int(result.masks.instance_ids[labels[y, x] - 1])


def test_the_command_writes_what_came_of_each_edit(plant: Path, tmp_path: Path, capsys: Said) -> None:
    path, out = tmp_path / "corrections.json", tmp_path / "out"
    square = {"op": "outline", "view": "000", "polygon": [[2, 2], [12, 2], [12, 12], [2, 12]]}
    path.write_text(json.dumps({"format": FORMAT, "edits": [square, {"op": "reject", "view": "000", "at": [127, 1]}]}))
    command = ["match", str(plant), "--out", str(out), "--quiet", "--report", "false", "--corrections", str(path)]
    assert main(command) == 0
    run = json.loads((out / "plant" / "run.json").read_text())
    assert [each["fate"] for each in run["corrections"]] == ["applied", "points at nothing"]
    assert str(path) in run["inputs"]
    sentence = "correction 2 (reject): points at nothing: there is no mask at (127, 1) in view 000"
    assert sentence in [each["sentence"] for each in run["findings"] if each["code"] == "edit"]
    assert sentence in capsys.readouterr().err
    annotations = json.loads((out / "plant" / "instances.json").read_text())["annotations"]
    assert [each["corrected"] for each in annotations if "corrected" in each] == ["outline"]
    path.write_text("{}")
    assert main([*command, "--overwrite", "true"]) == 2
    with pytest.raises(InputError, match="format"):
        load_corrections(path)


CORRECTED = [Origin.CORRECTED, Origin.CUT, Origin.CONFIRMED]


def wrong_masks(origin: Origin) -> Masks:
    """The three leaves, but the mask of leaf 1 in view 2 is a square elsewhere that a person made, with that id."""
    maps = [labels.copy() for labels in true_maps()]
    maps[2][maps[2] == 1] = 0
    maps[2][:9, :9] = 1
    regions, ids = as_regions(maps)
    masks = Masks.of(regions, ids, torch.full((len(ids),), 0.9), origin=Origin.DETECTED)
    is_square = (regions.view_index == 2) & (ids == 1)
    return replace(masks, origin=torch.where(is_square, int(origin), masks.origin))


def squares(masks: Masks) -> list[tuple[list[int], int]]:
    rows = ((masks.view_index == 2) & (masks.regions.boxes[:, 2] <= 9)).nonzero()[:, 0].tolist()
    return [(masks.regions.boxes[row].tolist(), int(masks.regions.areas[row])) for row in rows]


def edit(masks: Masks) -> Edited:
    """Masks as edits left them."""
    apart, gone = torch.zeros(0, 2, dtype=torch.int64), torch.zeros(0, dtype=torch.int64)
    return Edited(masks, (None,) * len(masks), masks.origin < 0, gone, apart)


@pytest.mark.parametrize("origin", [Origin.DETECTED, *CORRECTED])
def test_no_later_stage_changes_or_drops_a_corrected_mask(origin: Origin, monkeypatch: pytest.MonkeyPatch) -> None:
    masks, stays = wrong_masks(origin), [([0, 0, 9, 9], 81)]
    masks = replace(masks, detection_scores=torch.full((len(masks),), 0.8))
    proposals = replace(masks, origin=torch.full_like(masks.origin, Origin.DETECTED))
    for surfaces in (LEAVES, {}):
        monkeypatch.setattr("mvseg.verification.choose.fit_roughly", lambda *_, known=surfaces: known)
        chosen = choose_leaves(proposals, {"matched": proposals}, Judges(CAMERAS), edited=edit(masks))
        assert squares(chosen.masks) == (stays if origin in CORRECTED or not surfaces else [])


@pytest.mark.parametrize("origin", [Origin.GIVEN, Origin.CONFIRMED])
def test_surfaces_do_not_move_a_corrected_mask(origin: Origin) -> None:
    regions, ids = as_regions(true_maps())
    wrong = ids.clone()
    row = int(((regions.view_index == 2) & (ids == 1)).nonzero()[0, 0])
    wrong[row] = 2
    given = Masks.of(regions, wrong, torch.full((len(ids),), 0.9))
    masks = replace(given, origin=given.origin.clone())
    masks.origin[row] = origin
    found = verify_ids(given, LEAVES, cameras=CAMERAS, edited=edit(masks)).instance_ids
    others = torch.arange(len(ids)) != row
    leaf = 2 if origin in CORRECTED else 1
    assert int(found[row]) == int(found[(ids == leaf) & others].mode().values)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::mvseg.errors.InputWarning")  # most photos have no mask of the leaf yet
def test_two_outlines_of_one_leaf_show_it_in_all_views(tmp_path: Path) -> None:
    (tmp_path / "plant").mkdir()
    leafy = write_leafy_scene(tmp_path / "plant", num_leaves=2, num_views=5, size=160, span_deg=180)
    photos = [view.path.relative_to(tmp_path / "plant").as_posix() for view in leafy.scene.views]
    write_rig(tmp_path / "plant" / "cameras.json", leafy.scene, photos)
    folder, edits = tmp_path / "masks", []
    folder.mkdir()
    for view, name in enumerate(each.name for each in leafy.scene.views):
        labels = leafy.regions.label_map(view, leafy.regions.labels, (160, 160)).numpy()
        write_label_png(folder / f"{name}.png", np.where(labels == 2, 2, 0).astype(np.uint16))
        if view in (0, 3):
            lines, _ = cv2.findContours((labels == 1).astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
            polygon = (lines[0][:, 0] + 0.5).tolist()
            edits.append({"op": "outline", "view": name, "polygon": polygon, "leaf": "missed"})
    config = RunConfig(reconstruct=ReconstructConfig())
    result = run_scene(tmp_path / "plant", folder, config, corrections=corrections(*edits))
    (leaf,) = result.masks.instance_ids[result.masks.origin == Origin.CORRECTED].unique().tolist()
    assert result.surfaces is not None
    assert result.surfaces[leaf].is_credible
    own = result.masks.select(result.masks.instance_ids == leaf)
    views = own.view_index.tolist()
    assert len(views) == len(set(views)) >= 4  # in one photo it is too small
    ious = {}
    for row, view in enumerate(views):
        shown = own.regions.mask(row, 160, 160)
        true = leafy.regions.label_map(view, leafy.regions.labels, (160, 160)) == 1
        ious[view] = float((shown & true).sum() / (shown | true).sum())
    assert min(ious[0], ious[3]) > 0.7
    assert min(ious.values()) > 0.75  # with the outlines alone: 0.24 to 0.62
    assert own.origin.tolist().count(Origin.OTHER_VIEWS) == len(views) - 2
