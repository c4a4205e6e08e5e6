"""How much of each leaf the photos show, and in which colour."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from mvseg.formats.image_file import is_grey
from mvseg.formats.photos import Photos
from mvseg.masks import Masks
from mvseg.reconstruction.surface.leaf_surface import MESH_SHAPE, LeafSurface
from mvseg.reconstruction.surface.patch_image import draw_polygons, grid_quads
from mvseg.scene import Cameras
from mvseg.traits.color_correction import correct_colors
from mvseg.traits.config import ColorCorrection
from mvseg.traits.leaf import Measurement, missing

Floats = NDArray[np.float64]

BORDER_PX = 2  # pixels this near to the edge of a mask may show something else
COLORS = ("mean_red", "mean_green", "mean_blue", "greenness_index", "senescent_share", "hue")
YELLOW_DEG = 60.0  # hues from red to here are those of yellow, brown and red leaves
OUTSIDE = missing("not measured: no photo can show it")
NO_PIXELS = missing("not measured: no pixel is surely of this leaf")
NO_PHOTOS = missing("not measured: there are no photos")
GREY = missing("not measured: the photos are grey")


def measure_appearance(
    surfaces: Mapping[int, LeafSurface],
    masks: Masks,
    cameras: Cameras,
    *,
    photos: Photos,
    corrections: Sequence[ColorCorrection | None] = (),
) -> dict[int, dict[str, Measurement]]:
    """Visible share, mean colour and greenness of leaves.

    Args:
        surfaces: {instance id: surface that exists}.
        masks: D masks of the scene, with ids.
        cameras: V cameras.
        photos: looked at, if they exist.
        corrections: of the colours, one per view; where there is any, views without one have no part in the colours.

    Returns:
        {instance id: {trait: number}}. The standard deviation of a colour is the standard error over the views, so
        there is none with one view. Grey photos have no part in colours.

    Raises:
        InputError: a photo is broken, or missing while others exist.
    """
    has_photos = bool(surfaces) and photos.exist
    pixels = {instance: np.zeros(2, int) for instance in surfaces}  # projected, and covered by own masks
    colors: dict[int, list[tuple[int, Floats]]] = {instance: [] for instance in surfaces}  # see `mean_colors`
    has_colors, is_corrected = False, any(corrections)
    for view in range(len(cameras)):
        photo = photos(view) if has_photos else None
        if photo is not None and is_grey(photo):
            photo = None
        has_colors |= photo is not None
        correction = corrections[view] if is_corrected else None
        labels = masks.regions.label_map(view, masks.instance_ids, cameras.sizes[view].tolist()).cpu().numpy()
        for instance, surface in surfaces.items():
            covered, (x, y) = project_crop(surface, cameras, view)
            if not covered.any():
                continue
            window = np.s_[y : y + covered.shape[0], x : x + covered.shape[1]]
            own = labels[window] == instance
            pixels[instance] += (covered.sum(), (covered & own).sum())
            if photo is not None and (correction is not None or not is_corrected):
                sure = covered & shrink(own)
                if sure.any():
                    seen = photo[window][sure]
                    shown = seen / 255 if correction is None else correct_colors(correction, seen)
                    is_senescent = hues(shown) < YELLOW_DEG
                    colors[instance].append((int(sure.sum()), np.append(shown.mean(0), is_senescent.mean())))
    found = {}
    for instance in surfaces:
        projected, visible = pixels[instance].tolist()
        share = Measurement(visible / projected, float("nan"), "masks") if projected else OUTSIDE
        why, method = GREY if has_photos else NO_PHOTOS, describe_colors(corrections)
        of_photos = mean_colors(colors[instance], method) if has_colors else dict.fromkeys(COLORS, why)
        found[instance] = {"visible_share": share, **of_photos}
    return found


def project_crop(surface: LeafSurface, cameras: Cameras, view: int) -> tuple[NDArray[np.bool_], tuple[int, int]]:
    """What `surface.project` gives for one view, as a crop with a margin: (h, w) bool and the crop's corner x, y."""
    width, height = cameras.sizes[view].tolist()
    points, depths = cameras[[view]].project(surface.points().reshape(-1, 3))
    is_ahead = (grid_quads(depths.reshape(*MESH_SHAPE, 1).cpu().numpy()) > 0).all((1, 2))
    quads = grid_quads(points.reshape(*MESH_SHAPE, 2).cpu().numpy())[is_ahead]
    if not len(quads):
        return np.zeros((0, 0), bool), (0, 0)
    margin = BORDER_PX + 1
    low, high = quads.min((0, 1)) - margin, quads.max((0, 1)) + margin
    x1, y1 = np.floor(np.clip(low, 0, (width, height))).astype(int).tolist()
    x2, y2 = np.ceil(np.clip(high, 0, (width, height))).astype(int).tolist()
    if x1 == x2 or y1 == y2:
        return np.zeros((0, 0), bool), (0, 0)
    return draw_polygons(quads, (x2 - x1, y2 - y1), np.array([x1, y1])) >= 0.5, (x1, y1)


def shrink(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """A mask (h, w) without the pixels within BORDER_PX of others; what lies outside the picture is no other."""
    side = 2 * BORDER_PX + 1
    eroded = cv2.erode(mask.astype(np.uint8), np.ones((side, side), np.uint8), borderType=cv2.BORDER_REPLICATE)
    return np.asarray(eroded, bool)


def describe_colors(corrections: Sequence[ColorCorrection | None]) -> str:
    """How the colours of photos were measured, with the residual of the worst card."""
    residuals = [correction.delta_e for correction in corrections if correction is not None]
    return f"photographs, corrected (Delta E {max(residuals):.1f})" if residuals else "photographs, uncorrected"


def mean_colors(views: list[tuple[int, Floats]], method: str) -> dict[str, Measurement]:
    """The traits in COLORS from the number of pixels of each view and (4,): their mean colour, 0 to 1, and the share of
    them that is yellow, brown or red."""
    if not views:
        return dict.fromkeys(COLORS, NO_PIXELS)
    weights = np.array([count for count, _ in views], dtype=np.float64)
    seen = np.stack([each for _, each in views])
    red, green, blue, senescent = seen.T
    greenness = (2 * green - red - blue) / np.maximum(2 * green + red + blue, 1e-9)
    hue = hues((weights @ seen[:, :3] / weights.sum())[None])[0]
    apart = (hues(seen[:, :3]) - hue + 180) % 360 - 180  # of the views; hues are on a circle
    table = np.column_stack([red, green, blue, greenness, senescent, apart])
    means = weights @ table / weights.sum()
    means[-1] = hue
    errors = table.std(0, ddof=1) / np.sqrt(len(views)) if len(views) > 1 else np.full(len(COLORS), np.nan)
    return {
        name: Measurement(float(mean), float(error), method)
        for name, mean, error in zip(COLORS, means, errors, strict=True)
    }


def hues(colors: Floats) -> Floats:
    """(n,) hues of colours (n, 3), 0 to 1: degrees in [0, 360), 0 red, 60 yellow, 120 green; 0 for greys."""
    low, high = colors.min(1), colors.max(1)
    spread = np.where(high > low, high - low, 1)
    (red, green, blue), top = colors.T, colors.argmax(1)
    sixths = np.choose(top, [(green - blue) / spread, 2 + (blue - red) / spread, 4 + (red - green) / spread])
    degrees: Floats = 60 * sixths % 360
    return np.where(degrees >= 360, 0.0, degrees)
