"""Masks in memory, in the forms of torchvision, SAM, supervision and plain arrays: there, and the ids back."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from pycocotools import mask as coco_mask

from mvseg import regions_from_masks, with_instance_ids
from mvseg.errors import InputError
from mvseg.formats.run_lengths import encode_mask
from mvseg.formats.scene_folder import load_masks, load_scene
from scene_folders import HEIGHT, WIDTH, edit_rig, write_scene
from warned import warns_of

MASKS = np.zeros((3, 20, 30), bool)
MASKS[0, 2:9, 3:12], MASKS[1, 5:18, 5:20], MASKS[2, 10:12, 25:28] = True, True, True  # the first two overlap
BACKGROUND = np.zeros((0, 20, 30), bool)


@dataclass
class Detections:
    """The fields of supervision.Detections that matter; the real one is tested below, where it is installed."""

    xyxy: np.ndarray
    mask: Any = None
    tracker_id: np.ndarray | None = None


def detections(masks: np.ndarray | None, num_boxes: int = 0) -> Detections:
    return Detections(np.zeros((num_boxes if masks is None else len(masks), 4)), masks)


def sam(masks: np.ndarray) -> list[dict[str, Any]]:
    return [{"segmentation": mask, "area": int(mask.sum())} for mask in masks]


def torchvision(masks: np.ndarray) -> dict[str, torch.Tensor]:
    return {"masks": torch.from_numpy(masks * 0.9 + 0.05).float()[:, None], "scores": torch.ones(len(masks))}


FORMS = {
    "bool": lambda masks: masks,
    "uint8": lambda masks: masks.astype(np.uint8) * 255,
    "tensor": torch.from_numpy,
    "with a channel": lambda masks: masks[:, None].astype(np.float32),
    "torchvision": torchvision,
    "SAM": sam,
    "SAM, run lengths": lambda masks: [{"segmentation": encode_mask(mask)} for mask in masks],
    "pycocotools": lambda masks: [
        {"segmentation": coco_mask.encode(np.asfortranarray(mask, np.uint8))} for mask in masks
    ],
    "detections": detections,
}


@pytest.mark.parametrize("name", FORMS)
def test_all_forms_give_the_same_regions_with_their_overlaps(name: str) -> None:
    views = [FORMS[name](MASKS), FORMS[name](BACKGROUND), FORMS[name](MASKS[1:])]
    regions = regions_from_masks(views)
    assert regions.view_index.tolist() == [0, 0, 0, 2, 2]
    assert regions.labels.tolist() == [1, 2, 3, 1, 2]
    assert regions.num_views == 3
    for index, mask in enumerate([*MASKS, *MASKS[1:]]):
        np.testing.assert_array_equal(regions.mask(index, 30, 20), mask)


@pytest.mark.parametrize("name", FORMS)
def test_ids_go_back_to_their_masks(name: str) -> None:
    masks = MASKS.copy()
    masks[1] = False
    views = [FORMS[name](masks), FORMS[name](BACKGROUND), FORMS[name](MASKS[1:])]
    with warns_of("masks_without_pixels"):
        regions = regions_from_masks(views)
    given = with_instance_ids(views, regions, torch.tensor([5, 2, -1, 9]))
    expected = [[5, -1, 2], [], [-1, 9]]
    for view, ids in zip(given, expected, strict=True):
        if isinstance(view, Detections):
            found = view.tracker_id
        elif isinstance(view, dict):
            found = view["instance_ids"]
            assert view["scores"].shape == found.shape
        elif isinstance(view, list):
            found = [each["instance_id"] for each in view]
        else:
            found = view
        assert list(found) == ids
    if name == "detections":
        assert views[0].tracker_id is None  # what was given stays


def test_labels_and_their_ids() -> None:
    labels = np.array([[0, 7, 7], [9, 0, 65535]])
    for view in (labels, torch.from_numpy(labels)):
        regions = regions_from_masks([view, view])
        assert regions.labels.tolist() == [7, 9, 7, 9]
        given = with_instance_ids([view, view], regions, torch.tensor([3, -1, 4, 3]))
        assert type(given[0]) is type(view)
        assert [each.tolist() for each in given] == [[[0, 3, 3], [0, 0, 0]], [[0, 4, 4], [3, 0, 0]]]


def test_a_scene_checks_sizes_and_undistorts(tmp_path: Path) -> None:
    folder = write_scene(tmp_path / "plant")
    for view in range(4):
        edit_rig(folder, view, distortion=[-0.8, 0.3, 0.01, -0.01, 0.0])
    scene = load_scene(folder)
    expected = load_masks(scene, folder / "masks")
    from mvseg.formats.label_png import read_label_png

    maps = [read_label_png(folder / "masks" / f"{view:03d}.png", WIDTH, HEIGHT) for view in range(4)]
    stacks = [np.stack([labels == number for number in np.unique(labels)[1:]]) for labels in maps]
    for views in (maps, stacks):
        regions = regions_from_masks(views, scene)
        assert torch.equal(regions.boxes, expected.boxes)
        assert torch.equal(regions.crops, expected.crops)
    polygons = [[{"segmentation": [[5.0, 5, 50, 8, 40, 35]]}]] * 4
    assert len(regions_from_masks(polygons, scene)) == 4
    with pytest.raises(InputError, match=r"masks of 3 views for a scene of 4, expected one entry per view"):
        regions_from_masks(maps[:3], scene)
    with pytest.raises(InputError, match=r"view 1: a mask is 96 x 128 \(width x height\), its camera says 128 x 96"):
        regions_from_masks([maps[0], maps[1].T, *maps[2:]], scene)


@pytest.mark.parametrize(
    ("view", "message"),
    [
        (detections(None, 2), "view 1: 2 detections have boxes only, expected masks"),
        ({"boxes": 1}, "view 1: masks of type dict, expected a NumPy array"),
        ([1, 2], "view 1: masks of type list, expected a NumPy array"),
        (None, "view 1: masks of type NoneType, expected a NumPy array"),
        (np.zeros((2, 3, 4, 5)), r"view 1: masks of shape \(2, 3, 4, 5\), expected"),
        (np.zeros((20, 30)), r"view 1: an array \(H, W\) of float64, expected labels in whole numbers"),
        (np.zeros((20, 30), bool), r"view 1: an array \(H, W\) of bool, expected labels in whole numbers"),
        (np.full((20, 30), -1), "view 1: labels from -1 to -1, expected numbers from 0 to 65535"),
        ([{"segmentation": [[1.0, 2, 3, 4, 5, 6]]}], "view 1: a segmentation without a size, expected a scene"),
    ],
)
def test_other_forms_are_named(view: Any, message: str) -> None:
    with pytest.raises(InputError, match=message):
        regions_from_masks([MASKS, view])


def test_ids_of_other_views_are_refused() -> None:
    regions = regions_from_masks([MASKS, MASKS])
    ids = torch.arange(6)
    with pytest.raises(InputError, match=r"1 views and 6 ids for 2 views and 6 regions, expected as many"):
        with_instance_ids([MASKS], regions, ids)
    with pytest.raises(InputError, match=r"a region has the place 3 in a view of 2 masks"):
        with_instance_ids([MASKS, MASKS[1:]], regions, ids)


def test_supervision_itself() -> None:
    sv = pytest.importorskip("supervision")
    whole = sv.Detections(xyxy=sv.mask_to_xyxy(MASKS), mask=MASKS, class_id=np.zeros(3, int))
    views = [whole, sv.Detections.empty(), whole[1:]]
    regions = regions_from_masks(views)
    given = with_instance_ids(views, regions, torch.tensor([5, -1, 2, 5, 2]))
    assert [view.tracker_id.tolist() for view in given] == [[5, -1, 2], [], [5, 2]]
    assert [int(each[4]) for each in given[0]] == [5, -1, 2]  # as supervision's annotators go through them
    np.testing.assert_array_equal(given[2].mask, MASKS[1:])
    compact = getattr(sv, "CompactMask", None)
    if compact is not None:
        whole.mask = compact.from_dense(MASKS, whole.xyxy, (20, 30))
        assert torch.equal(regions_from_masks([whole]).crops, regions_from_masks([MASKS]).crops)


@pytest.mark.parametrize("kind", [np.asarray, torch.from_numpy])
def test_labels_with_a_first_axis_of_one_are_labels_and_get_ids_back(kind: Any) -> None:
    labels = np.zeros((1, 20, 30), np.int32)
    labels[0, 2:9, 3:12], labels[0, 10:12, 25:28] = 7, 4
    views = [kind(labels), kind(labels)]
    regions = regions_from_masks(views)
    assert regions.labels.tolist() == [4, 7, 4, 7]
    ids = with_instance_ids(views, regions, torch.tensor([1, 2, 1, 2]))
    np.testing.assert_array_equal(ids[1], np.where(labels == 7, 2, np.where(labels == 4, 1, 0)))
    assert regions_from_masks([kind(labels == 7), kind(labels == 7)]).labels.tolist() == [1, 1]
