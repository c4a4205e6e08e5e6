"""The masks of a result as the photos show them: with the distortion of their lenses."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from mvseg.crop import Crop
from mvseg.formats.lens import distort
from mvseg.masks import Masks, replace_crops
from mvseg.regions import Regions
from mvseg.results.result import Result


def mask_in_photo(result: Result, row: int) -> NDArray[np.uint8]:
    """(H, W) mask of one row, 0 and 1, in the frame of the photo."""
    view = int(result.masks.view_index[row])
    width, height = result.scene.cameras.sizes[view].tolist()
    mask = result.regions.mask(row, width, height).cpu().numpy().astype(np.uint8)
    return distort(mask, result.scene.views[view].lens, result.scene.cameras.K[view].cpu().numpy())


def labels_in_photo(result: Result, view: int) -> NDArray[np.uint16]:
    """(H, W) ids of the instances in the frame of the photo of a view; 0 = none."""
    cameras, masks = result.scene.cameras, result.masks
    width, height = cameras.sizes[view].tolist()
    labels = masks.regions.label_map(view, masks.instance_ids, (width, height)).cpu().numpy().astype(np.uint16)
    return distort(labels, result.scene.views[view].lens, cameras.K[view].cpu().numpy())


def regions_in_photos(result: Result) -> Regions:
    """All D masks in the frames of the photos, on the CPU; their `labels` are the ids, -1 = matched to nothing. A mask
    that the photo does not show has one pixel, which is not set."""
    masks: Masks = result.masks.to("cpu")
    crops = []
    for row, view in enumerate(masks.view_index.tolist()):
        crop = masks.regions.placed(row)
        if result.scene.views[view].lens is not None:
            crop = Crop.of(mask_in_photo(result, row) > 0)
        crops.append(crop)
    return replace(replace_crops(masks, crops).regions, labels=masks.instance_ids)
