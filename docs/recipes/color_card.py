"""The colours of photos, corrected by a card of 24 patches (ColorChecker Classic) with PlantCV, before mvseg sees them.

    python color_card.py card.jpg basil/uncorrected basil/images

The card's photo is taken where the plant stood, with the settings of the plant's photos. The output must not exist yet;
photos keep their names and sizes. Run it where PlantCV is installed; mvseg is not needed.
"""

from __future__ import annotations

import sys
from pathlib import Path

import cv2
import numpy as np
from plantcv import plantcv as pcv
from skimage.color import deltaE_ciede2000, rgb2lab

SUFFIXES = {".jpg", ".jpeg", ".png", ".tif", ".tiff"}


def main(card: Path, photos: Path, out: Path) -> None:
    shown = read_photo(card)
    patches = pcv.transform.detect_color_card(shown)
    published = pcv.transform.std_color_matrix(pos=3)  # white at the top left, as `detect_color_card` turns a card
    _, seen = pcv.transform.get_color_matrix(shown, patches)
    _, corrected = pcv.transform.get_color_matrix(correct(shown, seen, published), patches)
    delta_e = deltaE_ciede2000(rgb2lab(corrected[:, 1:]), rgb2lab(published[:, 1:])).mean()
    print(f"{card}: the corrected patches differ by Delta E {delta_e:.1f} from the published ones")
    if not delta_e < 10:
        sys.exit(f"{card}: is no card, or not under one light")
    out.mkdir(parents=True)  # an error where it exists
    for path in sorted(path for path in photos.iterdir() if path.suffix.lower() in SUFFIXES):
        cv2.imwrite(str(out / path.name), correct(read_photo(path), seen, published), [cv2.IMWRITE_JPEG_QUALITY, 98])


def correct(photo: np.ndarray, seen: np.ndarray, published: np.ndarray) -> np.ndarray:
    return pcv.transform.affine_color_correction(photo, seen, published)


def read_photo(path: Path) -> np.ndarray:
    """(H, W, 3) uint8 BGR, as PlantCV and OpenCV have it; pixels as stored, which masks and cameras are of."""
    photo = cv2.imread(str(path), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    if photo is None:
        sys.exit(f"{path}: cannot be read")
    return photo


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:]))
