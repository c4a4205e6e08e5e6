"""Segment Anything's automatic masks, one JSON file per photo: SA-1B's (`annotations`), or the list of
`SamAutomaticMaskGenerator` with run lengths. Masks may overlap."""

from __future__ import annotations

from pathlib import Path

from mvseg.errors import InputError, faults_of
from mvseg.formats.coco import check_segmentations, decode_segmentation
from mvseg.formats.json_file import load_json
from mvseg.formats.masks.found_mask import FoundMask


def read_sam(path: Path, width: int, height: int) -> list[FoundMask]:
    """The masks of a photo, numbered from 1 in the order of the file. Raises InputError if it is of another form, or a
    mask is broken or of another size."""
    content = load_json(path)
    entries = content.get("annotations") if isinstance(content, dict) else content
    if not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
        expected = "expected labelme's (shapes) or Segment Anything's (annotations, or a list of masks)"
        raise InputError(f"{path}: is JSON of another form, {expected}")
    segmentations = [entry.get("segmentation") for entry in entries]
    with faults_of(path):
        check_segmentations((each, (width, height)) for each in segmentations)
    masks = []
    for number, segmentation in enumerate(segmentations, start=1):
        with faults_of(f"{path}: mask {number}"):
            mask = None if segmentation in (None, []) else decode_segmentation(segmentation, width, height)
        masks.append(FoundMask(number, mask))
    return masks
