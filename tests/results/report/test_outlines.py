"""Outlines are drawn again and compared with their masks."""

from __future__ import annotations

import re

import cv2
import numpy as np
import pytest
import torch

from mvseg.masks import Masks
from mvseg.regions import Regions, regions_from_label_maps
from mvseg.results.report.pictures import UNITS, outline_masks, trace_mask

BOX = (40, 20, 240, 170)  # of the photo, 10 units a pixel


def draw_path(path: str, height: int) -> np.ndarray:
    """(height, UNITS) bool, of a path as `trace_mask` writes it, by the even-odd rule."""
    drawn = np.zeros((height, UNITS), np.uint8)
    for start, steps in re.findall(r"M([-\d ]+)l([-\d ]+)z", path):
        moves = np.array([*map(int, start.split()), *map(int, steps.split())]).reshape(-1, 2)
        part = np.zeros_like(drawn)
        cv2.fillPoly(part, [moves.cumsum(0).astype(np.int32)], 1)
        drawn ^= part
    return drawn > 0


def as_masks(regions: Regions, ids: list[int]) -> Masks:
    return Masks.of(regions, torch.tensor(ids), torch.linspace(0.9, 0.2, len(ids)))


def test_a_path_is_its_mask() -> None:
    """A leaf with a hole in it and a part apart, cut by the edge of the box."""
    photo = np.zeros((200, 300), np.uint8)
    cv2.ellipse(photo, (130, 90), (60, 35), 30, 0, 360, 1, -1)
    cv2.circle(photo, (130, 90), 12, 0, -1)
    cv2.circle(photo, (230, 60), 15, 1, -1)
    path, (x1, y1, x2, y2) = trace_mask(photo[40:150, 50:280].copy(), np.array([50, 40]), box=BOX)
    expected = cv2.resize(photo[20:170, 40:240], (UNITS, 1500), interpolation=cv2.INTER_NEAREST) > 0
    drawn = draw_path(path, 1500)
    assert path.count("M") == 3
    assert (drawn & expected).sum() / (drawn | expected).sum() > 0.93  # lines go through the middles of pixels
    rows, columns = np.nonzero(expected)
    np.testing.assert_allclose([x1, y1, y2], [columns.min(), rows.min(), rows.max()], atol=10)
    assert x2 > UNITS  # the box is that of the mask, not of the picture


@pytest.mark.parametrize("shape", [(1, 1), (1, 5), (4, 1)])
def test_a_thin_mask_still_has_a_path(shape: tuple[int, int]) -> None:
    path, box = trace_mask(np.ones(shape, np.uint8), np.array([100, 60]), box=BOX)
    assert re.fullmatch(r"M\d+ \d+l[-\d ]+z", path)
    assert box == (605, 405, 605 + 10 * (shape[1] - 1), 405 + 10 * (shape[0] - 1))


def test_large_masks_come_first_and_numbers_lie_inside() -> None:
    labels = np.zeros((200, 300), np.uint16)
    labels[100:104, 60:64] = 1
    labels[60:100, 60:120] = 2
    labels[100:130, 120:160] = 3
    labels[0:10, 0:30] = 4  # outside of the box: not hidden
    regions = regions_from_label_maps([labels, labels])
    masks = as_masks(regions, [3, 5, -1, 1, 1, 2, 3, 4])
    found = outline_masks(masks, view=0, box=BOX)
    said = [(outline["region"], outline["leaf"]) for outline in found]
    assert said == [(1, 5), (2, -1), (3, 1), (0, 3)]
    assert found[2]["box"][2:] < (0, 0)
    assert [outline["is_sure"] for outline in found] == [True, True, True, True]
    assert [outline["is_sure"] for outline in outline_masks(masks, view=1, box=BOX)][2:] == [False, True]
    for outline, label in zip(found, (2, 3, 4, 1), strict=True):
        x, y = outline["at"]
        assert labels[int(y / 10 + 20), int(x / 10 + 40)] == label
    assert found[0]["height"] > found[3]["height"]


def test_a_view_without_masks() -> None:
    labels = np.zeros((20, 30), np.uint16)
    labels[3:9, 3:9] = 1
    regions = regions_from_label_maps([labels, np.zeros_like(labels)])
    assert outline_masks(as_masks(regions, [1]), view=1, box=(0, 0, 30, 20)) == []
