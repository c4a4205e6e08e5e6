"""Visible share and colour of each leaf in the photos."""

from __future__ import annotations

from collections.abc import Mapping

import cv2
import numpy as np
from numpy.typing import NDArray
from skimage.color import rgb2hsv

from mvseg.arrays import Floats
from mvseg.formats.image_file import is_grey
from mvseg.formats.photos import Photos
from mvseg.masks import Masks
from mvseg.reconstruction.surface.leaf_surface import LeafSurface
from mvseg.scene import Cameras
from mvseg.traits.leaf import Measurement, missing

BORDER_PX = 2  # chosen: pixels this near to the edge of a mask may show something else
COLORS = ("mean_red", "mean_green", "mean_blue", "greenness_index", "senescent_share", "hue")
YELLOW_DEG = 60.0  # chosen: hues from red to here are those of yellow, brown and red leaves
OUTSIDE = missing("not measured: no photo can show it")
NO_PIXELS = missing("not measured: no pixel is surely of this leaf")
NO_PHOTOS = missing("not measured: there are no photos")
GREY = missing("not measured: the photos are grey")


def measure_appearance(
    surfaces: Mapping[int, LeafSurface], masks: Masks, cameras: Cameras, *, photos: Photos
) -> dict[int, dict[str, Measurement]]:
    """Visible share, mean colour and greenness of leaves, {instance id: {trait: number}}; photos are used, if they
    exist. The standard deviation of a colour is the standard error over the views, so there is none with one view. Grey
    photos have no part in colours. Raises InputError if a photo is broken, or missing while others exist."""
    has_photos, has_colors = bool(surfaces) and photos.exist, False
    pixels = {instance: np.zeros(2, int) for instance in surfaces}  # projected, and covered by own masks
    colors: dict[int, list[tuple[int, Floats]]] = {instance: [] for instance in surfaces}  # see `mean_colors`
    parts = {instance: surface.project_parts(cameras) for instance, surface in surfaces.items()}
    for view, size in enumerate(cameras.sizes.tolist()):
        photo = photos(view) if has_photos else None
        if photo is not None and is_grey(photo):
            photo = None
        has_colors |= photo is not None
        labels = masks.regions.label_map(view, masks.instance_ids, size).cpu().numpy().astype(np.uint16)
        is_sure = sure_pixels(labels)
        for instance in surfaces:
            part = parts[instance][view]
            own = part.pixels.numpy() & (part.cut(labels) == instance)
            pixels[instance] += (part.area, own.sum())
            sure = own & part.cut(is_sure)
            if photo is not None and sure.any():
                shown = part.cut(photo)[sure] / 255
                is_senescent = hues(shown) < YELLOW_DEG
                colors[instance].append((int(sure.sum()), np.append(shown.mean(0), is_senescent.mean())))
    numbers = {}
    for instance in surfaces:
        projected, visible = pixels[instance].tolist()
        share = Measurement(visible / projected, float("nan"), "masks") if projected else OUTSIDE
        without = dict.fromkeys(COLORS, GREY if has_photos else NO_PHOTOS)
        numbers[instance] = {"visible_share": share} | (mean_colors(colors[instance]) if has_colors else without)
    return numbers


def sure_pixels(labels: NDArray[np.uint16]) -> NDArray[np.bool_]:
    """(H, W) bool, pixels with no other label within BORDER_PX; what lies outside the picture is no other."""
    near = np.ones((2 * BORDER_PX + 1, 2 * BORDER_PX + 1), np.uint8)
    low, high = (filter(labels, near, borderType=cv2.BORDER_REPLICATE) for filter in (cv2.erode, cv2.dilate))
    return np.asarray(low == high)


def mean_colors(views: list[tuple[int, Floats]]) -> dict[str, Measurement]:
    """The traits in COLORS from the number of pixels of each view and (4,): their mean colour, 0 to 1, and the share of
    them that is yellow, brown or red."""
    if not views:
        return dict.fromkeys(COLORS, NO_PIXELS)
    weights = np.array([count for count, _ in views], dtype=np.float64)
    colors = np.stack([each for _, each in views])
    red, green, blue, senescent = colors.T
    greenness = (2 * green - red - blue) / np.maximum(2 * green + red + blue, 1e-9)
    hue = hues((weights @ colors[:, :3] / weights.sum())[None])[0]
    apart = (hues(colors[:, :3]) - hue + 180) % 360 - 180  # of the views; hues are on a circle
    table = np.column_stack([red, green, blue, greenness, senescent, apart])
    means = weights @ table / weights.sum()
    means[-1] = hue
    errors = table.std(0, ddof=1) / np.sqrt(len(views)) if len(views) > 1 else np.full(len(COLORS), np.nan)
    return {
        name: Measurement(float(mean), float(error), "photographs")
        for name, mean, error in zip(COLORS, means, errors, strict=True)
    }


def hues(colors: Floats) -> Floats:
    """(n,) hues of colours (n, 3), 0 to 1: degrees in [0, 360), 0 red, 60 yellow, 120 green; 0 for greys."""
    return np.asarray(360 * rgb2hsv(colors)[:, 0])
