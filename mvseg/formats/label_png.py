"""Label images: PNGs of 16 (or 8) bits with a single channel; 0 = nothing, 65535 = ignore, any other number = one mask.

A palette PNG gives its indices, not its colours: the tools that write labels with a palette (as PASCAL VOC's are) mean
the index. VOC's border of 255 around its numbers is ignored.

Masks of other tools (`read_label_image`) may also be TIFF, have 32 bits (numbers of cellpose and ImageJ, floats
included) or colours of 8 or 16 bits (CVAT's and datumaro's VOC export): each colour is one mask, black is nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image
from scipy import ndimage

from mvseg.errors import InputError
from mvseg.formats.image_file import WrongSize, read_deep, read_image, write_png
from mvseg.formats.masks.found_mask import FoundMask
from mvseg.regions import IGNORE_LABEL

MAX_COLOURS = 1000  # limit: more than leaves on a photo; photos and blurred masks have far more
VOC_BORDER = 255  # definition: index, in palette PNGs
VOC_BORDER_COLOUR = (224 << 16) + (224 << 8) + 192  # definition: of that index


def read_label_png(path: Path, width: int, height: int) -> np.ndarray:
    """(height, width) uint16 label map of a view. Raises InputError as `read_labels`, or for another size."""
    return read_labels(path, (width, height))


def read_labels(path: Path, size: tuple[int, int] | None = None) -> np.ndarray:
    """(H, W) uint16 label map, of any size unless `size` (width, height) is given. Raises InputError if the file is
    missing, cannot be decoded, is a JPEG, has colour channels, or does not hold unsigned numbers of at most 16 bits."""
    return labels_of(open_labels(path, size), path)


def open_labels(path: Path, size: tuple[int, int] | None = None) -> Image.Image:
    """The decoded image of a label file. Raises InputError if it is missing, cannot be decoded, is a JPEG, or has
    another size (width, height) than its camera states."""
    if not path.is_file():
        raise InputError(f"{path}: the mask file is missing")
    try:
        image = read_image(path, size)
    except WrongSize as error:
        raise InputError(f"{path}: the mask is {error}") from None
    except InputError as error:
        raise InputError(f"{path}: cannot be read, expected a whole label PNG: {error}") from None
    if image.format == "JPEG":
        raise InputError(f"{path}: is a JPEG, which blurs the numbers of masks: export PNG instead")
    return image


def labels_of(image: Image.Image, path: Path) -> np.ndarray:
    """(H, W) uint16 from a decoded image; see `read_labels`."""
    num_channels = len(image.getbands())
    if num_channels > 1:
        raise InputError(f"{path}: has {num_channels} colour channels, expected a label PNG with a single channel")
    if image.mode in ("I", "F"):
        raise InputError(f"{path}: holds signed or 32-bit numbers, expected 8 or 16 bits without sign")
    labels = np.asarray(image.convert("L") if image.mode == "1" else image).astype(np.uint16)
    if image.mode == "P" and ((labels > 0) & (labels < VOC_BORDER)).any() and not _clear_background(labels, path):
        labels[labels == VOC_BORDER] = IGNORE_LABEL
    return labels


def _clear_background(labels: np.ndarray, where: object = "") -> bool:
    """Set 255 to 0 in place where it is around all masks of a label map (H, W) uint16 and none itself; True if so."""
    sides = np.concatenate((labels[0], labels[-1], labels[1:-1, 0], labels[1:-1, -1]))
    background = labels == VOC_BORDER
    if 2 * np.count_nonzero(sides == VOC_BORDER) <= len(sides):
        return False
    num_zeros = np.count_nonzero(labels == 0)
    if 0 < num_zeros < np.count_nonzero(background):
        mend = "is 255 the background, and 0 a leaf? add 1, so that it becomes 0 in 8 bits"
        raise InputError(f"{where}: 255 is around all masks, and 0 among them: {mend}" if where else mend)
    if num_zeros:
        return False
    labels[background] = 0
    return True


def read_label_image(path: Path, width: int, height: int) -> np.ndarray:
    """(height, width) uint16: 0 = nothing, 65535 = ignore, any other number = one mask of this photo. Colours are
    numbered in the order red, green, blue; grey colours keep their value. Raises InputError if the file cannot be
    decoded, is a JPEG, has several pages, another size, numbers that are no labels, or too many colours."""
    image = open_labels(path, (width, height))
    try:
        num_pages = getattr(image, "n_frames", 1)
    except Exception:  # Pillow raises almost anything on a damaged file
        raise InputError(f"{path}: cannot be read, expected a whole image: its list of pages is damaged") from None
    if num_pages > 1:
        mend = "number its masks in one page, or save the stack as .npy"
        raise InputError(f"{path}: holds {num_pages} pages, expected one label image: {mend}")
    if image.mode in ("RGB", "RGBA"):
        return _number_colours(path, image, read_deep(path, image))
    if image.mode in ("I", "F"):
        return labels_of_numbers(path, np.asarray(image))
    if image.mode == "P" and _is_reordered(image):
        return _number_colours(path, image.convert("RGB"), None)
    return labels_of(image, path)


def _is_reordered(image: Image.Image) -> bool:
    """Whether a program has ordered the palette anew, so that the index of black, which is nothing, is not 0."""
    palette = np.array(image.getpalette() or [0, 0, 0]).reshape(-1, 3)
    used = [index for _, index in image.getcolors(1 << 16) or [] if isinstance(index, int) and index < len(palette)]
    is_black = [index for index in used if index and not palette[index].any()]
    return bool(is_black) and bool(palette[0].any()) and len(used) > 2


def ignore_border(labels: np.ndarray) -> bool:
    """Whether 255 is VOC's border in a label map (H, W) uint16, which then becomes 65535 in place: more of the other
    masks' pixels touch it than touch nothing. In palette PNGs it is ignored in any case."""
    if labels.max(initial=0) != VOC_BORDER or _clear_background(labels):
        return False
    border = labels == VOC_BORDER
    is_other = (labels > 0) & ~border
    beside = [np.count_nonzero(is_other & ndimage.binary_dilation(each)) for each in (border, labels == 0)]
    if is_voc := bool(beside[0] > beside[1]):
        labels[border] = IGNORE_LABEL
    return is_voc


def labels_of_numbers(path: Path, numbers: np.ndarray) -> np.ndarray:
    """uint16 labels from an array of any number type, renumbered from 1 if its numbers go beyond 16 bits. Raises
    InputError for negative numbers, fractions, or more different numbers than 16 bits hold."""
    if not np.issubdtype(numbers.dtype, np.number) or np.issubdtype(numbers.dtype, np.complexfloating):
        raise InputError(f"{path}: holds {numbers.dtype}, expected whole numbers")
    if not np.isfinite(numbers).all() or (numbers < 0).any() or (numbers != np.floor(numbers)).any():
        mend = "; if -1 is the background, add 1" if np.isfinite(numbers).all() and numbers.min() == -1 else ""
        raise InputError(f"{path}: holds numbers that are no labels, expected whole numbers from 0{mend}")
    if numbers.max(initial=0) <= IGNORE_LABEL:
        return numbers.astype(np.uint16)
    distinct, indices = np.unique(numbers, return_inverse=True)
    if len(distinct) >= IGNORE_LABEL:
        raise InputError(f"{path}: holds {len(distinct)} different numbers, expected one per mask")
    return (indices.reshape(numbers.shape) + (distinct[0] != 0)).astype(np.uint16)


def _number_colours(path: Path, image: Image.Image, deep: np.ndarray | None) -> np.ndarray:
    """`deep`: its colours (H, W, 3) uint16, if it has 16 bits."""
    channels = np.asarray(image)
    colours, bits = (channels, 8) if deep is None else (deep, 16)
    red, green, blue = (colours[..., channel].astype(np.int64) for channel in range(3))
    if ((red == green) & (green == blue)).all():
        labels = red.astype(np.uint16)
    else:
        codes, indices = np.unique((red << 2 * bits) + (green << bits) + blue, return_inverse=True)
        if len(codes) > MAX_COLOURS:
            message = f"holds {len(codes)} colours, expected one per mask and at most {MAX_COLOURS}"
            raise InputError(f"{path}: {message}; is it a photo, or a mask that was scaled or blurred?")
        numbers = np.arange(len(codes)) + (codes[0] != 0)
        if bits == 8:
            numbers[codes == VOC_BORDER_COLOUR] = IGNORE_LABEL
        labels = numbers[indices].reshape(red.shape).astype(np.uint16)
    if image.mode == "RGBA":
        labels[channels[..., 3] == 0] = 0
    return labels


def read_mask_images(paths: Sequence[Path], width: int, height: int) -> list[FoundMask]:
    """The masks of one photo, an image each (of SAM's own script, BOP and many segmenters): pixels that are not black.
    They are numbered from 1 in the order of the paths, and may overlap. Raises InputError if a file cannot be decoded,
    is a JPEG, or has another size."""
    masks = []
    for number, path in enumerate(paths, start=1):
        image = open_labels(path, (width, height))
        pixels = np.atleast_3d(np.asarray(image))
        mask = pixels[..., :-1].any(2) & (pixels[..., -1] > 0) if image.mode in ("RGBA", "LA") else pixels.any(2)
        masks.append(FoundMask(number, np.asarray(mask)))
    return masks


def write_label_png(path: Path, labels: np.ndarray) -> None:
    """Write an integer label map (H, W) with values in [0, 65535] as a 16-bit PNG; its folder is made."""
    path.parent.mkdir(parents=True, exist_ok=True)
    write_png(path, labels.astype(np.uint16))
