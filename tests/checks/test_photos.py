"""Photos: each fault has its sentence, and sound photos have none."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from mvseg.checks.photos import photo_findings, read_photo_facts
from mvseg.findings.finding import Finding
from mvseg.formats.photos import Photos
from mvseg.formats.scene_folder import load_scene
from scene_folders import HEIGHT, WIDTH, cut_file, edit_rig, write_image, write_scene

Fault = Callable[[Path], object]


def findings_of(folder: Path, *, has_masks: bool = False) -> list[Finding]:
    scene = load_scene(folder)
    return photo_findings(read_photo_facts(Photos(scene)), scene, has_masks=has_masks)


def photo(folder: Path, view: int) -> Path:
    return folder / "images" / f"{view:03d}.png"


def fill(folder: Path, view: int, color: int) -> None:
    write_image(photo(folder, view), np.full((HEIGHT, WIDTH, 3), color, np.uint8))


def lay_down(folder: Path, view: int) -> None:
    write_image(photo(folder, view), cv2.imread(str(photo(folder, view))).transpose(1, 0, 2))


def dim(folder: Path, view: int) -> None:
    image = cv2.imread(str(photo(folder, view)))
    write_image(photo(folder, view), image // 10 + np.arange(WIDTH, dtype=np.uint8)[None, :, None] // 8)


def drain(folder: Path, view: int) -> None:
    """A photo without colours, as a grey JPEG."""
    jpeg = folder / "images" / "grey.jpg"
    Image.open(photo(folder, view)).convert("L").save(jpeg, quality=80)
    edit_rig(folder, view, file="images/grey.jpg")


def darken(folder: Path, view: int) -> None:
    """12 % of the brightness of a photo with the contrast that real ones have: a fifth of its level."""
    ramp = np.linspace(100, 200, WIDTH)[None, :, None] * np.ones((HEIGHT, 1, 3))
    write_image(photo(folder, view), (0.12 * ramp).astype(np.uint8))


def overexpose(folder: Path, view: int) -> None:
    image = cv2.imread(str(photo(folder, view)))
    image[:, : WIDTH * 4 // 5] = 255
    write_image(photo(folder, view), image)


def turn_by_exif(folder: Path, view: int) -> None:
    exif = Image.Exif()
    exif[0x0112] = 6
    jpeg = folder / "images" / "turned.jpg"
    Image.open(photo(folder, view)).save(jpeg, exif=exif)
    edit_rig(folder, view, file="images/turned.jpg")


def expose(folder: Path, *seconds: float | None) -> None:
    """Photos with these exposure times in EXIF, at ISO 200 and f/4; None: without."""
    for view, time in enumerate(seconds):
        exif = Image.Exif()
        if time is not None:
            exif.get_ifd(0x8769).update({0x829A: time, 0x829D: 4.0, 0x8827: 200})
        Image.open(photo(folder, view)).save(folder / "images" / f"{view}.jpg", exif=exif)
        edit_rig(folder, view, file=f"images/{view}.jpg")


def test_exposures_that_differ_are_noted(tmp_path: Path) -> None:
    folder = write_scene(tmp_path / "plant")
    expose(folder, 1 / 50, 1 / 60, 1 / 200, 1 / 50)
    (found,) = findings_of(folder)
    assert (found.level, found.views) == ("note", (2,))
    assert found.values["stops"] == pytest.approx(1.9, abs=0.05)
    for times in ([1 / 50, 1 / 60, None, 1 / 50], [1 / 50, None, None, None], [0.0, 1 / 50, 1 / 50, 1 / 50]):
        expose(folder, *times)
        assert findings_of(folder) == []


@pytest.mark.parametrize(
    ("fault", "level", "views", "code"),
    [
        (lambda f: write_image(photo(f, 2), np.zeros((48, 64, 3), np.uint8)), "error", (2,), "photo_size"),
        (lambda f: lay_down(f, 1), "error", (1,), "photo_turned"),
        (lambda f: photo(f, 3).unlink(), "error", (3,), "missing_photos"),
        (lambda f: cut_file(photo(f, 0), 0.5), "error", (0,), "broken_photo"),
        (lambda f: fill(f, 1, 128), "error", (1,), "blank_photo"),
        (lambda f: [fill(f, view, 0) for view in (0, 1)], "error", (0, 1), "blank_photo"),
        (lambda f: fill(f, 1, 25), "error", (1,), "blank_photo"),
        (lambda f: darken(f, 2), "warning", (2,), "dark_photo"),
        (lambda f: drain(f, 2), "note", (2,), "grey_photo"),
        (lambda f: dim(f, 2), "warning", (2,), "dark_photo"),
        (lambda f: overexpose(f, 2), "warning", (2,), "overexposed_photo"),
        (lambda f: turn_by_exif(f, 1), "warning", (1,), "turned_for_display"),
        (lambda f: shutil.copy(photo(f, 0), photo(f, 3)), "error", (0, 3), "same_photo"),
    ],
)  # fmt: skip
def test_each_fault_has_its_code(fault: Fault, level: str, views: tuple[int, ...], code: str, tmp_path: Path) -> None:
    folder = write_scene(tmp_path / "plant")
    fault(folder)
    assert (code, level, views) in [(each.code, each.level, each.views) for each in findings_of(folder)]


def test_a_dark_photo_of_12_bits_is_dark_beside_its_neighbours(tmp_path: Path) -> None:
    folder = write_scene(tmp_path / "plant")
    ramp = np.linspace(0, 4095, HEIGHT * WIDTH).reshape(HEIGHT, WIDTH, 1) * [1, 0.8, 0.6]
    for view in range(4):
        write_image(photo(folder, view), (ramp / (12 if view == 2 else 1 + view)).astype(np.uint16))
    assert [(each.views, each.code) for each in findings_of(folder)] == [((2,), "dark_photo")]
    folder = write_scene(tmp_path / "masks alone", images=False)
    assert [each.level for each in findings_of(folder, has_masks=True)] == ["note"]
    assert [each.level for each in findings_of(folder)] == ["error"]
    (folder / "images").mkdir()
    (folder / "images" / "plant.heic").touch()
    assert findings_of(folder)[0].values["found"] == ("plant.heic",)
