"""Edges that follow colours: on painted leaves whose outline is known, and on the photos of the shipped plant."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

import mvseg.verification.snap_edges as snap_edges
from mvseg.formats.photos import Photos
from mvseg.masks import Masks, Origin
from mvseg.regions import Regions, regions_from_label_maps
from mvseg.scene import Scene
from mvseg.verification.numbers import SNAP
from mvseg.verification.snap_edges import snap, snap_masks

SIZE = 160


def paint(labels: np.ndarray, seed: int = 0) -> np.ndarray:
    """A photo of green leaves of their own brightness each, on grey ground, with the noise of a sensor."""
    rng = np.random.default_rng(seed)
    photo = np.full((*labels.shape, 3), (110.0, 100.0, 95.0))
    for label in range(1, labels.max() + 1):
        photo[labels == label] = np.array((60.0, 140.0, 40.0)) * (0.7 + 0.25 * label)
    return (photo + rng.normal(0, 6, photo.shape)).clip(0, 255).astype(np.uint8)


def ellipse(center: tuple[int, int] = (80, 80), axes: tuple[int, int] = (46, 26), angle: int = 30) -> np.ndarray:
    return cv2.ellipse(np.zeros((SIZE, SIZE), np.uint8), center, axes, angle, 0, 360, 1, -1) > 0


def grown(mask: np.ndarray, radius: int) -> np.ndarray:
    disk = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * abs(radius) + 1,) * 2)
    return (cv2.dilate if radius > 0 else cv2.erode)(mask.astype(np.uint8), disk) > 0


def iou(one: np.ndarray, other: np.ndarray) -> float:
    return float((one & other).sum() / (one | other).sum())


NOTHING = np.zeros((SIZE, SIZE), bool)


@pytest.mark.parametrize("radius", [-3, -2, 2, 3])
def test_an_edge_beside_the_leafs_moves_onto_it(radius: int) -> None:
    leaf = ellipse()
    found = grown(leaf, radius)
    assert iou(found, leaf) < 0.93
    assert iou(snap(found, paint(leaf.astype(int)), others=NOTHING), leaf) > 0.98


def test_a_shift_is_undone_and_a_right_edge_stays() -> None:
    leaf, photo = ellipse(), paint(ellipse().astype(int))
    assert iou(snap(np.roll(leaf, 2, 1), photo, others=NOTHING), leaf) > 0.98
    once = snap(leaf, photo, others=NOTHING)
    assert iou(once, leaf) > 0.99
    assert iou(snap(once, photo, others=NOTHING), once) > 0.995


@pytest.mark.parametrize("flip", [np.s_[:, ::-1], np.s_[::-1]])
def test_a_mirrored_photo_has_the_mirrored_mask(flip: tuple[slice, ...]) -> None:
    leaf, found = ellipse(), grown(ellipse(), 2)
    photo = paint(leaf.astype(int))
    mirrored = snap(found[flip].copy(), photo[flip].copy(), others=NOTHING)[flip]
    assert iou(mirrored, snap(found, photo, others=NOTHING)) > 0.98


def test_no_edge_moves_farther_than_the_band() -> None:
    """It is three pixels of a mask of sixty: where the leaf is larger than its mask (root of the area: 62), the edge
    moves so far and no farther."""
    leaf = ellipse()
    found = grown(leaf, -9)  # the photo says that the leaf is much larger
    new, reach = snap(found, paint(leaf.astype(int)), others=NOTHING), round(SNAP.band * np.sqrt(found.sum()))
    assert (new & ~grown(found, reach)).sum() == 0
    assert (grown(found, -reach) & ~new).sum() == 0
    found = ellipse()
    new = snap(found, paint(grown(found, 4).astype(int)), others=NOTHING)
    assert not (new & ~grown(found, 3)).any()
    assert (new & ~grown(found, 2)).sum() > 30


def test_large_photos_are_compared_at_fewer_pixels(monkeypatch: pytest.MonkeyPatch) -> None:
    large = cv2.resize(ellipse().astype(np.uint8), None, fx=4, fy=4, interpolation=cv2.INTER_LINEAR) > 0
    photo, found, nothing = paint(large.astype(int)), grown(large, 8), np.zeros_like(large)
    fast = snap(found, photo, others=nothing)
    monkeypatch.setattr(snap_edges, "SNAP", replace(SNAP, most_px=10_000))
    slow = snap(found, photo, others=nothing)
    assert min(iou(fast, slow), iou(fast, large), iou(slow, large)) > 0.98


def test_a_mask_stays_where_there_is_nothing_to_learn_from() -> None:
    speck = np.zeros((SIZE, SIZE), bool)
    speck[10:12, 10:12] = True
    photo = paint(speck.astype(int))
    assert np.array_equal(snap(speck, photo, others=NOTHING), speck)
    whole = np.ones((SIZE, SIZE), bool)
    assert np.array_equal(snap(whole, photo, others=NOTHING), whole)


def two_leaves() -> tuple[np.ndarray, Regions]:
    """A photo of two leaves, the left one in front, and masks that are both too small."""
    labels = ellipse((100, 80), (40, 30), 0).astype(int) * 2
    labels[ellipse((58, 80), (40, 30), 0)] = 1
    masks = grown(labels == 1, -2).astype(int) + 2 * grown(labels == 2, -2)
    return labels, regions_from_label_maps([masks, masks])


def test_edges_that_did_not_change_are_not_looked_for_again(monkeypatch: pytest.MonkeyPatch) -> None:
    leaf, cut = ellipse(), []
    regions = regions_from_label_maps([np.roll(leaf, 2, 1).astype(np.int64), np.roll(leaf, 3, 0).astype(np.int64)])
    masks = Masks.of(regions, torch.tensor([1, 1]), origin=Origin.DETECTED)
    photos = [paint(leaf.astype(int)), paint(leaf.astype(int), seed=1)].__getitem__
    whole, grab = snap_masks(masks, photos), cv2.grabCut
    monkeypatch.setattr(cv2, "grabCut", lambda *args: (cut.append(1), grab(*args)))
    cache: dict[str, np.ndarray] = {}
    for table in (masks, masks, replace(masks, regions=regions.select(torch.tensor([1, 0])))):
        again = snap_masks(table, photos, cache=cache)
        assert len(cut) == 2
    monkeypatch.setattr(cv2, "grabCut", grab)
    assert torch.equal(again.select(torch.tensor([1, 0])).regions.crops, whole.regions.crops)


def test_masks_of_one_photo_do_not_grow_into_each_other() -> None:
    labels, regions = two_leaves()
    ids = torch.tensor([1, 2, 1, 2])
    snapped = snap_masks(Masks.of(regions, ids, origin=Origin.DETECTED), lambda _: paint(labels))
    assert torch.equal(snapped.instance_ids, ids)
    for view in (0, 1):
        one, other = (snapped.regions.mask(2 * view + row, SIZE, SIZE).numpy() for row in (0, 1))
        assert not (one & other).any()
        assert min(iou(one, labels == 1), iou(other, labels == 2)) > 0.97


@pytest.mark.parametrize("origin", [Origin.GIVEN, Origin.CORRECTED, Origin.OTHER_VIEWS])
def test_masks_that_no_detector_found_stay(origin: Origin) -> None:
    labels, regions = two_leaves()
    masks = Masks.of(regions, torch.tensor([1, 2, 1, 2]), origin=Origin.DETECTED)
    masks.origin[::2] = origin
    snapped = snap_masks(masks, lambda _: paint(labels)).regions
    for row in range(4):
        is_same = torch.equal(snapped.mask(row, SIZE, SIZE), regions.mask(row, SIZE, SIZE))
        assert is_same == (row % 2 == 0)


def test_faulty_masks_of_the_shipped_plant_come_nearer_to_the_true_ones(
    demo_scene: Scene, demo_regions: Regions
) -> None:
    sizes = demo_scene.cameras.sizes.tolist()
    true = [demo_regions.label_map(view, demo_regions.labels, size).numpy() for view, size in enumerate(sizes[:2])]
    faulty = [sum(grown(labels == each, -2) * each for each in range(1, 13)) for labels in true]
    regions = regions_from_label_maps(faulty)
    snapped = snap_masks(Masks.of(regions, regions.labels, origin=Origin.DETECTED), Photos(demo_scene)).regions
    before, after = [], []
    for row in range(len(regions)):
        view = int(regions.view_index[row])
        leaf = true[view] == int(regions.labels[row])
        before.append(iou(regions.mask(row, *sizes[view]).numpy(), leaf))
        after.append(iou(snapped.mask(row, *sizes[view]).numpy(), leaf))
    assert np.mean(before) < 0.76
    assert np.mean(after) > 0.82
