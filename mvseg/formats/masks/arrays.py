"""Masks in memory: regions from what segmenters return in Python, and ids written back to the same objects."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from mvseg.errors import InputError, check_arguments, faults_of
from mvseg.formats.coco import decode_segmentation
from mvseg.formats.masks.npy_masks import has_labels
from mvseg.formats.masks.view_regions import ViewMasks, stack_views
from mvseg.regions import IGNORE_LABEL, Regions
from mvseg.scene import Scene

FORMS = (
    "a NumPy array or tensor (N, H, W) or labels (H, W), torchvision's dict, a list of SAM's dicts or "
    "supervision.Detections with masks"
)
THRESHOLD = 0.5  # definition: of masks in floats, as torchvision's are


def regions_from_masks(views: Sequence[Any], scene: Scene | None = None) -> Regions:
    """Regions of masks that are in memory, overlaps kept.

    Args:
        views: one entry per view, in the order of the cameras, each of any of these forms:
            a NumPy array or tensor (N, H, W) or (N, 1, H, W), bool, integers (not 0 is mask) or floats (above 0.5);
            one of whole numbers (H, W), or (1, H, W) with two numbers or more: 0 = nothing, 65535 = ignore, any other
            number = one mask;
            a dict with such "masks" (torchvision's detectors, one per image);
            a list of dicts with a "segmentation" (H, W) bool or COCO's run lengths (SamAutomaticMaskGenerator);
            supervision.Detections with masks.
        scene: if given, sizes are checked, and its lens distortion is removed; without it the masks must be of
            undistorted photos.

    Returns:
        Regions ordered by view; `labels` holds the place of each mask in its view, from 1, or the numbers of labels.
        Warns (InputWarning) of masks without pixels, which are left out. `with_instance_ids` takes ids back.

    Raises:
        InputError: an entry is of another form, has boxes only, or is of another size than its camera; or there is not
            one entry per view.
    """
    if scene is not None and len(views) != len(scene.views):
        raise InputError(f"masks of {len(views)} views for a scene of {len(scene.views)}, expected one entry per view")

    def contents() -> Iterator[ViewMasks]:
        for index, view in enumerate(views):
            with faults_of(f"view {index}"):
                content = _read(view, None if scene is None else tuple(scene.cameras.sizes[index].tolist()))
            yield content

    return stack_views(contents(), scene, source="masks in memory")


@check_arguments
def with_instance_ids(views: Sequence[Any], regions: Regions, instance_ids: Tensor) -> list[Any]:
    """Give the ids of regions back to the masks that they came from.

    Args:
        views: what `regions_from_masks` was given; it is not changed.
        instance_ids: (D,) int64, of `Matching`; -1 = matched to nothing.

    Returns:
        One entry per view, of the form it had: supervision.Detections with `tracker_id`; torchvision's dict with
        "instance_ids" (N,) int64; SAM's dicts with "instance_id". For an array (N, H, W) the ids (N,) int64, for labels
        (H, W) a map of the ids, 0 where nothing is matched. Masks that were left out have -1.

    Raises:
        InputError: the views are not those of the regions.
    """
    if len(views) != regions.num_views or len(instance_ids) != len(regions):
        given = f"{len(views)} views and {len(instance_ids)} ids"
        raise InputError(f"{given} for {regions.num_views} views and {len(regions)} regions, expected as many")
    ids_of: list[dict[int, int]] = [{} for _ in views]
    columns = (regions.view_index.tolist(), regions.labels.tolist(), instance_ids.tolist())
    for view, label, instance_id in zip(*columns, strict=True):
        ids_of[view][label] = instance_id
    return [_give(view, id_of) for view, id_of in zip(views, ids_of, strict=True)]


def _give(view: Any, id_of: Mapping[int, int]) -> Any:
    if isinstance(view, (np.ndarray, Tensor)):
        if has_labels(_to_numpy(view)):
            numbers, indices = np.unique(_to_numpy(view), return_inverse=True)
            values = np.array([max(0, id_of.get(number, 0)) for number in numbers.tolist()], np.int64)
            ids = values[indices].reshape(view.shape)
        else:
            ids = _ids(len(view), id_of)
        return torch.from_numpy(ids).to(view.device) if isinstance(view, Tensor) else ids
    if isinstance(view, Mapping):
        masks = view["masks"]
        device = masks.device if isinstance(masks, Tensor) else "cpu"
        return {**view, "instance_ids": torch.from_numpy(_ids(len(masks), id_of)).to(device)}
    if isinstance(view, Sequence):
        return [{**each, "instance_id": int(number)} for each, number in zip(view, _ids(len(view), id_of), strict=True)]
    return dataclasses.replace(view, tracker_id=_ids(len(view.xyxy), id_of))


def _ids(num_masks: int, id_of: Mapping[int, int]) -> np.ndarray:
    if max(id_of, default=0) > num_masks:
        raise InputError(f"a region has the place {max(id_of)} in a view of {num_masks} masks, expected the same views")
    return np.array([id_of.get(place, -1) for place in range(1, num_masks + 1)], np.int64)


def _read(view: Any, size: tuple[int, ...] | None) -> ViewMasks:
    if isinstance(view, Mapping) and "masks" in view:
        stack = list(_stack(_to_numpy(view["masks"])))
    elif isinstance(view, (np.ndarray, Tensor)):
        if has_labels(_to_numpy(view)):
            return _check_size(_labels(_to_numpy(view).reshape(view.shape[-2:])), size)
        stack = list(_stack(_to_numpy(view)))
    elif isinstance(view, Sequence) and all(isinstance(each, Mapping) and "segmentation" in each for each in view):
        stack = [_decode(each["segmentation"], size) for each in view]
    elif hasattr(view, "mask") and hasattr(view, "xyxy"):
        if view.mask is None and len(view.xyxy):
            raise InputError(f"{len(view.xyxy)} detections have boxes only, expected masks")
        stack = [] if view.mask is None else list(_stack(np.asarray(view.mask)))
    else:
        raise InputError(f"masks of type {type(view).__name__}, expected {FORMS}")
    return [(place, _check_size(mask, size)) for place, mask in enumerate(stack, start=1)]


def _to_numpy(array: Any) -> np.ndarray:
    return array.detach().cpu().numpy() if isinstance(array, Tensor) else np.asarray(array)


def _labels(numbers: np.ndarray) -> np.ndarray:
    if not np.issubdtype(numbers.dtype, np.integer):
        raise InputError(f"an array (H, W) of {numbers.dtype}, expected labels in whole numbers, or masks (N, H, W)")
    if numbers.size and not 0 <= numbers.min() <= numbers.max() <= IGNORE_LABEL:
        raise InputError(f"labels from {numbers.min()} to {numbers.max()}, expected numbers from 0 to {IGNORE_LABEL}")
    return numbers.astype(np.uint16)


def _stack(masks: np.ndarray) -> np.ndarray:
    if masks.ndim == 4 and masks.shape[1] == 1:
        masks = masks[:, 0]
    if masks.ndim != 3 and masks.size:
        raise InputError(f"masks of shape {masks.shape}, expected {FORMS}")
    if masks.dtype == bool or not masks.size:
        return masks.astype(bool) if masks.ndim == 3 else np.zeros((0, 1, 1), bool)
    return np.asarray(masks > THRESHOLD if np.issubdtype(masks.dtype, np.floating) else masks != 0)


def _decode(segmentation: Any, size: tuple[int, ...] | None) -> np.ndarray:
    if isinstance(segmentation, (np.ndarray, Tensor)):
        return np.asarray(_stack(_to_numpy(segmentation)[None])[0])
    if isinstance(segmentation, Mapping) and isinstance(segmentation.get("counts"), bytes):  # as pycocotools gives it
        segmentation = {**segmentation, "counts": segmentation["counts"].decode("ascii", errors="replace")}
    if size is None:
        if not isinstance(segmentation, Mapping) or len(segmentation.get("size", ())) != 2:
            raise InputError("a segmentation without a size, expected a scene that states it")
        size = (int(segmentation["size"][1]), int(segmentation["size"][0]))
    return decode_segmentation(segmentation, size[0], size[1])


def _check_size(mask: np.ndarray, size: tuple[int, ...] | None) -> np.ndarray:
    if size is not None and mask.shape != size[::-1]:
        found = f"{mask.shape[1]} x {mask.shape[0]}"
        raise InputError(f"a mask is {found} (width x height), its camera says {size[0]} x {size[1]}")
    return mask
