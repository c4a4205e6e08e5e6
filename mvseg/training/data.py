"""Photos with instance masks as training samples: finding, checking and reading them.

The readers of scenes read masks of every kind: label images (0 is background, 65535 is ignored) and other files that
are named after the photos (`recognise_masks`), or COCO. A photo without any instance is a sample like any other if it
has a label image or a COCO entry. All broken samples are reported by name; nothing is dropped silently.
"""

from __future__ import annotations

import os
from collections import defaultdict
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from tqdm import tqdm

from mvseg.errors import InputError, faults_of, warn
from mvseg.evaluation.labelled_photo import LabelledPhoto, label_photo, mask_photo
from mvseg.findings.finding import Finding
from mvseg.formats.coco import (
    CocoAnnotation,
    Crowd,
    check_images_once,
    check_segmentations,
    decode_segmentation,
    read_files,
    warn_of_crowds,
)
from mvseg.formats.find_views import LonePhotos, find_views
from mvseg.formats.image_file import PHOTO_SUFFIXES, file_name_problem, read_rgb
from mvseg.formats.label_png import ignore_border
from mvseg.formats.masks.class_numbers import INTERPOLATED, count_between, is_interpolated
from mvseg.formats.masks.read_views import read_photo_masks
from mvseg.formats.masks.recognise import MaskFiles, recognise_masks
from mvseg.formats.masks.view_regions import COVERS
from mvseg.formats.photos import photos_in, warn_of_turned
from mvseg.formats.run_lengths import encode_mask
from mvseg.results.photo_masks import mask_in_photo
from mvseg.results.read import load_result
from mvseg.scene import View
from mvseg.training.view_labels import are_labels

CATEGORY = "leaf"  # of masks in files that are named after their photo


@dataclass(frozen=True)
class Sample:
    """One photo and where its instances are.

    Attributes:
        name: the photo's path below its folder; reports and logs use it.
        kind: of its files of masks, see `MaskFiles`; "" when the instances come from `annotations`.
        files: of its masks; none for a photo without instances.
        annotations: COCO annotations of this photo; pixels of those with `iscrowd` are ignored.
        size: (width, height) in pixels that the COCO file states, or None.
        class_of: COCO category id, as text -> class, from 1 on.
    """

    name: str
    photo: Path
    kind: str = ""
    files: tuple[Path, ...] = ()
    annotations: tuple[CocoAnnotation, ...] = ()
    size: tuple[int, int] | None = None
    class_of: Mapping[str, int] = field(default_factory=dict)


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


def list_samples(photos: Path, labels: Path, *, crowd: Crowd = "mask") -> SampleList:
    """Find the samples of a folder of photos with their masks, of any kind that `load_masks` reads.

    Args:
        photos: folder, searched with its subfolders.
        labels: as `masks` of `load_masks`: a folder with `<path of the photo>.png` for every photo, for example, or a
            COCO .json file.
        crowd: how COCO annotations with `iscrowd` are treated, see `read_coco`; pixels of omitted ones are ignored.

    Returns:
        Samples in the order of their names. Photos are not opened; see `check_samples`. Masks that are no COCO have one
        category, "leaf". Warns (InputWarning) as `load_masks` does.

    Raises:
        InputError: a missing folder or file, no photo at all, two photos with one stem, no masks that fit, a broken
            COCO file, an image whose file name leads out of the folder, an annotation of an image that is not listed.
    """
    if not photos.is_dir():
        raise InputError(f"{photos} is not a folder, expected the folder of the photos")
    paths = photos_in(photos, "**/*")
    if not paths:
        raise InputError(f"{photos} holds no photo ({', '.join(PHOTO_SUFFIXES)})")
    by_stem: dict[str, Path] = {}
    for path in paths:
        other = by_stem.setdefault(path.relative_to(photos).with_suffix("").as_posix(), path)
        if other is not path:
            raise InputError(f"{other} and {path} would share one label image, expected one photo per stem")
    photo_set = LonePhotos(tuple(View(stem, path) for stem, path in by_stem.items()))
    masks = recognise_masks(photo_set, labels)
    if masks.kind == "COCO":
        return _list_coco(photos, photo_set, masks, crowd=crowd)
    samples = [
        Sample(name=view.path.relative_to(photos).as_posix(), photo=view.path, kind=masks.kind, files=files)
        for view, files in zip(photo_set.views, masks.files, strict=True)
    ]
    samples += _list_lone(photos, labels, masks)
    return SampleList(tuple(sorted(samples, key=lambda sample: sample.name)), (CATEGORY,))


def _list_lone(photos: Path, labels: Path, masks: MaskFiles) -> list[Sample]:
    known = {path for files in masks.files for path in files}
    suffixes = {path.suffix for path in known}
    lone = [path for path in sorted(labels.rglob("*")) if path.suffix in suffixes - {".txt"} and path not in known]
    stems = [path.relative_to(labels).with_suffix(".*") for path in lone if path.is_file()]
    return [Sample(name=stem.as_posix(), photo=photos / stem, kind=masks.kind) for stem in stems]


def _list_coco(photos: Path, photo_set: LonePhotos, masks: MaskFiles, *, crowd: Crowd) -> SampleList:
    """Samples that a COCO file lists. Classes 1, 2, ... are the categories, ordered by their ids."""
    labels, content = masks.source, read_files(masks.files[0], photo_set)
    categories = sorted(content.categories, key=lambda category: (isinstance(category.id, str), category.id))
    if not content.images or not categories:
        counts = f"{len(content.images)} images and {len(categories)} categories"
        raise InputError(f"{labels} lists {counts}, expected some of each")
    views = find_views([image.file_name for image in content.images], photo_set, source=labels, warn_of_loose=True)
    check_images_once(labels, content, views)
    annotations_of: dict[str, list[CocoAnnotation]] = defaultdict(list)
    for annotation in content.annotations:
        annotations_of[str(annotation.image_id)].append(annotation)
    if unlisted := sorted(annotations_of.keys() - {str(image.id) for image in content.images}):
        raise InputError(f"{labels} has annotations of image {unlisted[0]}, which it does not list")
    size_of = {str(image.id): (image.width or 1 << 30, image.height or 1 << 30) for image in content.images}
    with faults_of(labels):
        check_segmentations((each.segmentation, size_of[str(each.image_id)]) for each in content.annotations)
    num_crowds = sum(bool(annotation.iscrowd) for annotation in content.annotations)
    warn_of_crowds(labels, num_crowds, crowd, option="coco_crowd")
    class_of = {str(category.id): number for number, category in enumerate(categories, start=1)}
    samples = []
    for image, view in zip(content.images, views, strict=True):
        problem = file_name_problem(image.file_name, folder="the folder of the photos") if view is None else None
        if problem:
            raise InputError(f"{labels}: image {image.file_name}: {problem}")
        photo = photos / image.file_name if view is None else photo_set.views[view].path
        own = annotations_of[str(image.id)]
        taken = [each.model_copy(update={"iscrowd": 0}) for each in own] if crowd == "mask" else own
        size = (image.width, image.height) if image.width or image.height else None  # 0 x 0: not known
        name = photo.relative_to(photos).as_posix()
        samples.append(Sample(name=name, photo=photo, annotations=tuple(taken), size=size, class_of=class_of))
    names = tuple(category.name for category in categories)
    return SampleList(tuple(sorted(samples, key=lambda sample: sample.name)), names)


def list_results(folder: Path) -> SampleList:
    """The samples of a result folder of `mvseg infer` or `mvseg match`, or of all results in a folder: one for each
    photo of the scene that run.json names, called "<result>/<photo>".

    Raises InputError: no result, or a broken one, see `load_result`; no mask to learn from; photos are gone.
    """
    is_result = (folder / "instances.json").is_file()
    found = [folder] if is_result else sorted(path.parent for path in folder.glob("*/instances.json"))
    if not found:
        raise InputError(f"{folder}: holds no result (no instances.json), expected a folder that `mvseg infer` wrote")
    return SampleList(tuple(sample for result in found for sample in _list_photos(result)), ("leaf",))


def _list_photos(folder: Path) -> list[Sample]:
    result = load_result(folder)
    is_label = are_labels(result.masks, result.instances.probabilities)
    if not is_label.any():
        raise InputError(f"{folder}: holds no mask that is sure enough to learn from, expected a result with leaves")
    samples, sizes = [], result.scene.cameras.sizes.tolist()
    for view, (width, height) in enumerate(sizes):
        photo = result.scene.views[view].path
        if not photo.is_file():
            raise InputError(f"{folder}: its photo {photo} is gone, expected the photos of the result")
        masks = []
        for row in (result.masks.view_index == view).nonzero()[:, 0].tolist():
            ids = {"id": row + 1, "image_id": view + 1, "category_id": 1}
            mask = encode_mask(mask_in_photo(result, row))
            masks.append(CocoAnnotation(**ids, segmentation=mask, iscrowd=int(not is_label[row])))
        name, size = f"{folder.name}/{result.scene.views[view].name}{photo.suffix}", (width, height)
        samples.append(Sample(name=name, photo=photo, annotations=tuple(masks), size=size, class_of={"1": 1}))
    return sorted(samples, key=lambda sample: sample.name)


# --- reading and checking


def read_sample(sample: Sample) -> LabelledPhoto:
    """Read a photo and its instances, without OpenCV's threads, which do not survive the fork of a data loader.

    Raises InputError: the photo or a file of its masks is missing or cannot be read, sizes differ, or an annotation has
    an unknown category, no pixels, or a malformed mask. The message starts with the sample's name.
    """
    return _read(sample)[0]


def _read(sample: Sample) -> tuple[LabelledPhoto, int]:
    """And how many entries of its masks are boxes, lines and points, which are left out."""
    with faults_of(sample.name):
        with faults_of(f"the photo {sample.photo} cannot be read, expected a whole image file"):
            photo = read_rgb(sample.photo)
        if not sample.kind:
            return _read_annotations(sample, photo)
        try:
            content = read_photo_masks(sample.files, sample.kind, photo.shape[1::-1])
        except InputError as error:  # here, the size that masks must have is that of the photo
            raise InputError(str(error).replace("its camera says", "its photo is")) from None
        if isinstance(content, np.ndarray):
            ignore_border(content)
            return label_photo(photo, content), 0
        masks = [each.mask for each in content if each.mask is not None and each.mask.any()]
        nothing = np.zeros(photo.shape[:2], bool)
        return mask_photo(photo, masks, classes=[1] * len(masks), ignore=nothing), len(content) - len(masks)


def _read_annotations(sample: Sample, photo: np.ndarray) -> tuple[LabelledPhoto, int]:
    """A photo with its COCO annotations, and how many have no pixel; other pixels of crowds are ignored."""
    height, width = photo.shape[:2]
    if sample.size is not None and sample.size != (width, height):
        stated = f"{sample.size[0]} x {sample.size[1]}"
        raise InputError(f"the photo is {width} x {height} pixels, its COCO entry says {stated}")
    masks, classes, ignore = [], [], np.zeros((height, width), bool)
    num_empty = 0
    for annotation in sample.annotations:
        with faults_of(f"annotation {annotation.id}"):
            mask = decode_segmentation(annotation.segmentation, width, height)
            if not mask.any():
                num_empty += 1
                continue
            category = str(annotation.category_id)
            if annotation.iscrowd:
                ignore |= mask
            elif category in sample.class_of:
                masks.append(mask)
                classes.append(sample.class_of[category])
            else:
                raise InputError(f"its category {category} is not listed")
    return mask_photo(photo, masks, classes=classes, ignore=ignore), num_empty


def check_samples(samples: Sequence[Sample]) -> tuple[list[int], dict[int, str]]:
    """Read every sample once, in threads, with a progress bar: the number of instances of each (0 for a broken one),
    and {index: fault}.

    Warns (InputWarning) of entries that are no masks, and of instances that are the background of their photo. Raises
    InputError: the label images were scaled with interpolation.
    """

    def inspect(sample: Sample) -> tuple[int, int, bool, np.ndarray] | str:
        """Instances, entries that are no masks, whether one is the background, and what `is_interpolated` asks for."""
        try:
            labelled, num_boxes = _read(sample)
        except InputError as error:
            return str(error)
        areas = np.bincount(labelled.layers.numpy().ravel())[1:]
        is_label_map = sample.kind and len(labelled.layers) == 1
        between = count_between(labelled.layers[0].numpy().astype(np.uint16)) if is_label_map else np.zeros(2, np.int64)
        is_covered = bool(areas.max(initial=0) > COVERS * labelled.ignore.numel())
        return len(labelled.classes), num_boxes, is_covered, between

    pool = ThreadPoolExecutor(min(8, os.cpu_count() or 1))
    try:
        answers = list(tqdm(pool.map(inspect, samples), "checking samples", len(samples), disable=None, leave=False))
    finally:
        pool.shutdown(cancel_futures=True)  # an interrupted run does not check the others first
    broken = {index: answer for index, answer in enumerate(answers) if isinstance(answer, str)}
    sound = [answer for answer in answers if not isinstance(answer, str)]
    if is_interpolated(sum((between for *_, between in sound), np.zeros(2, np.int64))):
        raise InputError(INTERPOLATED)
    num_boxes, num_covered = sum(each[1] for each in sound), sum(each[2] for each in sound)
    if num_boxes:
        warn(Finding("boxes_left_out", "labels", {"count": num_boxes}))
    if num_covered:
        warn(Finding("background_masks", values={"share": COVERS, "count": num_covered}))
    return [0 if isinstance(answer, str) else answer[0] for answer in answers], broken


def keep_sound(
    samples: SampleList, what: str, *, skip_broken: bool, skip_unlabelled: bool = False
) -> tuple[SampleList, dict[int, str]]:
    """The samples that can be used, and the faults of the others; messages call them `what`.

    Warns (InputWarning) of photos without labels, which would be learned as photos without leaves, unless
    `skip_unlabelled` leaves them out. Raises InputError: a sample is broken and `skip_broken` is off (the message
    counts them and describes the first three); or no sample is left with an instance.
    """
    warn_of_turned([sample.photo for sample in samples.samples])
    with faults_of(f"{what} samples"):
        counts, broken = check_samples(samples.samples)
    if broken and not skip_broken:
        first = "; ".join([*list(broken.values())[:3], *(["..."] if len(broken) > 3 else [])])
        count = f"{len(broken)} of {len(samples)} {what} samples are broken"
        raise InputError(f"{count} ({first}), expected none unless skip_broken is set")
    if not sum(counts):
        raise InputError(f"none of the {len(samples)} {what} samples holds an instance, expected at least one")
    every = range(len(samples))
    unlabelled = {index for index in every if not (counts[index] or samples.samples[index].files or index in broken)}
    if unlabelled and not skip_unlabelled:
        first = samples.samples[min(unlabelled)].name
        warn(Finding("photos_without_labels", what, {"count": len(unlabelled), "total": len(samples), "first": first}))
    left_out = broken.keys() | (unlabelled if skip_unlabelled else set())
    return samples.select([index for index in every if index not in left_out]), broken
