"""Leaves of other species: skins of real leaves, markings and hues."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from mvseg.errors import InputError
from mvseg.simulation.look import draw_look
from mvseg.simulation.shading import leaf_color
from mvseg.simulation.skins import COLUMNS, GAMMA, ROWS, list_skins, unroll_leaf

HEIGHT, WIDTH = 240, 320


def tilted_leaf(angle: float) -> tuple[np.ndarray, np.ndarray]:
    """An elliptical leaf of half axes 100 and 40 px, its red channel rising along it and its green one across it."""
    y, x = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    dx, dy = x - WIDTH / 2, y - HEIGHT / 2
    along = (dx * math.cos(angle) + dy * math.sin(angle)) / 100
    across = (dy * math.cos(angle) - dx * math.sin(angle)) / 40
    mask = along**2 + across**2 <= 1
    half_width = np.sqrt(np.clip(1 - along**2, 0.01, None))
    rgb = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    rgb[..., 0] = np.clip(127.5 * (1 + along), 0, 255)
    rgb[..., 1] = np.clip(127.5 * (1 + across / half_width), 0, 255)
    return rgb * mask[..., None], mask


@pytest.mark.parametrize("angle", [0.0, 0.6, 2.0])
def test_a_leaf_unrolls_to_its_length_and_width_whatever_its_direction(angle: float) -> None:
    skin = unroll_leaf(*tilted_leaf(angle))
    assert skin.shape == (ROWS, COLUMNS, 3)
    red, green = skin[..., 0] ** (1 / GAMMA), skin[..., 1] ** (1 / GAMMA)
    rows, columns = slice(ROWS // 8, -ROWS // 8), slice(4, -4)
    along, across = np.linspace(0, 1, ROWS)[:, None], np.linspace(0.03, 0.97, COLUMNS)
    for found, wanted in ((red, along), (green, across)):
        wanted = np.broadcast_to(wanted, found.shape)
        error = min(np.abs(found - turned)[rows, columns].max() for turned in (wanted, 1 - wanted))
        assert error < 0.05  # which end comes first, and which side, is not known


def test_leaves_show_their_skin_where_it_lies_on_the_blade() -> None:
    look = replace(draw_look(np.random.default_rng(1)), leaf_spread=0.0, spots=-100.0)
    skin = np.zeros((11, 5, 3), np.float32)
    skin[..., 0], skin[..., 1] = np.linspace(0, 1, 11)[:, None], np.linspace(0, 1, 5)
    uv = np.array([[0.0, -1.0], [0.5, 0.0], [1.0, 1.0], [0.25, 0.5]], np.float32)
    albedo, _, _ = leaf_color(replace(look, skin=skin), np.ones(4, np.uint16), uv, dryness=np.zeros(4, np.float32))
    assert np.allclose(albedo[:, 0], uv[:, 0], atol=1e-5)
    assert np.allclose(albedo[:, 1], (uv[:, 1] + 1) / 2, atol=1e-5)


def test_files_that_are_no_cut_outs_are_named(tmp_path: Path) -> None:
    assert list_skins(None) == ()
    with pytest.raises(InputError, match=r"skins is .*, expected a folder of PNG files"):
        list_skins(tmp_path)
    rgb, mask = tilted_leaf(0.3)
    rgba = np.dstack([rgb[..., ::-1], mask * np.uint8(255)])
    cv2.imwrite(str(tmp_path / "a.png"), rgba)
    assert np.allclose(list_skins(tmp_path)[0], unroll_leaf(rgb, mask))
    cv2.imwrite(str(tmp_path / "b.png"), rgb)
    with pytest.raises(InputError, match=r"b\.png: expected a PNG of 8 bits with an alpha channel"):
        list_skins(tmp_path)
    cv2.imwrite(str(tmp_path / "b.png"), np.dstack([rgb, 0 * rgb[..., :1]]))
    with pytest.raises(InputError, match=r"b\.png: no leaf in the alpha channel"):
        list_skins(tmp_path)
