"""Corrections know the photos that they were made for: those of another plant are refused."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mvseg.cli import main
from mvseg.corrections.file import Confirm, Corrections, load_corrections, write_corrections
from mvseg.corrections.same_scene import check_made_for, mark_photos, with_marks
from mvseg.errors import InputError
from mvseg.formats.image_file import write_png
from mvseg.formats.photos import Photos
from mvseg.formats.scene_folder import load_scene
from scene_folders import HEIGHT, WIDTH, write_scene
from warned import warns_of


def corrections_of(folder: Path) -> Corrections:
    scene = load_scene(folder)
    edits = Corrections((Confirm(view="001.png", at=(1.0, 1.0)),))
    return with_marks(edits, scene, mark_photos(Photos(scene)))


def test_the_file_names_the_photos_of_its_edits(tmp_path: Path) -> None:
    made = corrections_of(write_scene(tmp_path / "balls"))
    assert list(made.photos) == ["001"]
    assert (made.photos["001"].width, made.photos["001"].height) == (WIDTH, HEIGHT)
    write_corrections(tmp_path / "corrections.json", made)
    assert load_corrections(tmp_path / "corrections.json").photos == made.photos


def test_another_plant_with_the_same_names_is_refused(tmp_path: Path) -> None:
    made = corrections_of(write_scene(tmp_path / "balls"))
    other = write_scene(tmp_path / "others")
    check_made_for(made, Photos(load_scene(other)))  # the same photos
    write_png(other / "images" / "001.png", np.zeros((HEIGHT, WIDTH, 3), np.uint8))
    with pytest.raises(InputError, match=r"was made for another scene .photo 001 is another one here"):
        check_made_for(made, Photos(load_scene(other)))
    masks_only = {name: mark.model_copy(update={"sha256": None}) for name, mark in made.photos.items()}
    check_made_for(replace(made, photos=masks_only), Photos(load_scene(other)))
    wider = {name: mark.model_copy(update={"width": 7}) for name, mark in masks_only.items()}
    with pytest.raises(InputError, match="another scene"):
        check_made_for(replace(made, photos=wider), Photos(load_scene(other)))


def test_a_run_stops_unless_it_is_forced_or_the_file_does_not_say(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path, other = tmp_path / "corrections.json", write_scene(tmp_path / "others")
    write_corrections(path, corrections_of(write_scene(tmp_path / "balls")))
    write_png(other / "images" / "001.png", np.zeros((HEIGHT, WIDTH, 3), np.uint8))
    command = ["match", str(other), "--out", str(tmp_path / "out"), "--corrections", str(path), "--quiet"]
    assert main(command) == 2
    assert capsys.readouterr().err.count("was made for another scene") == 1
    assert not (tmp_path / "out" / "others").exists()
    assert main([*command, "--force_corrections", "true"]) == 0
    scene = load_scene(tmp_path / "balls")
    old = Corrections((Confirm(view="001", at=(1.0, 1.0)),), source=Path("old.json"))
    with warns_of("edits_of_unknown_photos"):
        check_made_for(old, Photos(scene))
    check_made_for(replace(old, source=None), Photos(scene))
    check_made_for(Corrections(source=Path("empty.json")), Photos(scene))
