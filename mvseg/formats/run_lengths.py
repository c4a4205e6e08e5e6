"""COCO's run lengths: masks as the lengths of runs of pixels down the columns, plain or compressed to a string."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from pycocotools import mask as coco_mask
from pydantic import BaseModel, NonNegativeInt

from mvseg.crop import Crop
from mvseg.errors import InputError
from mvseg.formats.json_file import Items

MOST_CHARACTERS = 8  # limit: of a number: 40 bits are more pixels than any image has


class Rle(BaseModel):
    """A run-length encoded mask as it stands in the file; size is (height, width)."""

    size: tuple[int, int]
    counts: str | Items[NonNegativeInt]


def decode_rle(counts: str | list[int], width: int, height: int) -> np.ndarray:
    """(height, width) bool from the counts of a COCO RLE, compressed or not: run lengths down the columns, 0 first.
    Raises InputError if they do not add up to the image, where pycocotools leaves uninitialised memory."""
    runs = _read_runs(counts, width, height)
    return np.repeat(np.arange(len(runs)) % 2 == 1, runs).reshape(width, height).T


def decode_crop(counts: str | list[int], width: int, height: int) -> Crop:
    """The tight crop of the mask that `decode_rle` gives, without the rest of the image; of a mask without pixels one
    that is not set, (0, 0, 1, 1). Raises InputError if the counts do not add up to the image."""
    runs = _read_runs(counts, width, height)
    ends, is_mask = runs.cumsum(), np.arange(len(runs)) % 2 == 1
    some = is_mask & (runs > 0)
    columns = np.append((ends - runs)[some], ends[some] - 1) // height
    left, right = (int(columns.min()), int(columns.max()) + 1) if len(columns) else (0, 1)
    borders = np.clip(ends, left * height, right * height) - left * height
    strip = np.repeat(is_mask, np.diff(borders, prepend=0)).reshape(right - left, height)
    return Crop((left, 0, right, height), torch.from_numpy(strip.T)).tighten()


def _read_runs(counts: str | list[int], width: int, height: int) -> NDArray[np.int64]:
    runs = _decompress(counts) if isinstance(counts, str) else counts
    if min(runs, default=0) < 0 or sum(runs) != width * height:
        raise InputError(f"its run lengths do not add up to {width} x {height} pixels")
    return np.array(runs, np.int64)


def _decompress(counts: str) -> list[int]:
    """Run lengths from COCO's string: 5 bits per character, the sixth says more follow; from run 4 on, differences."""
    bits = np.frombuffer(counts.encode("utf-32-le", "surrogatepass"), "<u4").astype(np.int64) - 48
    last = np.flatnonzero(bits & 0x20 == 0)  # character of each number
    first = np.append(0, last[:-1] + 1)[: len(last)]
    lengths = last - first + 1
    if max(lengths, default=0) > MOST_CHARACTERS:
        raise InputError("its run lengths are not a string that COCO writes")
    if not len(last):
        return []
    bits = bits[: last[-1] + 1]
    shifts = 5 * (np.arange(len(bits)) - np.repeat(first, lengths))
    numbers = np.add.reduceat((bits & 0x1F) << shifts, first)
    numbers -= (bits[last] & 0x10 != 0) * (1 << 5 * lengths)  # the sign
    for start in (1, 2):
        numbers[start::2] = numbers[start::2].cumsum()
    return numbers.tolist()


def encode_mask(mask: np.ndarray) -> dict[str, Any]:
    """(H, W) bool -> COCO compressed RLE that json can write."""
    rle = coco_mask.encode(np.asfortranarray(mask, dtype=np.uint8))
    return {"size": [int(side) for side in rle["size"]], "counts": rle["counts"].decode("ascii")}


def shared_neighbours(runs: NDArray[np.int64], width: int, height: int) -> tuple[float, float]:
    """How many pixels of a mask have its next pixel beside them in the next column, by runs down the columns, and by
    runs along the rows. Of a mask that hangs together, the right one is nearly all."""
    ends = runs.cumsum()
    stops = ends[1::2]
    starts = ends[::2][: len(stops)]
    places = np.append(0, np.stack([starts, stops], 1).ravel())
    counts = np.append(0, np.stack([0 * starts, stops - starts], 1).ravel().cumsum())

    def shared(step: int) -> float:
        return float((np.interp(stops + step, places, counts) - np.interp(starts + step, places, counts)).sum())

    return shared(height), shared(width)
