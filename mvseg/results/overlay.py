"""Pictures of a matching: the same instance has the same colour in every view."""

from __future__ import annotations

import colorsys
import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from mvseg.masks import SURE, Masks

MAX_SIDE = 1600  # pixels of an overlay's longer side
TILE_WIDTH = 480
MARGIN = 0.06  # around the plant in a tile, of its longer side
LEAST_SHARE = 0.05  # of the photo's width that a tile shows; a photo has no more detail
UNMATCHED = (150, 150, 150)
CAPITAL = 26  # pixels, height of a digit at scale 1


def instance_color(instance: int) -> tuple[int, int, int]:
    """RGB (0 to 255) of an instance; neighbouring numbers get distant hues. Grey for -1."""
    if instance < 1:
        return UNMATCHED
    hue = (0.08 + (instance - 1) * 0.6180339887) % 1.0
    saturation, value = ((0.85, 1.0), (0.55, 1.0), (0.9, 0.72))[(instance - 1) // 8 % 3]
    red, green, blue = colorsys.hsv_to_rgb(hue, saturation, value)
    return round(255 * red), round(255 * green), round(255 * blue)


def draw_overlay(photo: np.ndarray, masks: Masks, *, view: int) -> np.ndarray:
    """Tint the regions of one view in the colours of their instances, with outline and number.

    Args:
        photo: (H, W, 3) uint8 RGB, undistorted.
        masks: D masks. Unmatched regions are grey and have no number; numbers get a question mark where the
            match score is below 0.5.
        view: index of the view.

    Returns:
        uint8 RGB, scaled down so that the longer side has at most 1600 pixels.
    """
    height, width = photo.shape[:2]
    scale = min(1.0, MAX_SIDE / max(height, width))
    size = (max(1, round(width * scale)), max(1, round(height * scale)))
    window = _Window((0, 0, width, height), size)
    return _draw(photo, masks, view=view, window=window)


def draw_tile(photo: np.ndarray, masks: Masks, *, view: int) -> np.ndarray:
    """The overlay of one view for the contact sheet: 480 pixels wide, cropped to the plant (`find_plant`).

    Arguments as in `draw_overlay`.
    """
    height, width = photo.shape[:2]
    box = find_plant(masks, view=view, size=(width, height))
    tile_height = max(1, round(TILE_WIDTH * height / width))
    window = _Window(box, (TILE_WIDTH, tile_height))
    return _draw(photo, masks, view=view, window=window)


def find_plant(masks: Masks, *, view: int, size: tuple[int, int]) -> tuple[int, int, int, int]:
    """Box (xyxy, pixels) around all matched regions of one view, with a margin and the proportions of the photo.

    Args:
        masks: D masks.
        view: index of the view.
        size: width and height of the photo, pixels.

    Returns:
        The box, inside the photo; the whole photo where nothing is matched.
    """
    regions = masks.regions
    boxes = regions.boxes[(regions.view_index == view) & (masks.instance_ids > 0) & (regions.areas > 0)]
    if not len(boxes):
        return 0, 0, *size
    low, high = boxes[:, :2].amin(0).cpu().numpy(), boxes[:, 2:].amax(0).cpu().numpy()
    share = np.clip((1 + 2 * MARGIN) * ((high - low) / size).max(), LEAST_SHARE, 1.0)
    wanted = np.maximum(np.round(share * np.array(size)), 1)
    x, y = np.clip(np.round((low + high - wanted) / 2), 0, size - wanted).astype(int).tolist()
    width, height = wanted.astype(int).tolist()
    return x, y, x + width, y + height


@dataclass(frozen=True)
class _Window:
    """The part of a photo that is drawn: its box (xyxy, pixels), and the width and height of the picture of it."""

    box: tuple[int, int, int, int]
    size: tuple[int, int]

    def cut(self, image: np.ndarray, interpolation: int) -> np.ndarray:
        x1, y1, x2, y2 = self.box
        return np.asarray(cv2.resize(image[y1:y2, x1:x2], self.size, interpolation=interpolation))


@dataclass(frozen=True)
class _Number:
    """What is written, the pixel (column, row) of its middle, and the radius of the circle that fits there."""

    text: str
    center: tuple[int, int]
    radius: float


def _draw(photo: np.ndarray, masks: Masks, *, view: int, window: _Window) -> np.ndarray:
    height, width = photo.shape[:2]
    longer = max(window.size)
    enlarges = window.size[0] > window.box[2] - window.box[0]
    canvas = window.cut(photo, cv2.INTER_CUBIC if enlarges else cv2.INTER_AREA)
    painted = canvas.copy()
    labels: list[_Number] = []
    regions = masks.regions
    members = (regions.view_index == view).nonzero()[:, 0]
    members = members[regions.areas[members].argsort(descending=True, stable=True)]  # small ones on top
    for index in members.tolist():
        instance = int(masks.instance_ids[index])
        mask = window.cut(regions.mask(index, width, height).cpu().numpy().astype(np.uint8), cv2.INTER_NEAREST)
        x, y, mask_width, mask_height = cv2.boundingRect(mask)
        if not mask_width:  # too small to be seen here
            continue
        here = slice(y, y + mask_height), slice(x, x + mask_width)
        mask, color = mask[here], instance_color(instance)
        inside = mask > 0
        painted[here][inside] = 0.45 * canvas[here][inside] + 0.55 * np.array(color)
        outlines, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE, offset=(x, y))
        cv2.drawContours(painted, outlines, -1, color, max(1, round(longer / 600)))
        if instance > 0:
            # The number goes where the mask is thickest, which is always inside it.
            depth = cv2.distanceTransform(np.pad(mask, 1), cv2.DIST_L2, 3)[1:-1, 1:-1]
            row, column = np.unravel_index(depth.argmax(), depth.shape)
            doubt = "?" if masks.match_scores[index] < SURE else ""
            labels.append(_Number(f"{instance}{doubt}", (x + int(column), y + int(row)), float(depth.max())))
    _write(painted, labels, scale=max(0.35, longer / 1100))
    return painted


def shrink_to_tile(overlay: np.ndarray) -> np.ndarray:
    """An overlay (H, W, 3) as `draw_contact_sheet` shows it, 480 pixels wide; one of that width stays as it is."""
    height = max(1, round(TILE_WIDTH * overlay.shape[0] / overlay.shape[1]))
    return np.asarray(cv2.resize(overlay, (TILE_WIDTH, height), interpolation=cv2.INTER_AREA))


def draw_contact_sheet(overlays: Sequence[np.ndarray], names: Sequence[str]) -> np.ndarray:
    """All overlays of a scene, or their tiles, on one sheet, row by row, each under its view's name: uint8 RGB."""
    columns = math.ceil(math.sqrt(len(overlays)))
    columns = max(columns, min(len(overlays), 4))
    tiles = []
    for overlay, name in zip(overlays, names, strict=True):
        tile = cv2.copyMakeBorder(shrink_to_tile(overlay), 26, 4, 2, 2, cv2.BORDER_CONSTANT, value=(255, 255, 255))
        cv2.putText(tile, name, (6, 18), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (0, 0, 0), 1, cv2.LINE_AA)
        tiles.append(tile)
    tallest = max(tile.shape[0] for tile in tiles)
    blank = np.full((tallest, TILE_WIDTH + 4, 3), 255, np.uint8)
    filled = [np.concatenate((tile, blank[tile.shape[0] :])) for tile in tiles]
    filled += [blank] * (-len(filled) % columns)
    rows = [np.concatenate(filled[start : start + columns], axis=1) for start in range(0, len(filled), columns)]
    return np.concatenate(rows)


def _write(canvas: np.ndarray, numbers: Sequence[_Number], *, scale: float) -> None:
    """Black numbers with a white edge, smaller on small leaves."""
    ink = np.zeros(canvas.shape[:2], np.uint8)
    for number in numbers:
        own = float(np.clip(2 * number.radius / CAPITAL, max(0.35, 0.5 * scale), scale))
        (width, height), _ = cv2.getTextSize(number.text, cv2.FONT_HERSHEY_SIMPLEX, own, 1)
        corner = (number.center[0] - width // 2, number.center[1] + height // 2)
        cv2.putText(ink, number.text, corner, cv2.FONT_HERSHEY_SIMPLEX, own, 255, max(1, round(2 * own)), cv2.LINE_AA)
    # A thicker stroke underneath would not do as an edge: thickness differs between versions of OpenCV.
    edge = 2 * max(1, round(2 * scale)) + 1
    halo = cv2.dilate(ink, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (edge, edge)))
    for layer, color in ((halo, 255.0), (ink, 0.0)):
        near = layer > 0
        share = layer[near, None] / 255
        canvas[near] = np.round((1 - share) * canvas[near] + share * color)
