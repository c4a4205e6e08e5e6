"""A leaf that a person drew in two photos, in all the others: on the shipped plant, whose truth is known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from blade_scene import as_regions
from known_leaves import flat_leaf
from matched import matched
from mvseg.demo import demo_scene
from mvseg.formats.photos import ReadPhoto, read_photo
from mvseg.formats.scene_folder import load_masks, load_scene
from mvseg.masks import Masks, Origin
from mvseg.regions import Regions
from mvseg.scene import Scene
from mvseg.verification.drawn_leaves import follow_drawn
from three_leaves import CAMERAS, LEAVES, true_maps


@pytest.fixture(scope="module")
def plant() -> tuple[Scene, Regions]:
    """The shipped plant and its true masks; their labels are the leaves."""
    scene = load_scene(demo_scene())
    return scene, load_masks(scene, demo_scene() / "truth")


@pytest.fixture(scope="module")
def photos(plant: tuple[Scene, Regions]) -> ReadPhoto:
    return [read_photo(plant[0], view) for view in range(9)].__getitem__


def drawn(truth: Regions, leaf: int, views: tuple[int, ...], *, missed: tuple[int, ...] = ()) -> Masks:
    """All true masks but those of the leaves that were missed; of one leaf, only what a person drew in some views."""
    is_drawn = (truth.labels == leaf) & torch.isin(truth.view_index, torch.tensor(views))
    kept = is_drawn | ((truth.labels != leaf) & ~torch.isin(truth.labels, torch.tensor(missed, dtype=torch.int64)))
    masks = Masks.of(truth.select(kept), truth.labels[kept], torch.full((int(kept.sum()),), 0.9))
    return replace(masks, origin=torch.where(is_drawn[kept], int(Origin.CORRECTED), int(Origin.GIVEN)))


def mask_of(regions: Regions, is_leaf: Tensor, view: int, size: tuple[int, int]) -> np.ndarray:
    return regions.label_map(view, is_leaf.long(), size).numpy() > 0


@pytest.mark.parametrize(
    ("leaf", "views", "missed"),
    [(8, (4, 7), ()), (10, (4, 8), (1, 5, 9, 12))],  # of the outlines alone: 0.21, 0.35
)
def test_the_other_views_show_it(
    plant: tuple[Scene, Regions], photos: ReadPhoto, leaf: int, views: tuple[int, ...], missed: tuple[int, ...]
) -> None:
    scene, truth = plant
    before = drawn(truth, leaf, views, missed=missed)
    after = follow_drawn(before, cameras=scene.cameras, photos=photos)
    for name in ("instance_ids", "origin", "view_index"):
        assert torch.equal(getattr(after, name)[: len(before)], getattr(before, name))
    is_new = torch.arange(len(after)) >= len(before)
    assert (after.instance_ids[is_new] == leaf).all()
    assert (after.origin[is_new] == Origin.OTHER_VIEWS).all()
    assert not {*after.view_index[is_new].tolist()} & {*views}
    largest, ious = int(truth.areas[truth.labels == leaf].max()), []
    for view, size in enumerate(scene.cameras.sizes.tolist()):
        true = mask_of(truth, truth.labels == leaf, view, size)
        if view not in views and true.sum() > 0.5 * largest:
            shown = mask_of(after.regions, after.instance_ids == leaf, view, size)
            ious.append(float((shown & true).sum() / (shown | true).sum()))
    assert len(ious) >= 3
    assert np.median(ious) > 0.85


@pytest.mark.parametrize("is_linked", [False, True])
def test_a_mask_that_was_matched_to_nothing_becomes_the_leafs(
    plant: tuple[Scene, Regions], photos: ReadPhoto, is_linked: bool
) -> None:
    """Unless an edit says that it shows another one: then nothing is laid over it, either."""
    scene, truth = plant
    masks = drawn(truth, 10, (4, 8))
    lost = truth.select((truth.labels == 10) & (truth.view_index == 2))
    other = replace(Masks.of(lost), is_linked=torch.tensor([is_linked]))
    both = Masks.concatenate((masks, other))
    after = follow_drawn(both, cameras=scene.cameras, photos=photos)
    assert after.instance_ids[len(masks)] == (-1 if is_linked else 10)
    assert after.origin[len(masks)] == Origin.GIVEN
    assert 2 not in after.view_index[len(both) :].tolist()


def test_nothing_is_looked_for_without_need(plant: tuple[Scene, Regions], photos: ReadPhoto) -> None:
    scene, truth = plant
    for masks in (
        drawn(truth, 10, (4,)),
        drawn(truth, 10, tuple(range(9))),
        drawn(truth, 10, (4, 8)).select(torch.zeros(0, dtype=torch.int64)),
    ):
        assert len(follow_drawn(masks, cameras=scene.cameras, photos=photos)) == len(masks)


def test_outlines_of_two_leaves_change_nothing_else(plant: tuple[Scene, Regions], photos: ReadPhoto) -> None:
    """What contradicts itself has no credible surface, or shows nothing openly: no mask of others is touched."""
    scene, truth = plant
    masks = drawn(truth, 10, (4,))
    other = truth.select((truth.labels == 3) & (truth.view_index == 8))
    wrong = Masks.of(other, torch.tensor([10]), origin=Origin.CORRECTED)
    both = Masks.concatenate((masks.select(~((masks.view_index == 8) & (masks.instance_ids == 3))), wrong))
    both = replace(both, instance_ids=torch.where(torch.arange(len(both)) == len(both) - 1, 10, both.instance_ids))
    after = follow_drawn(both, cameras=scene.cameras, photos=photos)
    for name in ("instance_ids", "origin", "match_scores"):
        assert torch.equal(getattr(after, name)[: len(both)], getattr(both, name))


GREEN, BROWN = (60, 160, 40), (120, 80, 40)


def follow_painted(view: int, *, colored: float = 1.0, visible: float = 1.0) -> list[int]:
    """The views where leaf 3 of three gets a mask, that a person drew in two; in one view, only a part of it has the
    colour of leaves, or only a part lies in no mask of another leaf. Its pixels go from one end."""
    painted = true_maps()
    rows, columns = np.nonzero(painted[view] == 3)
    order = np.argsort(rows + 0.01 * columns, kind="stable")
    masks = [np.where((labels == 3) & (other not in (0, 3)), 0, labels) for other, labels in enumerate(painted)]
    hidden = order[: round((1 - visible) * len(order))]
    masks[view][rows[hidden], columns[hidden]] = 2
    bare = order[: round((1 - colored) * len(order))]
    painted[view][rows[bare], columns[bare]] = 0
    regions, ids = as_regions(masks)
    given = matched(regions, ids).masks
    given = replace(given, origin=torch.where(ids == 3, int(Origin.CORRECTED), int(Origin.GIVEN)))
    photos = [np.where(labels[..., None] > 0, GREEN, BROWN).astype(np.uint8) for labels in painted]
    after = follow_drawn(given, cameras=CAMERAS, photos=photos.__getitem__)
    return after.view_index[(after.origin == Origin.OTHER_VIEWS) & (after.instance_ids == 3)].tolist()


@pytest.mark.parametrize(("how", "is_shown"), [
    ({"colored": 0.7}, False), ({"colored": 0.88}, True),
    ({"visible": 0.26}, False), ({"visible": 0.37}, True),
])  # fmt: skip
def test_a_view_must_show_enough_of_it(how: dict[str, float], is_shown: bool) -> None:
    views = follow_painted(4, **how)
    assert (4 in views) == is_shown
    assert {1, 5} <= {*views}


@pytest.mark.parametrize(("share", "goes"), [(0.35, True), (0.65, False)])
def test_half_masks_of_a_drawn_leaf_go(share: float, goes: bool) -> None:
    """Leaf 3 was drawn in two photos. In the others a detector has found a part of it, from one edge on: less than half
    goes, and each photo shows the whole leaf, but for one in which others hide it; a larger part stays."""
    half_width = 0.3 * share
    part = flat_leaf(length=0.8, half_width=half_width, at=(0.4, -1.2 + half_width, -0.2))
    whole, parts = true_maps(), true_maps({**LEAVES, 3: part})
    regions, ids = as_regions([whole[view] if view in (0, 3) else parts[view] for view in range(6)])
    given = matched(regions, ids).masks
    is_drawn = (ids == 3) & torch.isin(regions.view_index, torch.tensor([0, 3]))
    given = replace(given, origin=torch.where(is_drawn, int(Origin.CORRECTED), int(Origin.GIVEN)))
    photos = [np.where(labels[..., None] > 0, GREEN, BROWN).astype(np.uint8) for labels in whole]
    after = follow_drawn(given, cameras=CAMERAS, photos=photos.__getitem__)
    is_leaf = after.instance_ids == 3
    is_other = (given.instance_ids != 3).nonzero()[:, 0]
    assert sorted(after.view_index[is_leaf].tolist()) == list(range(6))
    is_new = is_leaf & (after.origin == Origin.OTHER_VIEWS)
    assert after.view_index[is_new].tolist() == ([1, 4, 5] if goes else [])
    for one, other in zip((~is_leaf).nonzero()[:, 0].tolist(), is_other.tolist(), strict=True):
        assert torch.equal(after.regions.crop(one), given.regions.crop(other))
    for view in after.view_index[is_new].tolist():
        shown, true = mask_of(after.regions, is_leaf, view, whole[view].shape[::-1]), whole[view] == 3
        assert (shown & true).sum() > 0.85 * (shown | true).sum()
