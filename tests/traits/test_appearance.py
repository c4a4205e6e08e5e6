from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from skimage.color import rgb2hsv

from blade_scene import SIZE, ring_cameras
from known_leaves import flat_leaf
from matched import matched
from mvseg.formats.image_file import write_png
from mvseg.formats.photos import Photos
from mvseg.masks import Masks
from mvseg.regions import regions_from_label_maps
from mvseg.scene import Cameras, Scene, View
from mvseg.traits.appearance import COLORS, hues, mean_colors, measure_appearance, sure_pixels

CAMERAS = ring_cameras(3)
LEAF = flat_leaf(length=2, half_width=0.45, at=(-1, 0, 0))
GREEN, RED = (60, 180, 30), (250, 10, 20)


def scene_of(folder: Path, photos: list[np.ndarray] | None, cameras: Cameras = CAMERAS) -> Scene:
    views = tuple(View(f"{view}", folder / f"{view}.png") for view in range(len(cameras)))
    for view, photo in zip(views, photos or [], strict=False):
        write_png(view.path, photo)
    return Scene("plant", views, cameras)


def labels_of(masks: list[np.ndarray]) -> Masks:
    return matched(regions_from_label_maps([mask.astype(np.int64) for mask in masks])).masks


def painted(mask: np.ndarray, color: tuple[int, int, int]) -> np.ndarray:
    """A photo whose leaf has a colour, but its outermost two pixels, and all else, are red."""
    photo = np.full((SIZE, SIZE, 3), RED, np.uint8)
    photo[cv2.erode(mask.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0] = color
    return photo


def test_colours_are_those_of_sure_pixels(tmp_path: Path) -> None:
    masks = [mask.numpy() for mask in LEAF.project(CAMERAS)]
    scene = scene_of(tmp_path, [painted(mask, GREEN) for mask in masks])
    found = measure_appearance({5: LEAF}, labels_of([5 * mask for mask in masks]), CAMERAS, photos=Photos(scene))[5]
    assert found.keys() == {"visible_share", *COLORS}
    assert found["visible_share"].value == 1
    assert [found[name].value for name in COLORS[:3]] == pytest.approx(np.array(GREEN) / 255)
    assert found["greenness_index"].value == pytest.approx((360 - 60 - 30) / (360 + 60 + 30))
    assert found["greenness_index"].sd == pytest.approx(0, abs=1e-9)


@pytest.mark.parametrize("num_grey", [1, 3])
def test_grey_photos_have_no_colour(num_grey: int, tmp_path: Path) -> None:
    """They do not count where others have colours, and where none has any the leaf has no greenness, rather than 0."""
    masks = [mask.numpy() for mask in LEAF.project(CAMERAS)]
    photos = [painted(mask, GREEN) for mask in masks]
    for photo in photos[:num_grey]:
        photo[:] = photo.mean(2, keepdims=True) + [0, 1, 2]
    found = measure_appearance({1: LEAF}, labels_of(masks), CAMERAS, photos=Photos(scene_of(tmp_path, photos)))[1]
    if num_grey < 3:
        assert found["greenness_index"].value == pytest.approx((360 - 60 - 30) / (360 + 60 + 30))
    else:
        assert {found[name].method for name in COLORS} == {"not measured: the photos are grey"}


def test_masks_that_reach_beyond_the_leaf_add_no_colour(tmp_path: Path) -> None:
    masks = [mask.numpy() for mask in LEAF.project(CAMERAS)]
    wide = [cv2.dilate(mask.astype(np.uint8), np.ones((21, 21), np.uint8)) for mask in masks]
    photos = [np.where(mask[..., None], GREEN, RED).astype(np.uint8) for mask in masks]
    found = measure_appearance({1: LEAF}, labels_of(wide), CAMERAS, photos=Photos(scene_of(tmp_path, photos)))[1]
    assert found["mean_green"].value == pytest.approx(180 / 255, abs=0.01)


def test_visible_share_counts_all_views(tmp_path: Path) -> None:
    """Half of the leaf is hidden in the first view, and all of it in the second."""
    masks = [mask.numpy().copy() for mask in LEAF.project(CAMERAS)]
    sizes = [int(mask.sum()) for mask in masks]
    columns = np.flatnonzero(masks[0].any(0))
    masks[0][:, int(columns.mean()) :] = False
    masks[1][:] = False
    found = measure_appearance({1: LEAF}, labels_of(masks), CAMERAS, photos=Photos(scene_of(tmp_path, None)))[1]
    assert found["visible_share"].value == pytest.approx((masks[0].sum() + sizes[2]) / sum(sizes))
    assert not found["mean_red"].exists
    assert found["mean_red"].method == "not measured: there are no photos"
    far = flat_leaf(length=2, half_width=0.45, at=(-40, 30, 0))
    empty = [np.zeros((SIZE, SIZE), bool)] * 3
    photos = Photos(scene_of(tmp_path, [painted(empty[0], GREEN)] * 3))
    found = measure_appearance({1: far}, labels_of(empty), CAMERAS, photos=photos)
    assert not any(number.exists for number in found[1].values())


def test_pixels_at_the_edge_of_the_picture_are_sure() -> None:
    labels = np.zeros((9, 9), np.uint16)
    labels[:6, :6], labels[:6, 6:] = 1, 2
    expected = np.zeros((9, 9), bool)
    expected[:4, :4] = expected[:4, 8:] = expected[8:] = True
    assert (sure_pixels(labels) == expected).all()


def test_views_weigh_as_much_as_their_pixels() -> None:
    views = [(300, np.array([0.2, 0.4, 0.2, 0.0])), (100, np.array([0.6, 0.8, 0.4, 0.4]))]
    found = mean_colors(views)
    assert found["mean_red"].value == pytest.approx(0.3)
    assert found["mean_red"].sd == pytest.approx(0.2)  # (0.6 - 0.2) / sqrt(2) between views, / sqrt(2) of their mean
    (first, second) = ((0.8 - 0.4) / (0.8 + 0.4), (1.6 - 1.0) / (1.6 + 1.0))
    assert found["greenness_index"].value == pytest.approx(0.75 * first + 0.25 * second)
    assert found["senescent_share"].value == pytest.approx(0.1)
    assert not np.isfinite(mean_colors(views[:1])["mean_red"].sd)
    assert not mean_colors([])["mean_red"].exists


def test_hues_are_those_of_a_library() -> None:
    colors = np.random.default_rng(0).random((200, 3))
    colors[0] = 0.5  # grey
    np.testing.assert_allclose(hues(colors), 360 * rgb2hsv(colors)[:, 0], atol=1e-6)
    known = np.array([[1.0, 0, 0], [0, 1, 0], [0, 0, 1], [0.5, 0.4, 0.1]])
    assert hues(known).tolist() == pytest.approx([0, 120, 240, 45])


def test_a_leaf_that_yellows_says_how_much(tmp_path: Path) -> None:
    """A third of each view's leaf is brown."""
    masks = [mask.numpy() for mask in LEAF.project(CAMERAS)]
    photos = []
    for mask in masks:
        photo = painted(mask, GREEN)
        rows = np.nonzero(mask)[0]
        photo[: int(np.quantile(rows, 1 / 3))] = (120, 80, 20)
        photos.append(photo)
    found = measure_appearance({1: LEAF}, labels_of(masks), CAMERAS, photos=Photos(scene_of(tmp_path, photos)))[1]
    assert found["senescent_share"].value == pytest.approx(1 / 3, abs=0.05)
    assert 60 < found["hue"].value < 120
