"""labelme's files: one that labelme 6.3.1 itself wrote, against what its own `shapes_to_label` draws."""

from __future__ import annotations

import base64
import json
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from mvseg.errors import InputError
from mvseg.formats.label_png import read_labels
from mvseg.formats.masks.labelme import read_labelme
from mvseg.formats.scene_folder import load_masks, load_scene
from scene_folders import write_scene
from warned import warns_of

EXAMPLE = Path(__file__).parent.parent / "examples" / "labelme"


def test_labelmes_own_file() -> None:
    """labelme draws the outline, too, one pixel wide: everything else agrees."""
    found = read_labelme(EXAMPLE / "000.json", 128, 96)
    drawn = read_labels(EXAMPLE / "000.png")
    assert [(each.label, each.category) for each in found] == [
        (1, "leaf"), (2, "leaf"), (3, "pot"), (4, "leaf"), (5, "leaf"), (6, "stem")
    ]  # fmt: skip
    assert found[5].mask is None  # a line
    for number, each in enumerate(found[:5], start=1):
        assert each.mask is not None
        expected = drawn == number
        overlap = (each.mask & expected).sum() / (each.mask | expected).sum()
        assert overlap > (0.999 if number == 5 else 0.84)
        rows, columns = each.mask.nonzero()
        np.testing.assert_allclose([rows.mean(), columns.mean()], np.mean(expected.nonzero(), axis=1), atol=0.9)
    assert found[1].mask is not None
    assert found[1].mask[15, 70] and found[1].mask[15, 95]  # noqa: PT018  # one leaf in two parts, of one group


def write(folder: Path, *shapes: dict[str, Any], **more: Any) -> Path:
    path = folder / "a.json"
    path.write_text(json.dumps({"shapes": [{"label": "leaf"} | shape for shape in shapes]} | more))
    return path


def png(mask: np.ndarray) -> str:
    file = BytesIO()
    Image.fromarray(mask.astype(np.uint8)).save(file, "PNG")
    return base64.b64encode(file.getvalue()).decode()


def test_rectangles_have_exact_pixels(tmp_path: Path) -> None:
    path = write(tmp_path, {"points": [[8, 6], [2, 3]], "shape_type": "rectangle"})
    mask = np.zeros((20, 30), bool)
    mask[3:6, 2:8] = True
    np.testing.assert_array_equal(read_labelme(path, 30, 20)[0].mask, mask)


CORNERS = [[1, 1], [5, 1], [5, 5]]
BAD: list[tuple[dict[str, Any], str]] = [
    ({"points": [[1, 1], [1e9, 2], [2, 2]]}, "a polygon reaches far out of the image"),
    ({"points": CORNERS, "shape_type": "rectangle"}, "a rectangle of 3 points, expected 2"),
    ({"points": CORNERS, "shape_type": "cube"}, "the shape type 'cube' is not known, expected polygon"),
    ({"points": CORNERS[:2], "shape_type": "mask"}, "its mask is not a whole PNG in base64"),
    ({"points": CORNERS[:2], "shape_type": "mask", "mask": "@"}, "its mask is not a whole PNG in base64"),
    ({"points": CORNERS[:2], "shape_type": "mask", "mask": png(np.ones((9, 9)))[:40]}, "its mask is not a whole PNG"),
    ({"points": CORNERS[:2], "shape_type": "mask", "mask": png(np.ones((9, 99)))}, "its mask is 99 x 9, larger than"),
    ({"points": [[25, 1], [33, 9]], "shape_type": "mask", "mask": png(np.ones((9, 9)))}, "does not lie in the photo"),
]


@pytest.mark.parametrize(("shape", "message"), BAD)
def test_bad_shapes_are_named(shape: dict[str, Any], message: str, tmp_path: Path) -> None:
    path = write(tmp_path, {"points": CORNERS}, shape)
    with pytest.raises(InputError, match=rf"a.json: shapes\[1\] \(leaf\): .*{message}"):
        read_labelme(path, 30, 20)


def test_bad_files_are_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"a.json: its photo is 31 x 20, its camera says 30 x 20"):
        read_labelme(write(tmp_path, imageWidth=31, imageHeight=20), 30, 20)
    with pytest.raises(InputError, match=r"a.json: shapes\[0\].points"):
        read_labelme(write(tmp_path, {"points": [[1]]}), 30, 20)


def test_shapes_that_labelmes_scripts_leave_out(tmp_path: Path) -> None:
    """Parts of one group too; a rectangle called so must not be a mask, nor cover one."""
    shapes = [{"label": "__ignore__"}, {}, {"label": "_background_"}, {"label": "__ignore__", "group_id": 1}]
    found = read_labelme(write(tmp_path, *({"points": CORNERS} | shape for shape in shapes)), 30, 20)
    assert [(each.category, each.mask is None) for each in found] == [
        ("__ignore__", True), ("leaf", False), ("_background_", True), ("__ignore__", True)
    ]  # fmt: skip


def test_categories_and_lines_are_said(tmp_path: Path) -> None:
    folder = write_scene(tmp_path / "plant")
    scene = load_scene(folder)
    (folder / "lm").mkdir()
    for view in range(4):
        (folder / "lm" / f"{view:03d}.json").write_bytes((EXAMPLE / "000.json").read_bytes())
    with warns_of("boxes_left_out", "several_categories") as noticed:
        assert len(load_masks(scene, folder / "lm")) == 20
    assert {each.values["count"] for each in noticed} == {4, 2}
    with warns_of("boxes_left_out"):
        assert len(load_masks(scene, folder / "lm", categories=["pot"])) == 4
    with (
        warns_of("boxes_left_out"),
        pytest.raises(InputError, match=r"lm: there is no category 'bud', expected of these: leaf, pot"),
    ):
        load_masks(scene, folder / "lm", categories=["bud"])
