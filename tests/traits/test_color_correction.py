"""Colours corrected by a rendered card: known light in, the colours of things out."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from color_cards import LAMP, SHADE, SIZE, photograph_card, under_light
from mvseg.errors import InputError, InputWarning
from mvseg.formats.image_file import write_png
from mvseg.scene import Cameras, Scene, View
from mvseg.traits.color_correction import correct_colors, correct_views, read_color_card
from mvseg.traits.config import ColorCorrection

LEAVES = np.array([(60, 140, 50), (120, 160, 40), (150, 120, 60), (90, 60, 40)])  # green, young, senescent, dead
needs_mcc = pytest.mark.skipif(not hasattr(cv2, "mcc"), reason="this OpenCV cannot look for colour cards")


def write_card(folder: Path, light: np.ndarray, *, turn: float = 0.0, **changes: object) -> Path:
    """A card file with the corners of one card."""
    photo, corners = photograph_card(light, turn=turn)
    write_png(folder / "card.png", photo)
    entry = {"photo": "card.png", "corners": corners.tolist()} | changes
    path = folder / "card.json"
    path.write_text(json.dumps({"format": "mvseg-color-card/1", "cards": [entry]}))
    return path


def only(card: object) -> ColorCorrection:
    assert isinstance(card, tuple)
    (correction,) = card
    return correction


def check_leaves(correction: ColorCorrection, light: np.ndarray) -> None:
    seen = 255 * under_light(LEAVES, light)
    assert np.abs(seen - LEAVES).max() > 20  # there is something to correct
    assert np.abs(255 * correct_colors(correction, seen) - LEAVES).max() < 3
    assert 0 < correction.delta_e < 1


@pytest.mark.parametrize("light", [LAMP, SHADE])
@pytest.mark.parametrize("turn", [0, 25, 180])
def test_given_corners_undo_the_light(light: np.ndarray, turn: float, tmp_path: Path) -> None:
    check_leaves(only(read_color_card(write_card(tmp_path, light, turn=turn))), light)


@needs_mcc
@pytest.mark.parametrize("light", [LAMP, SHADE])
@pytest.mark.parametrize("turn", [25, 90])  # at which OpenCV finds it from several starts
def test_a_card_is_found_in_its_photo(light: np.ndarray, turn: float, tmp_path: Path) -> None:
    write_card(tmp_path, light, turn=turn)
    check_leaves(only(read_color_card(tmp_path / "card.png")), light)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"corners": [[100, 100], [500, 100], [500, 100], [100, 100]]}, "the 'corners' .* span no card"),
        ({"corners": [[100, 100], [900, 100], [900, 300], [100, 300]]}, "within the photo of 640 x 480 pixels"),
        ({"corners": [[10, 10], [30, 10], [30, 20], [10, 20]]}, "differs by Delta E .* is it the card"),
        ({"corners": [[1, 2]]}, r"cards\[0\].corners"),
        ({"photo": "absent.png"}, "absent.png: the photo of a colour card cannot be read"),
        ({"view": "a*"}, r"cards\[0\].view: Extra inputs are not permitted"),
    ],
)  # fmt: skip
def test_a_wrong_card_is_named(changes: dict[str, object], message: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=message):
        read_color_card(write_card(tmp_path, LAMP, **changes))


def test_corners_in_another_order_and_too_much_light_are_said(tmp_path: Path) -> None:
    _, corners = photograph_card(LAMP)
    with pytest.raises(InputError, match="are the corners in order"):
        read_color_card(write_card(tmp_path, LAMP, corners=np.roll(corners, 2, axis=0).tolist()))
    with pytest.raises(InputError, match="is overexposed, expected 12 patches or more below 250"):
        read_color_card(write_card(tmp_path, 20 * LAMP))


@needs_mcc
def test_a_photo_without_a_card_is_said(tmp_path: Path) -> None:
    write_png(tmp_path / "photo.png", np.full((SIZE[1], SIZE[0], 3), 90, np.uint8))
    with pytest.raises(InputError, match=r"photo.png: no colour card of 24 patches is found"):
        read_color_card(tmp_path / "photo.png")


def test_an_old_opencv_asks_for_corners(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(cv2, "mcc", raising=False)
    path = write_card(tmp_path, LAMP)
    assert only(read_color_card(path)).delta_e < 1
    with pytest.raises(InputError, match=r"cannot look for colour cards, expected version 5 or later, or .*'corners'"):
        read_color_card(tmp_path / "card.png")


def two_cameras(folder: Path) -> Scene:
    """Views a0 and a1 of one camera, the second of which shows a card, and b0 of another, without one."""
    photos = {"a0": np.full((SIZE[1], SIZE[0], 3), 90, np.uint8), "a1": photograph_card(LAMP, turn=25)[0]}
    photos["b0"] = photos["a0"]
    for name, photo in photos.items():
        write_png(folder / f"{name}.png", photo)
    K = np.repeat(np.array([[600.0, 0, 320], [0, 600, 240], [0, 0, 1]])[None], 3, axis=0)
    K[2, 0, 0] = 610
    cameras = Cameras(
        K=torch.from_numpy(K), R=torch.eye(3).repeat(3, 1, 1), t=torch.zeros(3, 3), sizes=torch.tensor([SIZE] * 3)
    )
    return Scene("plant", tuple(View(name, folder / f"{name}.png") for name in photos), cameras)


@needs_mcc
def test_one_photo_of_each_camera_will_do(tmp_path: Path) -> None:
    scene = two_cameras(tmp_path)
    with pytest.warns(InputWarning, match="plant: 1 of 3 views have no colour card, the first is b0: have no part in"):
        first, second, other = correct_views(scene, "find")
    assert first is second is not None
    assert other is None
    assert (first.photo, first.views) == ("a1", "a0, a1")
    write_png(tmp_path / "a1.png", np.full((SIZE[1], SIZE[0], 3), 90, np.uint8))
    with pytest.warns(InputWarning, match="3 of 3 views have no colour card, the first is a0: colours are uncorrected"):
        assert correct_views(scene, "find") == [None] * 3


def test_a_card_file_says_for_which_views(tmp_path: Path) -> None:
    scene = two_cameras(tmp_path)
    correction = ColorCorrection("a*", (1.0, 0, 0, 0, 1, 0, 0, 0, 1), 0.5, "card.png")
    other = replace(correction, views="*")
    assert correct_views(scene, (correction, other)) == [correction, correction, other]
    assert correct_views(scene, None) == [None] * 3
