"""Pictures of a matching: the same instance has the same colour in every view."""

from __future__ import annotations

import colorsys
from collections.abc import Sequence

import cv2
import numpy as np

from mvseg.crop import Box
from mvseg.masks import SURE, Masks

MAX_SIDE = 1600  # limit: max. pixels of an overlay's longer side
MARGIN = 0.06  # limit: margin around the plant in a picture, as a share of its longer side
LEAST_SHARE = 0.05  # limit: min. width of a picture as a share of the photo's: a photo has no more detail
UNMATCHED = (150, 150, 150)  # chosen: RGB of masks without an instance
CAPITAL = 26  # limit: pixels of the height of OpenCV's digits at scale 1

_Number = tuple[str, tuple[int, int], float]  # text, column and row of its middle, radius of the circle that fits there


def instance_color(instance: int) -> tuple[int, int, int]:
    """RGB (0 to 255) of an instance; neighbouring numbers get distant hues. Grey for -1."""
    if instance < 1:
        return UNMATCHED
    hue = (0.08 + (instance - 1) * 0.6180339887) % 1.0
    saturation, value = ((0.85, 1.0), (0.55, 1.0), (0.9, 0.72))[(instance - 1) // 8 % 3]
    red, green, blue = colorsys.hsv_to_rgb(hue, saturation, value)
    return round(255 * red), round(255 * green), round(255 * blue)


def draw_overlay(photo: np.ndarray, masks: Masks, *, view: int) -> np.ndarray:
    """Tint the masks of one view in the colours of their instances, with contour and number.

    Unmatched ones are grey and have no number; numbers get a question mark where the match score is below 0.5. The
    photo is (H, W, 3) uint8 RGB, undistorted; so is the overlay, scaled down to at most 1600 pixels on its longer side.
    """
    height, width = photo.shape[:2]
    scale = min(1.0, MAX_SIDE / max(height, width))
    size = (max(1, round(width * scale)), max(1, round(height * scale)))
    longer, regions = max(size), masks.regions
    canvas = np.asarray(cv2.resize(photo, size, interpolation=cv2.INTER_AREA))
    painted, numbers = canvas.copy(), list[_Number]()
    for index in regions.large_first(view):
        instance = int(masks.instance_ids[index])
        whole = regions.mask(index, width, height).cpu().numpy().astype(np.uint8)
        mask = np.asarray(cv2.resize(whole, size, interpolation=cv2.INTER_NEAREST))
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
            (column, row), radius = find_thickest(mask)
            doubt = "?" if masks.match_scores[index] < SURE else ""
            numbers.append((f"{instance}{doubt}", (x + column, y + row), radius))
    _write(painted, numbers, scale=max(0.35, longer / 1100))
    return painted


def find_plant(masks: Masks, *, view: int, size: tuple[int, int]) -> Box:
    """Box (xyxy, pixels) around all matched masks of one view, with a margin, inside the photo of this width and height
    and with its proportions; the whole photo where nothing is matched."""
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


def find_thickest(mask: np.ndarray) -> tuple[tuple[int, int], float]:
    """Column and row of the middle of the largest circle in a mask (h, w) uint8, which is always inside it, and its
    radius."""
    depth = cv2.distanceTransform(np.pad(mask, 1), cv2.DIST_L2, 3)[1:-1, 1:-1]
    row, column = np.unravel_index(int(depth.argmax()), depth.shape)
    return (int(column), int(row)), float(depth.max())


def _write(canvas: np.ndarray, numbers: Sequence[_Number], *, scale: float) -> None:
    ink = np.zeros(canvas.shape[:2], np.uint8)
    for text, (column, row), radius in numbers:
        own = float(np.clip(2 * radius / CAPITAL, max(0.35, 0.5 * scale), scale))
        (width, height), _ = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, own, 1)
        corner = (column - width // 2, row + height // 2)
        cv2.putText(ink, text, corner, cv2.FONT_HERSHEY_SIMPLEX, own, 255, max(1, round(2 * own)), cv2.LINE_AA)
    # A thicker stroke underneath would not do as an edge: thickness differs between versions of OpenCV.
    edge = 2 * max(1, round(2 * scale)) + 1
    halo = cv2.dilate(ink, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (edge, edge)))
    for layer, color in ((halo, 255.0), (ink, 0.0)):
        near = layer > 0
        share = layer[near, None] / 255
        canvas[near] = np.round((1 - share) * canvas[near] + share * color)
