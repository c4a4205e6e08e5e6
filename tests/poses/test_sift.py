from __future__ import annotations

import cv2
import numpy as np
import pytest

from mvseg.poses.numbers import STRUCTURE
from mvseg.poses.sift import coarsest, count_alike, find_sift, match_descriptors
from room_scene import texture


def rgb(seed: int = 0) -> np.ndarray:
    return texture(seed, grains=(5, 12, 40))[:400, :500]


def test_features_move_with_the_picture() -> None:
    """By whole pixels, away from the border, nearly all are found again where they must be."""
    picture = rgb()
    one = find_sift(picture[:360, :460], image_size=1000, most=4000)
    other = find_sift(picture[10:370, 24:484], image_size=1000, most=4000)
    is_inside = ((one.px > 80) & (one.px < [380, 280])).all(1)
    apart = np.linalg.norm(one.px[is_inside, None] - [24, 10] - other.px[None], axis=2).min(1)
    assert is_inside.sum() > 100
    assert (apart < 0.1).mean() > 0.9


def test_pixels_are_of_the_photo_whatever_the_size() -> None:
    """A photo that is scaled down gives the same features, but for the finest: no shift and no scale."""
    large = cv2.resize(rgb()[:260, :320], None, fx=2, fy=2, interpolation=cv2.INTER_CUBIC)
    one = find_sift(large, image_size=640, most=4000)
    small = find_sift(large, image_size=320, most=4000)
    gaps = one.px[None] - small.px[:, None]
    nearest = np.take_along_axis(gaps, np.linalg.norm(gaps, axis=2).argmin(1)[:, None, None], axis=1)[:, 0]
    is_same = np.linalg.norm(nearest, axis=1) < 1
    assert is_same.mean() > 0.8
    np.testing.assert_allclose(np.median(nearest[is_same], axis=0), 0, atol=0.1)


def test_descriptors_have_one_length_and_no_more_are_kept_than_asked_for() -> None:
    sift = find_sift(rgb(), image_size=1000, most=200)
    assert len(sift.px) == 200
    assert sift.descriptors.dtype == np.uint8
    np.testing.assert_allclose(np.linalg.norm(sift.descriptors.astype(float), axis=1), STRUCTURE.unit, rtol=0.02)
    sift = find_sift(np.full((60, 80, 3), 120, np.uint8), image_size=1000, most=100)
    assert (len(sift.px), sift.px.shape, sift.descriptors.shape) == (0, (0, 2), (0, 128))
    assert count_alike([coarsest(sift), coarsest(find_sift(rgb(), image_size=500, most=100))]).tolist() == [[0, 0]] * 2


def test_alike_is_what_a_plain_count_says() -> None:
    pictures = [rgb(0)[:300, :400], rgb(0)[60:360, 80:480], rgb(1)[:300, :400]]
    coarse = [coarsest(find_sift(picture, image_size=1000, most=4000)) for picture in pictures]
    assert all(len(each) == STRUCTURE.coarse for each in coarse)
    alike = count_alike(coarse)
    assert (alike == alike.T).all()
    assert (alike.diagonal() == 0).all()
    assert alike[0, 1] > 10 * max(alike[0, 2], 1)
    for i, j in ((0, 1), (0, 2)):
        assert alike[i, j] == len(match_descriptors(coarse[i], coarse[j]))
        unit = [each / np.linalg.norm(each.astype(float), axis=1, keepdims=True) for each in (coarse[i], coarse[j])]
        apart = np.linalg.norm(unit[0][:, None] - unit[1], axis=2)
        count = 0
        for row, distances in enumerate(apart):
            column = int(distances.argmin())
            nearest, second = np.sort(distances)[:2]
            back = np.sort(apart[:, column])[:2]
            is_mutual = int(apart[:, column].argmin()) == row
            count += is_mutual and nearest <= STRUCTURE.ratio * second and back[0] <= STRUCTURE.ratio * back[1]
        assert alike[i, j] == pytest.approx(count, abs=1)  # float32 rounds
