"""Photos with instance masks as training samples: finding, checking and reading them.

Two layouts: a folder of photos with a folder of label PNGs (same path and stem; 0 is background, 65535 is ignored; a
scene's `images/` and `masks/` are such a pair), or a folder of photos with one COCO JSON file. A photo without any
instance is a sample like any other, provided that its label PNG or its COCO entry exists.
All broken samples are reported by name; nothing is dropped silently.
"""

from __future__ import annotations

import os
from collections import defaultdict
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from pydantic import BaseModel
from tqdm import tqdm

from mvseg.errors import InputError
from mvseg.evaluation.labelled_photo import LabelledPhoto, label_photo, mask_photo
from mvseg.formats.coco import CocoAnnotation, CocoFile, decode_segmentation
from mvseg.formats.image_file import PHOTO_SUFFIXES, file_name_problem, read_rgb
from mvseg.formats.json_file import Items, read_json
from mvseg.formats.label_png import read_labels


@dataclass(frozen=True)
class Sample:
    """One photo and where its instances are.

    Attributes:
        name: the photo's path below its folder; what reports and logs call it.
        photo: the image file.
        label_map: a single-channel PNG, or None when the instances come from `annotations`.
        annotations: COCO annotations of this photo.
        size: (width, height) in pixels that the COCO file states, or None.
        class_of: COCO category id -> class, from 1 on.
    """

    name: str
    photo: Path
    label_map: Path | None = None
    annotations: tuple[CocoAnnotation, ...] = ()
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
        InputError: a missing folder or file, no photo at all, two photos with one stem, a JSON file that is not COCO,
            an image whose file name leads out of the folder, an annotation of an image that is not listed.
    """
    if not photos.is_dir():
        raise InputError(f"{photos} is not a folder, expected the folder of the photos")
    if labels.is_dir():
        return list_label_maps(photos, labels)
    if labels.suffix == ".json" and labels.is_file():
        return list_coco(photos, labels)
    raise InputError(f"{labels} is neither a folder of label PNGs nor a COCO .json file")


def list_label_maps(photos: Path, labels: Path) -> SampleList:
    """The samples of a folder of label PNGs; see `list_samples`."""
    paths = sorted(path for path in photos.rglob("*") if path.suffix.lower() in PHOTO_SUFFIXES)
    if not paths:
        raise InputError(f"{photos} holds no photo ({', '.join(PHOTO_SUFFIXES)})")
    by_stem: dict[Path, Path] = {}
    for path in paths:
        stem = path.relative_to(photos).with_suffix("")
        if stem in by_stem:
            raise InputError(f"{by_stem[stem]} and {path} would share one label PNG, expected one photo per stem")
        by_stem[stem] = path
    # a label map without a photo is listed too, so that the check reports it
    for label_map in sorted(labels.rglob("*.png")):
        stem = label_map.relative_to(labels).with_suffix("")
        by_stem.setdefault(stem, (photos / stem).with_suffix(".*"))
    samples = (
        Sample(name=path.relative_to(photos).as_posix(), photo=path, label_map=labels / f"{stem.as_posix()}.png")
        for stem, path in sorted(by_stem.items())
    )
    return SampleList(tuple(samples), ("leaf",))


class _Category(BaseModel):
    id: int
    name: str


class _TrainingFile(CocoFile):
    categories: Items[_Category]


def list_coco(photos: Path, labels: Path) -> SampleList:
    """The samples of a COCO file; see `list_samples`. Classes 1, 2, ... are the categories, ordered by their ids."""
    content = read_json(labels, _TrainingFile)
    images = sorted(content.images, key=lambda image: image.file_name)
    categories = sorted((category.id, category.name) for category in content.categories)
    if not images or not categories:
        raise InputError(f"{labels} lists {len(images)} images and {len(categories)} categories, expected some of each")
    for image in images:
        problem = file_name_problem(image.file_name, folder="the folder of the photos")
        if problem:
            raise InputError(f"{labels}: image {image.file_name}: {problem}")
    annotations_of: dict[int | str, list[CocoAnnotation]] = defaultdict(list)
    for annotation in content.annotations:
        annotations_of[annotation.image_id].append(annotation)
    unlisted = sorted(annotations_of.keys() - {image.id for image in images}, key=str)
    if unlisted:
        raise InputError(f"{labels} has annotations of image {unlisted[0]}, which it does not list")
    class_of = {category: number for number, (category, _) in enumerate(categories, start=1)}
    samples = (
        Sample(name=image.file_name, photo=photos / image.file_name, annotations=tuple(annotations_of[image.id]),
               size=(image.width, image.height), class_of=class_of)
        for image in images
    )  # fmt: skip
    return SampleList(tuple(samples), tuple(name for _, name in categories))


# --- reading and checking


def read_sample(sample: Sample) -> LabelledPhoto:
    """Read a photo and its instances. Does not use OpenCV, whose threads do not survive the fork of a data loader.

    Raises:
        InputError: the photo or its label map is missing or cannot be read, sizes differ, or an annotation has an
            unknown category, no pixels, or a malformed mask. The message starts with the sample's name.
    """
    try:
        if not sample.photo.is_file():
            raise InputError(f"the photo {sample.photo} is missing")
        try:
            photo = read_rgb(sample.photo)
        except InputError as error:
            raise InputError(f"the photo cannot be read, expected a whole image file: {error}") from None
        if sample.label_map is not None:
            return label_photo(photo, read_label_map(sample.label_map, photo.shape[:2]))
        return read_annotations(sample, photo)
    except InputError as error:
        raise InputError(f"{sample.name}: {error}") from None


def read_label_map(path: Path, size: tuple[int, ...]) -> np.ndarray:
    """A label map, checked against the (height, width) of its photo."""
    if not path.is_file():
        raise InputError(f"its label map {path} is missing (a photo without instances needs an all-zero one)")
    labels = read_labels(path)
    if labels.shape != size:
        found = f"{labels.shape[1]} x {labels.shape[0]} pixels, the photo {size[1]} x {size[0]}"
        raise InputError(f"its label map is {found}")
    return labels


def read_annotations(sample: Sample, photo: np.ndarray) -> LabelledPhoto:
    """A photo with its COCO annotations; crowds become ignored pixels, but for those of other annotations."""
    height, width = photo.shape[:2]
    if sample.size is not None and sample.size != (width, height):
        stated = f"{sample.size[0]} x {sample.size[1]}"
        raise InputError(f"the photo is {width} x {height} pixels, its COCO entry says {stated}")
    masks, classes, ignore = [], [], np.zeros((height, width), bool)
    for annotation in sample.annotations:
        where = f"annotation {annotation.id}"
        try:
            mask = decode_segmentation(annotation.segmentation, width, height)
        except InputError as error:
            raise InputError(f"{where}: {error}") from None
        if not mask.any():
            raise InputError(f"{where}: its mask covers no pixel")
        category = annotation.category_id
        if annotation.iscrowd:
            ignore |= mask
        elif category in list(sample.class_of):  # a list: the file may hold anything, unhashable values included
            masks.append(mask)
            classes.append(sample.class_of[category])
        else:
            raise InputError(f"{where}: its category {category} is not listed")
    for mask in masks:
        ignore &= ~mask  # a labelled instance is known, whatever covers part of it
    return mask_photo(photo, masks, classes=classes, ignore=ignore)


def check_samples(samples: Sequence[Sample]) -> tuple[list[int], dict[int, str]]:
    """Read every sample once, in threads, with a progress bar: the number of instances of each (0 for a broken one),
    and {index: what is wrong with it}."""

    def inspect(sample: Sample) -> int | str:
        try:
            return len(read_sample(sample).classes)
        except InputError as error:
            return str(error)

    pool = ThreadPoolExecutor(min(8, os.cpu_count() or 1))
    try:
        answers = list(tqdm(pool.map(inspect, samples), "checking samples", len(samples), disable=None, leave=False))
    finally:
        pool.shutdown(cancel_futures=True)  # an interrupted run does not check the others first
    broken = {index: answer for index, answer in enumerate(answers) if isinstance(answer, str)}
    return [answer if isinstance(answer, int) else 0 for answer in answers], broken


def keep_sound(samples: SampleList, what: str, *, skip_broken: bool) -> tuple[SampleList, dict[int, str]]:
    """The samples that can be used, and what is wrong with the others; `what` they are called in messages.

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
