"""Photos with their instances in layers."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from mvseg.evaluation.labelled_photo import label_photo, mask_photo, stack_layers
from mvseg.regions import IGNORE_LABEL

HEIGHT, WIDTH = 12, 16
PHOTO = np.random.default_rng(0).integers(0, 255, (HEIGHT, WIDTH, 3), dtype=np.uint8)
SQUARE, BAR, CORNER = np.zeros((3, HEIGHT, WIDTH), bool)
SQUARE[2:6, 3:9] = True
BAR[4:11, 7:8] = True  # crosses the square
CORNER[0, 0] = True


def test_numbers_of_a_label_map_become_instances_in_their_order() -> None:
    labels = np.where(SQUARE, 900, 0)
    labels[BAR], labels[CORNER] = 7, IGNORE_LABEL
    labelled = label_photo(PHOTO, labels.astype(np.uint16))
    np.testing.assert_array_equal(labelled.photo.permute(1, 2, 0), PHOTO)
    assert labelled.classes.tolist() == [1, 1]
    expected = np.where(BAR, 1, np.where(SQUARE, 2, 0))
    np.testing.assert_array_equal(labelled.layers, expected[None])
    np.testing.assert_array_equal(labelled.ignore, CORNER)


@pytest.mark.parametrize(("label", "count"), [(0, 0), (4, 1), (IGNORE_LABEL, 0)])
def test_a_map_of_one_number(label: int, count: int) -> None:
    labelled = label_photo(PHOTO, np.full((HEIGHT, WIDTH), label, np.uint16))
    assert (len(labelled.classes), labelled.layers.unique().tolist()) == (count, [count])
    assert bool(labelled.ignore.all()) == (label == IGNORE_LABEL)


def test_instances_share_layers_where_they_can() -> None:
    layers = stack_layers([SQUARE, BAR, CORNER], (HEIGHT, WIDTH))
    assert [layer.unique().tolist() for layer in layers] == [[0, 1, 3], [0, 2]]
    for number, mask in enumerate((SQUARE, BAR, CORNER), start=1):
        np.testing.assert_array_equal((layers == number).any(0), mask)
    labelled = mask_photo(PHOTO, [], classes=[], ignore=CORNER)
    assert (labelled.classes.dtype, len(labelled.classes)) == (torch.int64, 0)
    assert labelled.layers.shape == (1, HEIGHT, WIDTH)
    assert not labelled.layers.any()
