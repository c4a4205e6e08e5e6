"""Masks of SAM 3 for the photos of a scene: one array (N, H, W) per photo, since masks may overlap.

    python sam3_masks.py basil/images basil/sam3

The output must not exist yet. Run it where SAM 3 is installed; mvseg is not needed.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from PIL import Image
from sam3.model.sam3_image_processor import Sam3Processor
from sam3.model_builder import build_sam3_image_model


def main(photos: Path, out: Path) -> None:
    processor = Sam3Processor(build_sam3_image_model())
    out.mkdir()
    for path in sorted(photos.glob("*.jpg")):
        state = processor.set_image(Image.open(path).convert("RGB"))
        answer = processor.set_text_prompt(state=state, prompt="leaf")
        masks = answer["masks"].cpu().numpy() > 0
        np.save(out / f"{path.stem}.npy", masks.reshape(-1, *masks.shape[-2:]))


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:]))
