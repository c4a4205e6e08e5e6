"""Masks on their own: each fault has its sentence, and sound masks have none."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from mvseg.checks.masks import mask_findings, touches_border
from mvseg.regions import regions_from_label_maps
from synthetic import BallScene, ball_scene

Maps = list[np.ndarray]
NAMES = tuple("abcde")


@pytest.fixture(scope="module")
def scene() -> BallScene:
    return ball_scene(9, 5)


def shrink(maps: Maps) -> None:
    """Every mask becomes 3 x 3 pixels."""
    for labels in maps:
        for number in np.unique(labels)[1:]:
            rows, columns = np.nonzero(labels == number)
            labels[labels == number] = 0
            labels[rows[0] : rows[0] + 3, columns[0] : columns[0] + 3] = number


def keep_one(labels: np.ndarray) -> None:
    labels[labels != labels.max()] = 0


def strew(labels: np.ndarray) -> None:
    """One pixel of the largest mask in a corner."""
    labels[2, 2] = np.bincount(labels.ravel())[1:].argmax() + 1


def cut_off(maps: Maps) -> None:
    for labels in maps:
        rows = np.flatnonzero(labels.any(1))
        labels[: (rows[0] + rows[-1]) // 2] = 0
        labels[:] = np.roll(labels, -((rows[0] + rows[-1]) // 2), axis=0)


@pytest.mark.parametrize(
    ("fault", "level", "views", "code"),
    [
        (shrink, "warning", (), "tiny_masks"),
        (lambda maps: maps[3].fill(0), "warning", (3,), "views_without_masks"),
        (lambda maps: keep_one(maps[1]), "warning", (1,), "few_masks"),
        (lambda maps: np.place(maps[2], maps[2] == 0, 99), "error", (2,), "background_mask"),
        (lambda maps: strew(maps[4]), "warning", (4,), "stray_pixels"),
        (cut_off, "warning", (), "cut_masks"),
        (lambda maps: [labels.fill(0) for labels in maps], "error", (), "no_masks"),
        (lambda maps: [labels.fill(0) for labels in maps[1:]], "error", (1, 2, 3, 4), "masks_in_one_view"),
    ],
)
def test_each_fault_has_its_code(
    fault: Callable[[Maps], object], level: str, views: tuple[int, ...], code: str, scene: BallScene
) -> None:
    maps = [labels.copy() for labels in scene.label_maps]
    fault(maps)
    found = mask_findings(regions_from_label_maps(maps), scene.cameras, NAMES)
    assert (code, level, views) in [(each.code, each.level, each.views) for each in found]


def test_the_border_is_the_last_pixel(scene: BallScene) -> None:
    labels = np.zeros((240, 320), np.int64)
    labels[0, 5] = 1
    labels[239, 9] = 2
    labels[7, 319] = 3
    labels[238, 318] = 4
    maps = [labels, *(np.zeros_like(labels) for _ in range(4))]
    regions = regions_from_label_maps(maps)
    assert touches_border(regions, scene.cameras).tolist() == [True, True, True, False]
