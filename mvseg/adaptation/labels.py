"""Confirmed masks as labels of their photos; what may be a leaf besides is ignored."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
from torch import Tensor
from tqdm import tqdm

from mvseg.formats.image_file import write_png
from mvseg.formats.label_png import write_label_png
from mvseg.formats.photos import read_photo
from mvseg.regions import IGNORE_LABEL, Regions
from mvseg.scene import Scene
from mvseg.verification.leaf_color import ColorCounts, count_colors, has_leaf_color, leaf_colors


@dataclass(frozen=True, eq=False)
class FoundLeaves:
    """What a detector finds in the photos of a scene, and what the other views make of it.

    Attributes:
        name: of the scene, different from those of the others.
        scene: photos and cameras.
        boxes: (V, 4) int64 xyxy, half-open: the part of each photo that the detector looks at.
        found: what the detector found.
        revised: D masks as the other views corrected them, see `revise_masks`.
        confirmed: (D,) bool, which of these are labels, see `confirmed_masks`.
        num_kept: of the revised masks, those that the detector found.
    """

    name: str
    scene: Scene
    boxes: Tensor
    found: Regions
    revised: Regions
    confirmed: Tensor
    num_kept: int

    def label_map(self, view: int) -> np.ndarray:
        """(H, W) int64 of a view: 1, 2, ... for the confirmed masks, the smaller on top; 0 elsewhere."""
        numbers = self.confirmed.cumsum(0) * self.confirmed
        size = self.scene.cameras.sizes[view].tolist()
        painted = self.revised.label_map(view, numbers, size).numpy()
        return np.unique(painted, return_inverse=True)[1].reshape(painted.shape)

    def found_pixels(self, view: int) -> np.ndarray:
        """(H, W) bool of a view: pixels of any mask, before and after the correction."""
        size = self.scene.cameras.sizes[view].tolist()
        both = (self.found, self.revised)
        return np.any([regions.label_map(view, torch.ones(len(regions)).long(), size) for regions in both], axis=0)


def write_labels(found: list[FoundLeaves], folder: Path, *, longest_side: int, progress: bool = False) -> int:
    """Write every photo that shows a confirmed mask, undistorted and cut to its box, and its labels: what `mvseg train`
    takes.

    Pixels of other masks, and those of a leaf's colour without a mask, are ignored (65535): the detector learns neither
    a leaf nor background from them. Two passes over the photos, one at a time in memory: leaves of all scenes
    share their colours.

    Args:
        found: the scenes.
        folder: gets `images/` and `labels/`, with PNGs NAME-VIEW.png.
        longest_side: larger ones are scaled down to this, pixels.
        progress: show progress bars.

    Returns:
        How many photos were written.
    """
    places = [(leaves, view) for leaves in found for view in range(len(leaves.scene.views))]
    counts = ColorCounts.none()
    for leaves, view in tqdm(places, "colours", unit="photo", disable=not progress):
        counts += count_colors(read_photo(leaves.scene, view), leaves.label_map(view) > 0)
    colors, num_written = leaf_colors(counts), 0
    for leaves, view in tqdm(places, "labels", unit="photo", disable=not progress):
        labels, (x1, y1, x2, y2) = leaves.label_map(view), leaves.boxes[view].tolist()
        if not labels[y1:y2, x1:x2].any():
            continue
        photo = read_photo(leaves.scene, view)
        may_be_leaf = has_leaf_color(photo, colors) | leaves.found_pixels(view)
        labels[(labels == 0) & may_be_leaf] = IGNORE_LABEL
        photo, labels = shrink(photo[y1:y2, x1:x2], labels[y1:y2, x1:x2], longest_side)
        name = f"{leaves.name}-{leaves.scene.views[view].name.replace('/', '-')}.png"
        for kind in ("images", "labels"):
            (folder / kind).mkdir(parents=True, exist_ok=True)
        write_png(folder / "images" / name, photo)
        write_label_png(folder / "labels" / name, labels)
        num_written += 1
    return num_written


def shrink(photo: np.ndarray, labels: np.ndarray, longest_side: int) -> tuple[np.ndarray, np.ndarray]:
    """A photo (H, W, 3) and its label map (H, W) scaled down to a longer side; smaller ones stay as they are."""
    height, width = labels.shape
    factor = longest_side / max(height, width)
    if factor >= 1:
        return photo, labels
    size = (max(1, round(factor * width)), max(1, round(factor * height)))
    small = cv2.resize(labels.astype(np.uint16), size, interpolation=cv2.INTER_NEAREST_EXACT)
    return cv2.resize(photo, size, interpolation=cv2.INTER_AREA), small
