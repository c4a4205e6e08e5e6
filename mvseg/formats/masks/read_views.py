"""The masks of a scene photo by photo, whatever kind of files they are in."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from mvseg.errors import InputError, faults_of, warn
from mvseg.findings.finding import Finding
from mvseg.formats.image_file import describe_turn
from mvseg.formats.label_png import ignore_border, read_label_image, read_mask_images
from mvseg.formats.masks.found_mask import FoundMask, check_categories, check_parts
from mvseg.formats.masks.labelme import read_labelme
from mvseg.formats.masks.npy_masks import read_npy
from mvseg.formats.masks.recognise import MaskFiles
from mvseg.formats.masks.sam import read_sam
from mvseg.formats.masks.view_regions import ViewMasks
from mvseg.formats.masks.yolo import YOLO_TRACKS, read_class_names, read_yolo
from mvseg.scene import Scene

READERS: dict[str, Callable[[Path, int, int], np.ndarray | list[FoundMask]]] = {
    "label images": read_label_image, "NumPy arrays": read_npy, "labelme": read_labelme, "SAM": read_sam,
}  # fmt: skip


def read_views(scene: Scene, files: MaskFiles, *, wanted: Collection[str]) -> Iterator[ViewMasks]:
    """The masks of each view in turn, in the frame of its photo, see `stack_views`. Warns (InputWarning) at the end of
    entries without a mask, of ignored numbers, and of several categories if none is wanted. Raises InputError if a file
    is missing, broken, or of another size than its view, no entry has a mask, or a wanted category is not there."""
    counts: Counter[str] = Counter()
    num_boxes = num_borders = 0
    entries: list[FoundMask] = []
    if files.kind == YOLO_TRACKS:
        warn(Finding("confidence_and_track", str(files.source)))
    for view, paths in enumerate(files.files):
        try:
            content = read_photo_masks(paths, files.kind, scene.cameras.sizes[view].tolist())
        except InputError as error:
            raise InputError(f"{error} (view {view}{describe_turn(scene.views[view].path)})") from None
        if isinstance(content, np.ndarray):
            with faults_of(f"{paths[0]} (view {view})"):
                num_borders += ignore_border(content)
            yield content
            continue
        entries += [replace(each, mask=None) for each in content]
        counts.update(each.category for each in content if each.mask is not None)
        num_boxes += sum(each.mask is None for each in content)
        taken = [each for each in content if not wanted or each.category in wanted]
        yield [(each.label, each.mask) for each in taken if each.mask is not None]
    check_parts(entries, files.source)
    if num_borders:
        warn(Finding("border_ignored", str(files.source), {"count": num_borders}))
    if num_boxes:
        what = f"{num_boxes} entries are boxes, lines, points or to be ignored"
        if not counts.total():
            raise InputError(f"{files.source}: {what}, and none is a mask")
        warn(Finding("boxes_left_out", str(files.source), {"count": num_boxes}))
    if any(map(bool, counts)) or wanted:
        check_categories(counts, wanted, source=files.source)


def read_photo_masks(paths: Sequence[Path], kind: str, size: Sequence[int]) -> np.ndarray | list[FoundMask]:
    """The masks of one photo of this size (width, height): a label map (H, W) uint16, or a list; see `MaskFiles`.
    Raises InputError if a file is missing, broken, or of another size."""
    width, height = size
    if not paths:
        return []
    if kind in READERS:
        return READERS[kind](paths[0], width, height)
    if kind == "cellpose":
        advice = "in cellpose, save the masks as PNG or TIFF (File menu, or --save_png)"
        raise InputError(f"{paths[0]}: is a pickle, which may run anything when it is read; {advice}")
    if kind in ("YOLO", YOLO_TRACKS):
        return read_yolo(paths[0], width, height, names=read_class_names(paths[0].parent), tracks=kind == YOLO_TRACKS)
    return read_mask_images(paths, width, height)
