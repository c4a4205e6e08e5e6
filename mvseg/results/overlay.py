"""Pictures of a matching: the same instance has the same colour in every view."""

from __future__ import annotations

import colorsys
import math
from collections.abc import Sequence

import cv2
import numpy as np

from mvseg.matching.result import SURE, Matching
from mvseg.regions import Regions

MAX_SIDE = 1600  # pixels of an overlay's longer side
TILE_WIDTH = 480
UNMATCHED = (150, 150, 150)


def instance_color(instance: int) -> tuple[int, int, int]:
    """RGB (0 to 255) of an instance; neighbouring numbers get distant hues. Grey for -1."""
    if instance < 1:
        return UNMATCHED
    hue = (0.08 + (instance - 1) * 0.6180339887) % 1.0
    saturation, value = ((0.85, 1.0), (0.55, 1.0), (0.9, 0.72))[(instance - 1) // 8 % 3]
    red, green, blue = colorsys.hsv_to_rgb(hue, saturation, value)
    return round(255 * red), round(255 * green), round(255 * blue)


def draw_overlay(photo: np.ndarray, regions: Regions, matching: Matching, *, view: int) -> np.ndarray:
    """Tint the regions of one view in the colours of their instances, with outline and number.

    Args:
        photo: (H, W, 3) uint8 RGB, undistorted.
        regions: D regions.
        matching: of the regions. Unmatched regions are grey and have no number; numbers get a question mark where the
            match score is below 0.5.
        view: index of the view.

    Returns:
        uint8 RGB, scaled down so that the longer side has at most 1600 pixels.
    """
    height, width = photo.shape[:2]
    scale = min(1.0, MAX_SIDE / max(height, width))
    size = (max(1, round(width * scale)), max(1, round(height * scale)))
    canvas = np.asarray(cv2.resize(photo, size, interpolation=cv2.INTER_AREA))
    painted, labels = canvas.copy(), []
    members = (regions.view_index == view).nonzero()[:, 0]
    members = members[regions.areas[members].argsort(descending=True, stable=True)]  # small ones on top
    for index in members.tolist():
        instance = int(matching.instance_ids[index])
        mask = regions.mask(index, width, height).cpu().numpy().astype(np.uint8)
        mask = np.asarray(cv2.resize(mask, size, interpolation=cv2.INTER_NEAREST), np.uint8)
        color = instance_color(instance)
        painted[mask > 0] = 0.45 * canvas[mask > 0] + 0.55 * np.array(color)
        outlines, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        cv2.drawContours(painted, outlines, -1, color, max(1, round(max(size) / 600)))
        if instance > 0 and mask.any():
            # The number goes where the mask is thickest, which is always inside it.
            depth = cv2.distanceTransform(np.pad(mask, 1), cv2.DIST_L2, 3)[1:-1, 1:-1]
            row, column = np.unravel_index(depth.argmax(), depth.shape)
            doubt = "?" if matching.match_scores[index] < SURE else ""
            labels.append((f"{instance}{doubt}", (int(column), int(row))))
    for text, center in labels:
        _write(painted, text, center, scale=max(size) / 1100)
    return painted


def draw_contact_sheet(overlays: Sequence[np.ndarray], names: Sequence[str]) -> np.ndarray:
    """All overlays of a scene on one sheet, row by row, each under its view's name: uint8 RGB."""
    columns = math.ceil(math.sqrt(len(overlays)))
    columns = max(columns, min(len(overlays), 4))
    tiles = []
    for overlay, name in zip(overlays, names, strict=True):
        height = max(1, round(TILE_WIDTH * overlay.shape[0] / overlay.shape[1]))
        tile = cv2.resize(overlay, (TILE_WIDTH, height), interpolation=cv2.INTER_AREA)
        tile = cv2.copyMakeBorder(tile, 26, 4, 2, 2, cv2.BORDER_CONSTANT, value=(255, 255, 255))
        cv2.putText(tile, name, (6, 18), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (0, 0, 0), 1, cv2.LINE_AA)
        tiles.append(tile)
    tallest = max(tile.shape[0] for tile in tiles)
    blank = np.full((tallest, TILE_WIDTH + 4, 3), 255, np.uint8)
    filled = [np.concatenate((tile, blank[tile.shape[0] :])) for tile in tiles]
    filled += [blank] * (-len(filled) % columns)
    rows = [np.concatenate(filled[start : start + columns], axis=1) for start in range(0, len(filled), columns)]
    return np.concatenate(rows)


def _write(canvas: np.ndarray, text: str, center: tuple[int, int], *, scale: float) -> None:
    scale = max(0.35, scale)
    (width, height), _ = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, scale, 1)
    corner = (center[0] - width // 2, center[1] + height // 2)
    thick = max(1, round(2 * scale))
    cv2.putText(canvas, text, corner, cv2.FONT_HERSHEY_SIMPLEX, scale, (255, 255, 255), 3 * thick, cv2.LINE_AA)
    cv2.putText(canvas, text, corner, cv2.FONT_HERSHEY_SIMPLEX, scale, (0, 0, 0), thick, cv2.LINE_AA)
