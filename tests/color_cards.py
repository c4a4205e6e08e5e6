"""Rendered colour cards under coloured light."""

from __future__ import annotations

import cv2
import numpy as np

from mvseg.traits.color_correction import PUBLISHED, from_linear, to_linear

SIZE, PATCH, GAP = (640, 480), 48, 12  # of the photo (width, height), and of the card, pixels
LAMP = np.array([[0.9, 0.05, 0.0], [0.04, 0.7, 0.04], [0.0, 0.06, 0.4]])  # warm, and a camera that is not sRGB
SHADE = np.diag([0.35, 0.45, 0.6])


def draw_card() -> np.ndarray:
    """(H, W, 3) uint8: the card as it is published, on its black frame."""
    card = np.full((4 * (PATCH + GAP) + GAP, 6 * (PATCH + GAP) + GAP, 3), 25, np.uint8)
    for patch, color in enumerate(PUBLISHED):
        y, x = (GAP + (PATCH + GAP) * step for step in divmod(patch, 6))
        card[y : y + PATCH, x : x + PATCH] = color
    return card


def photograph_card(light: np.ndarray, *, turn: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """A noisy photo (H, W, 3) uint8 of the card, and the centres (4, 2) of its corner patches, in pixels.

    Args:
        light: (3, 3) from the card's linear light to that of the photo.
        turn: of the card, degrees.
    """
    card, center = draw_card(), np.array(SIZE) / 2
    half = np.array(card.shape[1::-1]) / 2
    box = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]) * half
    turned = np.radians(turn)
    rotation = np.array([[np.cos(turned), -np.sin(turned)], [np.sin(turned), np.cos(turned)]])
    seen = box @ rotation.T + center + [(4, 6), (-8, 2), (6, -4), (0, 5)]  # not quite from in front
    px_from_card = cv2.getPerspectiveTransform((box + half).astype(np.float32), seen.astype(np.float32))
    inner = half - GAP - PATCH / 2
    corners = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]) * inner + half
    photo = cv2.warpPerspective(card, px_from_card, SIZE, borderValue=(90, 110, 80))
    photo = 255 * under_light(photo, light) + np.random.default_rng(0).normal(0, 2, photo.shape)
    placed = cv2.perspectiveTransform(corners[:, None], px_from_card)[:, 0]
    return np.clip(photo, 0, 255).astype(np.uint8), placed


def under_light(pixels: np.ndarray, light: np.ndarray) -> np.ndarray:
    """(..., 3) sRGB values from 0 to 1 of pixels (..., 3) from 0 to 255 that a light falls on."""
    return from_linear(to_linear(np.asarray(pixels) / 255) @ light.T)
