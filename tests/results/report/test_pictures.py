"""Pictures of the photos: small enough for many, and never larger than the photo."""

from __future__ import annotations

from io import BytesIO

import numpy as np
import pytest
import torch
from PIL import Image

from mvseg.masks import Masks
from mvseg.regions import regions_from_label_maps
from mvseg.results.report.pictures import ALL_PIXELS, LARGEST_WIDTH, LEAST_WIDTH, draw_picture, picture_width


@pytest.mark.parametrize("proportion", [0.5, 0.75, 1.6])
@pytest.mark.parametrize("num_views", [12, 30, 60, 120])
def test_all_pictures_together_have_a_limit(num_views: int, proportion: float) -> None:
    width = picture_width(num_views, proportion)
    assert LEAST_WIDTH <= width <= LARGEST_WIDTH
    assert num_views * width**2 * proportion <= ALL_PIXELS
    assert width == LARGEST_WIDTH or num_views * (width + 1) ** 2 * proportion > ALL_PIXELS


def test_few_views_are_large_and_hundreds_still_seen() -> None:
    assert picture_width(3, 0.75) == LARGEST_WIDTH
    assert picture_width(2000, 0.75) == LEAST_WIDTH


def test_a_picture_is_the_part_with_the_plant() -> None:
    photo = np.full((300, 400, 3), (200, 30, 30), np.uint8)
    labels = np.zeros((300, 400), np.uint16)
    labels[100:160, 150:230] = 1
    photo[labels > 0] = (20, 160, 40)
    masks = Masks.of(regions_from_label_maps([labels]), torch.tensor([1]), torch.ones(1))
    picture = draw_picture(photo, masks, view=0)
    image, thumbnail = (np.asarray(Image.open(BytesIO(data))) for data in (picture.jpeg, picture.thumbnail))
    assert thumbnail.shape == (240, 320, 3)
    assert image.shape == (67, 90, 3)  # as many pixels as the photo has there
    assert picture.proportion == pytest.approx(0.75, abs=0.01)
    np.testing.assert_allclose(image[33, 45], (20, 160, 40), atol=12)
    np.testing.assert_allclose(thumbnail[5, 5], (200, 30, 30), atol=12)
    (outline,) = picture.outlines
    assert outline["leaf"] == 1
    assert outline["box"][2] - outline["box"][0] == pytest.approx(2000 * 79 / 90, abs=2)
