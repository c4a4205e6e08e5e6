"""Masks of SAM 2 for the photos of a scene: one JSON file per photo, with the leaves among all that it segments.

    python sam2_masks.py basil/images basil/sam

SAM 2 segments everything: pot, table, the whole plant, and a leaf, its halves and its spots. `keep_leaves` keeps masks
that are as large as a leaf and no part of another one: set its two shares by your photos. The output must not exist
yet. Run it where SAM 2 is installed; mvseg is not needed.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from pycocotools.mask import iou


def main(photos: Path, out: Path) -> None:
    from sam2.automatic_mask_generator import SAM2AutomaticMaskGenerator  # here, so that tests run without it

    generator = SAM2AutomaticMaskGenerator.from_pretrained("facebook/sam2.1-hiera-large", output_mode="coco_rle")
    out.mkdir()
    for path in sorted(photos.glob("*.jpg")):
        photo = np.array(Image.open(path).convert("RGB"))
        masks = keep_leaves(generator.generate(photo), photo.shape[0] * photo.shape[1])
        Path(out, f"{path.stem}.json").write_text(json.dumps(masks))


def keep_leaves(
    masks: list[dict[str, Any]], num_pixels: int, least: float = 0.0005, most: float = 0.04
) -> list[dict[str, Any]]:
    """Masks that cover from `least` to `most` of the photo, and do not lie in a larger one of these."""
    kept: list[dict[str, Any]] = []
    for mask in sorted(masks, key=lambda each: -each["area"]):
        inside = iou([mask["segmentation"]], [each["segmentation"] for each in kept], [1] * len(kept)) if kept else 0
        if least < mask["area"] / num_pixels < most and np.max(inside) < 0.8:
            kept.append(mask)
    return kept


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:]))
