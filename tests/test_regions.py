from __future__ import annotations

import weakref

import numpy as np
import pytest
import torch

from mvseg import regions_from_masks
from mvseg.crop import Crop
from mvseg.errors import InputError
from mvseg.matching.samples import view_runs
from mvseg.regions import IGNORE_LABEL, Regions, regions_from_label_maps
from reference import spread_pixels_reference, thinned_pixels_reference


def random_maps(seed: int = 0) -> list[np.ndarray]:
    """Three label maps of different sizes; the second is empty; numbers are sparse and 16 bits wide."""
    generator = np.random.default_rng(seed)
    numbers = np.array([0, 0, 3, 700, 65534, IGNORE_LABEL], np.uint16)
    blocks = [generator.choice(numbers, (6, 8)), np.zeros((5, 5), np.uint16), generator.choice(numbers, (9, 4))]
    return [np.kron(block, np.ones((4, 3), np.uint16)) for block in blocks]


def thinned_pixels(regions: Regions, most: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Where the lattice points of thinned masks are in the image, and the region of each."""
    thinned, origin, step = regions.thin(most)
    xy, owner = thinned.pixels()
    return (xy - 0.5) * step[owner, None] + origin[owner], owner


def test_label_maps_make_the_round_trip() -> None:
    maps = random_maps()
    regions = regions_from_label_maps(maps)
    assert regions.num_per_view.tolist() == [3, 0, 3]
    for view, labels in enumerate(maps):
        painted = regions.label_map(view, regions.labels, labels.shape[::-1])
        np.testing.assert_array_equal(painted.numpy(), np.where(labels == IGNORE_LABEL, 0, labels))


def test_areas_and_pixels_count_what_the_masks_hold() -> None:
    maps = random_maps()
    regions = regions_from_label_maps(maps)
    xy, owner = regions.pixels()
    for index in range(len(regions)):
        mask = maps[int(regions.view_index[index])] == int(regions.labels[index])
        assert regions.areas[index] == mask.sum()
        expected = np.argwhere(mask)[:, ::-1] + 0.5
        np.testing.assert_array_equal(xy[owner == index].numpy(), expected)
        np.testing.assert_array_equal(regions.mask(index, mask.shape[1], mask.shape[0]).numpy(), mask)


@pytest.mark.parametrize("longest", [1, 2, 16])
def test_runs_are_the_pixels_of_the_masks(longest: int) -> None:
    regions = regions_from_label_maps(random_maps(seed=1))
    xy, length, owner = regions.runs(longest)
    assert 1 <= int(length.min()) <= int(length.max()) <= longest
    runs = zip(xy.tolist(), length.tolist(), owner.tolist(), strict=True)
    expanded = [(region, x + step, y) for (x, y), count, region in runs for step in range(count)]
    pixels, owner = regions.pixels()
    assert expanded == [(region, x, y) for (x, y), region in zip(pixels.tolist(), owner.tolist(), strict=True)]
    if longest == 16:  # no run could be longer
        assert len(xy) < len(pixels) / 2
    nothing = regions.select(torch.zeros(0, dtype=torch.int64))
    assert [len(each) for each in nothing.runs(longest)] == [0] * 3


def test_a_union_is_that_of_whole_frames() -> None:
    regions = regions_from_label_maps(random_maps())
    union = regions.union([0, 2])
    (x1, y1, x2, y2), covered = union.box, union.pixels
    whole = regions.mask(0, 24, 24) | regions.mask(2, 24, 24)
    assert torch.equal(covered, whole[y1:y2, x1:x2])
    assert covered.sum() == whole.sum()
    assert (x1, y1, x2, y2) == Crop.of(whole).box


def test_a_pixel_is_shown_by_the_masks_that_hold_it_in_whole_frames() -> None:
    maps = random_maps()
    regions = regions_from_label_maps(maps)
    for view, labels in enumerate(maps):
        height, width = labels.shape
        for y, x in np.ndindex(height + 1, width + 1):
            frames = [regions.mask(row, width, height) for row in range(len(regions))]
            is_in = regions.view_index == view
            expected = [
                row for row in range(len(regions)) if is_in[row] and y < height and x < width and frames[row][y, x]
            ]
            assert regions.at(view, x, y) == expected
    assert regions.at(0, -1, 0) == regions.at(0, 0, -1) == []


def test_thinned_pixels_stand_for_the_whole_mask() -> None:
    maps = [np.zeros((300, 400), np.uint16)]
    maps[0][10:250, 20:380] = 1
    maps[0][299, 0:300] = 2  # a sliver that the lattice may miss
    regions = regions_from_label_maps(maps)
    xy, owner = thinned_pixels(regions, 100)
    counts = torch.bincount(owner)
    assert 25 <= counts[0] <= 130
    assert counts[1] >= 1
    runs = view_runs(regions, 100)[0][0]
    torch.testing.assert_close(runs.pixels().xy, xy)
    sums = torch.zeros(2).index_add(0, runs.owner, runs.weight)
    torch.testing.assert_close(sums, regions.areas.float())
    torch.testing.assert_close(xy[owner == 0].mean(0), torch.tensor([200.0, 130.0]), atol=10, rtol=0)


@pytest.mark.parametrize("most", [1, 5, 12, 100])
def test_thinned_and_spread_pixels_agree_with_full_frames(most: int) -> None:
    maps = random_maps(seed=3)
    maps[0][0, :] = 9  # a sliver, which a lattice may miss
    regions = regions_from_label_maps(maps)
    thinned, owner = thinned_pixels(regions, most)
    spread, region = regions.spread_pixels(most)
    for index in range(len(regions)):
        mask = maps[int(regions.view_index[index])] == int(regions.labels[index])
        expected = thinned_pixels_reference(mask, most)
        np.testing.assert_array_equal(thinned[owner == index].numpy(), expected)
        np.testing.assert_array_equal(spread[region == index].numpy(), spread_pixels_reference(mask, most))
    nothing = regions.select(torch.zeros(0, dtype=torch.int64))
    assert [len(each) for each in (*thinned_pixels(nothing, 5), *nothing.spread_pixels(5))] == [0] * 4


def test_regions_of_some_views_are_those_of_their_label_maps() -> None:
    maps = random_maps()
    for views in ([2, 0], [1], [0, 1, 2]):
        some = regions_from_label_maps(maps).of_views(torch.tensor(views))
        alone = regions_from_label_maps([maps[view] for view in views])
        assert some.num_views == alone.num_views == len(views)
        for field in ("view_index", "boxes", "crops", "labels"):
            assert torch.equal(getattr(some, field), getattr(alone, field))


def test_overlapping_regions_are_painted_small_on_top() -> None:
    big, small = torch.ones(16, dtype=torch.bool), torch.ones(4, dtype=torch.bool)
    boxes = torch.tensor([[1, 1, 3, 3], [0, 0, 4, 4]])
    regions = Regions(torch.tensor([0, 0]), boxes, torch.cat((small, big)), 1, torch.tensor([1, 2]))
    painted = regions.label_map(0, torch.tensor([7, 9]), (5, 4))
    assert painted[1:3, 1:3].unique().tolist() == [7]
    assert (painted == 9).sum() == 12


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"boxes": torch.zeros(2, 4, dtype=torch.int64)}, "empty box"),
        ({"crops": torch.ones(3, dtype=torch.bool)}, "as many as the boxes cover"),
        ({"view_index": torch.tensor([0, 5])}, r"not in \[0, 2\)"),
        ({"labels": torch.tensor([1])}, "labels"),
    ],
)
def test_inconsistent_regions_are_refused(change: dict, message: str) -> None:
    fields = {
        "view_index": torch.tensor([0, 1]),
        "boxes": torch.tensor([[0, 0, 2, 1], [3, 3, 5, 4]]),
        "crops": torch.ones(4, dtype=torch.bool),
        "num_views": 2,
        "labels": torch.tensor([1, 2]),
    }
    Regions(**fields)
    with pytest.raises(InputError, match=message):
        Regions(**(fields | change))


def test_label_maps_are_not_kept() -> None:
    """Memory does not grow with the number of photos: of many maps, the last two are there at most."""
    seen: list[weakref.ref[np.ndarray]] = []

    def draw(view: int) -> np.ndarray:
        assert sum(map_() is not None for map_ in seen) <= 1
        label_map = np.zeros((8, 8), np.uint16)
        label_map[2:4, view] = 1
        seen.append(weakref.ref(label_map))
        return label_map

    regions = regions_from_label_maps(draw(view) for view in range(6))
    assert regions.num_views == len(regions) == 6
    assert regions_from_label_maps([]).num_views == 0


def test_overlaps_are_those_of_whole_frames() -> None:
    rng = np.random.default_rng(0)
    masks = np.zeros((2, 6, 20, 30), bool)
    for mask in masks.reshape(-1, 20, 30):
        y, x, h, w = rng.integers((0, 0, 2, 2), (14, 22, 9, 12))
        mask[y : y + h, x : x + w] = rng.random((min(h, 20 - y), min(w, 30 - x))) < 0.8
    regions = regions_from_masks(list(masks))
    pairs = [(v, i, j) for v in range(2) for i in range(6) for j in range(i + 1, 6)]
    slow = [(6 * v + i, 6 * v + j, int((masks[v, i] & masks[v, j]).sum())) for v, i, j in pairs]
    assert regions.overlaps() == [each for each in slow if each[2]]
    assert len(regions.overlaps()) > 3
    assert regions.select(torch.arange(0)).overlaps() == []
