"""Photos with instance masks as training samples: finding, checking and reading them.

Two layouts: a folder of photos with a folder of label PNGs (same path and stem; 8 or 16 bit; 0 is background, 65535 is
ignored; a scene's `images/` and `masks/` are such a pair), or a folder of photos with one COCO JSON file. A photo
without any instance is a sample like another, provided that its label PNG or its COCO entry exists.
Broken samples are reported by name, all of them; nothing is dropped in silence.
"""

from __future__ import annotations

import json
import os
from collections import defaultdict
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from pycocotools import mask as coco_mask
from torch import Tensor
from tqdm import tqdm

from mvseg.errors import InputError
from mvseg.regions import IGNORE_LABEL

PHOTO_SUFFIXES = frozenset({".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp", ".webp"})


@dataclass(frozen=True)
class Sample:
    """One photo and where its instances are.

    Attributes:
        name: the photo's path below its folder; what reports and logs call it.
        photo: the image file.
        label_map: a single-channel PNG, or None when the instances come from `annotations`.
        annotations: COCO annotations of this photo.
        size: (height, width) in pixels that the COCO file states, or None.
        class_of: COCO category id -> class, from 1 on.
    """

    name: str
    photo: Path
    label_map: Path | None = None
    annotations: tuple[Mapping[str, Any], ...] = ()
    size: tuple[int, int] | None = None
    class_of: Mapping[int, int] = field(default_factory=dict)


@dataclass(frozen=True)
class SampleList:
    """Samples in the order of their names, and the names of classes 1, 2, ... (background is 0 and has none)."""

    samples: tuple[Sample, ...]
    categories: tuple[str, ...]

    def __len__(self) -> int:
        return len(self.samples)

    def select(self, indices: Sequence[int]) -> SampleList:
        return SampleList(tuple(self.samples[index] for index in indices), self.categories)


@dataclass(frozen=True, eq=False)
class LabelledPhoto:
    """A sample in memory.

    Attributes:
        photo: (3, H, W) uint8, RGB.
        layers: (L, H, W) int32, 0 for nothing, k for the k-th instance; an instance lies whole in one layer, and there
            are as many layers as overlaps ask for (one for a label map).
        classes: (N,) int64, class of instance 1..N.
        ignore: (H, W) bool, pixels that nobody may learn from or judge.
    """

    photo: Tensor
    layers: Tensor
    classes: Tensor
    ignore: Tensor


# --- which samples there are


def list_samples(photos: Path, labels: Path) -> SampleList:
    """Find the samples of a folder of photos with a folder of label PNGs or with a COCO JSON file.

    Args:
        photos: folder, searched with its subfolders; with a COCO file the folder that `file_name` starts from.
        labels: folder with `<path of the photo>.png` for every photo, or a .json file.

    Returns:
        Samples in the order of their names. The files are not opened; see `check_samples`. Label PNGs have one
        category, "leaf".

    Raises:
        InputError: a missing folder or file, no photo at all, a JSON file that is not COCO, an annotation of an unknown
            image, two photos with one stem.
    """
    if not photos.is_dir():
        raise InputError(f"{photos} is not a folder, expected the folder of the photos")
    if labels.is_dir():
        return list_label_maps(photos, labels)
    if labels.suffix == ".json" and labels.is_file():
        return list_coco(photos, labels)
    raise InputError(f"{labels} is neither a folder of label PNGs nor a COCO .json file")


def list_label_maps(photos: Path, labels: Path) -> SampleList:
    found = sorted(path for path in photos.rglob("*") if path.suffix.lower() in PHOTO_SUFFIXES)
    if not found:
        raise InputError(f"{photos} holds no photo ({', '.join(sorted(PHOTO_SUFFIXES))})")
    by_stem: dict[Path, Path] = {}
    for path in found:
        stem = path.relative_to(photos).with_suffix("")
        if stem in by_stem:
            raise InputError(f"{by_stem[stem]} and {path} would share one label PNG, expected one photo per stem")
        by_stem[stem] = path
    # a label map without a photo is listed too, so that the check reports it
    for label_map in sorted(labels.rglob("*.png")):
        stem = label_map.relative_to(labels).with_suffix("")
        by_stem.setdefault(stem, (photos / stem).with_suffix(".*"))
    samples = (
        Sample(path.relative_to(photos).as_posix(), path, labels / f"{stem.as_posix()}.png")
        for stem, path in sorted(by_stem.items())
    )
    return SampleList(tuple(samples), ("leaf",))


def list_coco(photos: Path, labels: Path) -> SampleList:
    try:
        content = json.loads(labels.read_text(encoding="utf-8"))
        categories = sorted((int(entry["id"]), str(entry["name"])) for entry in content["categories"])
        images = sorted(content["images"], key=lambda entry: str(entry["file_name"]))
        annotations = defaultdict(list)
        for annotation in content["annotations"]:
            annotations[annotation["image_id"]].append(annotation)
        sizes = [(int(entry["height"]), int(entry["width"])) for entry in images]
        known = {entry["id"] for entry in images}
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(f"{labels} is not a COCO file of instances ({type(error).__name__}: {error})") from error
    if not images or not categories:
        raise InputError(f"{labels} lists {len(images)} images and {len(categories)} categories, expected some of each")
    unknown = sorted(set(annotations) - known, key=str)
    if unknown:
        raise InputError(f"{labels} has annotations of image {unknown[0]}, which it does not list")
    class_of = {category: index + 1 for index, (category, _) in enumerate(categories)}
    samples = (
        Sample(entry["file_name"], photos / entry["file_name"], None, tuple(annotations[entry["id"]]), size, class_of)
        for entry, size in zip(images, sizes, strict=True)
    )
    return SampleList(tuple(samples), tuple(name for _, name in categories))


# --- reading and checking


def read_sample(sample: Sample) -> LabelledPhoto:
    """Read a photo and its instances.

    Raises:
        InputError: an unreadable photo or label map, a label map that is not single-channel 8 or 16 bit, sizes that
            differ, an annotation of an unknown category, without pixels, or with a malformed mask. The message starts
            with the sample's name.
    """
    if not sample.photo.is_file():
        raise InputError(f"{sample.name}: the photo {sample.photo} is missing")
    pixels = decode_image(sample.photo, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    if pixels is None:
        raise InputError(f"{sample.name}: the photo cannot be read as an image")
    # not cv2.cvtColor: its threads do not survive the fork of a data loader's worker
    photo = torch.from_numpy(pixels).permute(2, 0, 1).flip(0).contiguous()
    size = (photo.shape[1], photo.shape[2])
    if sample.label_map is None:
        return LabelledPhoto(photo, *read_annotations(sample, size))
    return LabelledPhoto(photo, *read_label_map(sample.label_map, sample.name, size))


def decode_image(path: Path, flags: int) -> np.ndarray | None:
    """The decoded image; None when it is no image. Works for every path, unlike cv2.imread on Windows."""
    content = np.fromfile(path, np.uint8)
    try:
        return cv2.imdecode(content, flags) if len(content) else None
    except cv2.error:
        return None


def read_label_map(path: Path, name: str, size: tuple[int, int]) -> tuple[Tensor, Tensor, Tensor]:
    """Layers, classes and ignored pixels of a label PNG, see `LabelledPhoto`."""
    if not path.is_file():
        raise InputError(f"{name}: its label map {path} is missing (a photo without instances needs an all-zero one)")
    labels = decode_image(path, cv2.IMREAD_UNCHANGED)
    if labels is None or labels.ndim != 2 or labels.dtype not in (np.uint8, np.uint16):
        raise InputError(f"{name}: {path} is not a single-channel PNG of 8 or 16 bit")
    if labels.shape != size:
        raise InputError(
            f"{name}: its label map is {labels.shape[1]} x {labels.shape[0]} pixels, the photo {size[1]} x {size[0]}"
        )
    ignore = labels == IGNORE_LABEL
    values, indices = np.unique(np.where(ignore, 0, labels), return_inverse=True)
    layer = indices.reshape(labels.shape) + (values[0] != 0)  # a map without background starts at instance 1
    num_instances = int(layer.max())
    layers = torch.from_numpy(layer.astype(np.int32))[None]
    return layers, torch.ones(num_instances, dtype=torch.int64), torch.from_numpy(ignore)


def read_annotations(sample: Sample, size: tuple[int, int]) -> tuple[Tensor, Tensor, Tensor]:
    """Layers, classes and ignored pixels of COCO annotations; crowds become ignored pixels."""
    if sample.size is not None and sample.size != size:
        raise InputError(
            f"{sample.name}: the photo is {size[1]} x {size[0]} pixels, "
            f"its COCO entry says {sample.size[1]} x {sample.size[0]}"
        )
    masks, classes, ignore = [], [], np.zeros(size, bool)
    for annotation in sample.annotations:
        mask = decode_annotation(annotation, sample.name, size)
        if annotation.get("iscrowd", 0):
            ignore |= mask
        elif annotation.get("category_id") in sample.class_of:
            masks.append(mask)
            classes.append(sample.class_of[annotation["category_id"]])
        else:
            raise InputError(f"{sample.name}: an annotation has the unknown category {annotation.get('category_id')}")
    return stack_masks(masks, size), torch.tensor(classes, dtype=torch.int64), torch.from_numpy(ignore)


def decode_annotation(annotation: Mapping[str, Any], name: str, size: tuple[int, int]) -> np.ndarray:
    """(H, W) bool mask of polygons or of a run-length encoding, compressed or not."""
    where = f"{name}: annotation {annotation.get('id', '?')}"
    try:
        segments = annotation["segmentation"]
        encoded = coco_mask.frPyObjects(segments, *size) if not is_compressed(segments) else segments
        mask = coco_mask.decode(coco_mask.merge(encoded) if isinstance(encoded, list) else encoded).astype(bool)
    except Exception as error:  # pycocotools raises bare Exception, too
        raise InputError(f"{where} has no readable segmentation ({type(error).__name__}: {error})") from error
    if mask.shape != size:
        raise InputError(f"{where} is {mask.shape[1]} x {mask.shape[0]} pixels, the photo {size[1]} x {size[0]}")
    if not mask.any():
        raise InputError(f"{where} covers no pixel")
    return mask


def is_compressed(segments: Any) -> bool:
    return isinstance(segments, dict) and isinstance(segments["counts"], str | bytes)


def stack_masks(masks: Sequence[np.ndarray], size: tuple[int, int]) -> Tensor:
    """(L, H, W) int32 with instance k+1 where masks[k] is; each instance goes to the first layer that is free there."""
    layers = [np.zeros(size, np.int32)]
    for number, mask in enumerate(masks, start=1):
        free = next((layer for layer in layers if not layer[mask].any()), None)
        if free is None:
            free = np.zeros(size, np.int32)
            layers.append(free)
        free[mask] = number
    return torch.from_numpy(np.stack(layers))


def check_samples(samples: Sequence[Sample]) -> tuple[list[int], dict[int, str]]:
    """Read every sample once, in threads, with a progress bar.

    Returns:
        The number of instances of each sample (0 for a broken one), and index -> what is wrong with it.
    """

    def inspect(sample: Sample) -> int | str:
        try:
            return len(read_sample(sample).classes)
        except InputError as error:
            return str(error)

    with ThreadPoolExecutor(max(1, min(8, (os.cpu_count() or 1)))) as pool:
        found = list(tqdm(pool.map(inspect, samples), "checking samples", len(samples), disable=None, leave=False))
    broken = {index: entry for index, entry in enumerate(found) if isinstance(entry, str)}
    return [entry if isinstance(entry, int) else 0 for entry in found], broken


def keep_sound(samples: SampleList, what: str, skip_broken: bool) -> tuple[SampleList, dict[int, str]]:
    """The samples that can be used, and what is wrong with the others.

    Args:
        samples: all that were found.
        what: what to call them in the message, "training" or "validation".
        skip_broken: go on without broken samples instead of raising.

    Raises:
        InputError: a sample is broken and `skip_broken` is off (the message counts them and describes the first three);
            or no sample is left with an instance.
    """
    counts, broken = check_samples(samples.samples)
    if broken and not skip_broken:
        first = "; ".join(list(broken.values())[:3])
        raise InputError(
            f"{len(broken)} of {len(samples)} {what} samples are broken ({first}{'; ...' if len(broken) > 3 else ''}), "
            "expected none unless skip_broken is set"
        )
    if not sum(counts):
        raise InputError(f"none of the {len(samples)} {what} samples holds an instance, expected at least one")
    return samples.select([index for index in range(len(samples)) if index not in broken]), broken
