"""A scene folder: photos with their cameras and, perhaps, masks. Chooses the reader."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np

from mvseg.errors import InputError, InputWarning
from mvseg.formats.coco import Crowd, read_coco
from mvseg.formats.colmap import is_colmap_model, read_colmap
from mvseg.formats.label_png import read_label_png
from mvseg.formats.lens import undistort
from mvseg.formats.rig import read_rig
from mvseg.formats.transforms_json import read_transforms
from mvseg.regions import Regions, regions_from_label_maps, stack_regions
from mvseg.scene import Scene

BINARY = 255  # what segmenters write that only tell leaf from background


def load_scene(folder: Path | str) -> Scene:
    """Load the cameras of a scene folder; photos are read later, when they are needed, and may be absent.

    Cameras come from the first of these that is there: `cameras.json` (rig file), a COLMAP model in `sparse/`,
    `sparse/0/` or `colmap/sparse/0/`, `transforms.json` (nerfstudio).

    Raises:
        InputError: the folder is missing or holds no cameras, or they are not sound; see the readers.
    """
    folder = Path(folder)
    if not folder.is_dir():
        problem = "is a file, expected the scene's folder" if folder.exists() else "no such scene folder"
        raise InputError(f"{folder}: {problem}")
    if (folder / "cameras.json").is_file():
        return read_rig(folder / "cameras.json")
    for model in (folder / "sparse", folder / "sparse" / "0", folder / "colmap" / "sparse" / "0"):
        if is_colmap_model(model):
            return read_colmap(model, folder)
    if (folder / "transforms.json").is_file():
        return read_transforms(folder / "transforms.json")
    raise InputError(f"{folder}: no cameras, expected cameras.json, a COLMAP model in sparse/ or transforms.json")


def load_masks(scene: Scene, masks: Path | str, *, crowd: Crowd = "mask") -> Regions:
    """Load the masks of every view, with the lens distortion of the scene removed.

    Args:
        scene: gives the views and their sizes.
        masks: a folder with one label PNG per view, `<view name>.png` (`IMG_1.jpg`: `IMG_1.png`), or a COCO JSON file.
        crowd: what COCO annotations with `iscrowd` are: masks like all others, or left out; see `read_coco`.

    Returns:
        Regions in the undistorted frame; `labels` holds the numbers in the PNGs or the annotation ids. Warns
        (InputWarning) of label PNGs that hold 0 and 255 only.

    Raises:
        InputError: a file is missing, broken, or does not fit its view; see the readers.
    """
    masks = Path(masks)
    if masks.is_dir():
        regions = regions_from_label_maps([_read_view(scene, view, masks) for view in range(len(scene.views))])
        if len(regions) and bool((regions.labels == BINARY).all()):
            message = f"{masks}: holds 0 and 255 only, so that each photo shows one instance; leaves need a number each"
            warnings.warn(message, InputWarning, stacklevel=2)
        return regions
    if masks.suffix.lower() == ".json" and masks.is_file():
        return _regions_from_coco(scene, masks, crowd)
    raise InputError(f"{masks}: no such masks, expected a folder of label PNGs or a COCO .json file")


def _read_view(scene: Scene, view: int, folder: Path) -> np.ndarray:
    width, height = scene.cameras.sizes[view].tolist()
    try:
        labels = read_label_png(folder / f"{scene.views[view].name}.png", width, height)
    except InputError as error:
        raise InputError(f"{error} (view {view})") from None
    return undistort(labels, scene.views[view].lens, scene.cameras.K[view].cpu().numpy())


def _regions_from_coco(scene: Scene, path: Path, crowd: Crowd) -> Regions:
    parts = []
    for view, masks in enumerate(read_coco(path, scene, crowd=crowd)):
        lens, K = scene.views[view].lens, scene.cameras.K[view].cpu().numpy()
        for label, mask in masks:
            crop = regions_from_label_maps([undistort(mask.astype(np.uint8), lens, K)])
            if len(crop):
                parts.append((view, tuple(crop.boxes[0].tolist()), crop.crops, label))
    view_index, boxes, crops, labels = (list(column) for column in zip(*parts, strict=True)) if parts else ([],) * 4
    return stack_regions(view_index, boxes, crops, labels=labels, num_views=len(scene.views))
