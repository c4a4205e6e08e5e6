"""COCO instance JSON: reads masks (polygons, RLE, compressed RLE), and writes instances with their ids.

The only codec of COCO masks: any file gives a mask of the image's size, or an error of one sentence.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pycocotools import mask as coco_mask
from pydantic import BaseModel, FiniteFloat, RootModel, TypeAdapter, ValidationError

from mvseg.errors import InputError, faults_of, warn
from mvseg.findings.finding import Finding, Values, list_some
from mvseg.formats.find_views import PhotoSet, base_name, find_views
from mvseg.formats.image_file import describe_turn
from mvseg.formats.json_file import Int64, Items, check_content, load_json, read_json
from mvseg.formats.masks.found_mask import check_categories
from mvseg.formats.run_lengths import Rle, decode_rle, shared_neighbours
from mvseg.scene import Scene


class CocoImage(BaseModel):
    """An image as it stands in the file."""

    id: int | str
    file_name: str
    width: int
    height: int


class CocoAnnotation(BaseModel):
    """An annotation as it stands in the file; `decode_segmentation` checks the mask, and the caller the category."""

    id: Int64 | str | None = None
    image_id: int | str
    category_id: Any = None
    segmentation: Any = None
    iscrowd: int = 0
    segments_info: Any = None


class _Category(BaseModel):
    id: int | str
    name: str


class CocoFile(BaseModel):
    """Fields that are read; `categories` may be missing."""

    images: Items[CocoImage]
    annotations: Items[CocoAnnotation]
    categories: Items[_Category] = []


class _Results(RootModel[Items[CocoAnnotation]]):
    """COCO's results format: annotations alone."""


Crowd = Literal["mask", "ignore"]
OUTSIDE, MANY_OUTSIDE = 0.02, 0.1  # chosen: share of the size outside of a photo, and of corners that lie there
FAR = 10  # limit: sides of the photo; polygons that reach farther are refused
FEW = 10  # chosen: min. polygons that tell that all were drawn on larger photos
_SEGMENTATION: TypeAdapter[list[list[float]] | Rle] = TypeAdapter(Items[Items[FiniteFloat]] | Rle)


def read_coco(
    path: Path, scene: Scene, *, parts: Sequence[Path] = (), crowd: Crowd = "mask", categories: Collection[str] = ()
) -> list[Iterator[tuple[int, np.ndarray]]]:
    """The masks of a COCO file, view by view, in the frame of the photo. Masks are decoded lazily: hundreds of masks of
    large photos do not fit into memory together.

    Images are found by file name, see `find_views`; those that are not in the scene are left out. A list of results
    (annotations alone) is read, too: its images are those of the COCO file beside it that lists their ids; without one,
    `image_id` is the name of a photo, or the number that it consists of. Warns (InputWarning) of everything that is
    left out, guessed or ambiguous: crowds, boxes without a mask, views that the file does not list, annotations of
    images that it does not list, several categories.

    Args:
        path: the file; of several, their folder, which messages name.
        parts: the files, where one was split by photos (Roboflow's train, valid and test).
        crowd: how annotations with `iscrowd` are treated: "mask": as all others (supervision sets it for every mask
            with holes or several parts, datumaro for all masks); "ignore": left out, as in COCO's own evaluation.
        categories: names of the categories that are taken; all, if empty. A category without a name goes by its id.

    Returns:
        V iterators over (number, (height, width) bool mask); that of a view without annotations is empty. The numbers
        are the annotation ids or, where an id is missing or no integer, the places in the file, from 1.

    Raises:
        InputError: the file is broken, or another program's; none of its images is in the scene, an entry fits several
            views or has another size than its camera, two entries or parts list one image; there are annotations, and
            none has a mask; all polygons lie between 0 and 1; or a category is not there. From the iterators: a
            segmentation cannot be decoded.
    """
    coco = read_files(parts or [path], scene)
    view_of = _find_images(path, coco, scene)
    names = {str(category.id): category.name for category in coco.categories}
    has_ids = all(isinstance(annotation.id, int) for annotation in coco.annotations)
    chosen: list[list[tuple[int, CocoAnnotation]]] = [[] for _ in scene.views]
    counts: Counter[str] = Counter()
    num_crowds = num_boxes = 0
    for place, annotation in enumerate(coco.annotations, start=1):
        view = view_of.get(str(annotation.image_id))
        if view is None:
            continue
        num_crowds += bool(annotation.iscrowd)
        if annotation.segmentation in (None, [], [[]]):
            num_boxes += 1
            continue
        category = names.get(str(annotation.category_id), str(annotation.category_id or ""))
        counts[category] += 1
        if (crowd == "ignore" and annotation.iscrowd) or (categories and category not in categories):
            continue
        chosen[view].append((place, annotation))
    warn_of_crowds(path, num_crowds, crowd, option="--coco_crowd")
    if num_boxes:
        if any(annotation.segments_info for annotation in coco.annotations):
            mend = "the folder of its PNGs, in which each colour is a mask, or an instances JSON"
            raise InputError(f"{path}: is COCO's panoptic JSON, expected {mend}")
        if not counts.total():
            raise InputError(f"{path}: {num_boxes} annotations have no mask (a box at most), and no others are there")
        warn(Finding("annotations_without_mask", str(path), {"count": num_boxes}))
    sizes = scene.cameras.sizes.tolist()
    with faults_of(path):
        check_segmentations(
            (annotation.segmentation, size) for view, size in zip(chosen, sizes, strict=True) for _, annotation in view
        )
    check_categories(counts, categories, categories=names.values(), source=path)
    return [_decode_all(path, each, size, has_ids=has_ids) for each, size in zip(chosen, sizes, strict=True)]


def warn_of_crowds(path: Path, count: int, crowd: Crowd, *, option: str) -> None:
    """Warn (InputWarning) of annotations with `iscrowd`, if there are any; `option` says what they are."""
    if count:
        code = "crowds_taken" if crowd == "mask" else "crowds_ignored"
        warn(Finding(code, str(path), {"count": count, "option": option}))


def read_files(parts: Sequence[Path], scene: PhotoSet) -> CocoFile:
    """The content of a COCO file, or of the parts of one, in any dialect; see `read_coco`."""
    files = [(part, _read_file(part, scene)) for part in parts]
    return _merge(files) if len(files) > 1 else files[0][1]


def _read_file(path: Path, scene: PhotoSet) -> CocoFile:
    content = load_json(path)
    if not isinstance(content, list):
        return check_content(path, content, CocoFile, expected="COCO")
    results = check_content(path, content, _Results, expected="COCO").root
    listed = _find_data_set(path, results)
    if listed is None:
        return CocoFile(images=_guess_images(path, results, scene), annotations=results)
    return CocoFile(images=listed.images, annotations=results, categories=listed.categories)


def _find_data_set(path: Path, results: list[CocoAnnotation]) -> CocoFile | None:
    """The COCO file beside a list of results that lists all images of its ids; None if there is none, or several."""
    ids, fitting = {str(result.image_id) for result in results}, []
    for other in sorted(path.parent.glob("*.json")):
        with suppress(InputError):  # no COCO file, which includes the results
            listed = read_json(other, CocoFile)
            if ids and ids <= {str(image.id) for image in listed.images}:
                fitting.append(listed)
    return fitting[0] if len(fitting) == 1 else None


def _guess_images(path: Path, results: list[CocoAnnotation], scene: PhotoSet) -> list[CocoImage]:
    """Guess the images of a list of results by their ids: the name of a photo, or the number that its name is."""
    stems = [base_name(view.name) for view in scene.views]
    by_number = {int(stem): view.name for stem, view in zip(stems, scene.views, strict=True) if stem.isdecimal()}
    if len(by_number) < len(stems):  # not every photo has a number of its own
        by_number = {}
    ids = list(dict.fromkeys(result.image_id for result in results))
    numbers = [image_id for image_id in ids if isinstance(image_id, int)]
    matching = [number for number in numbers if number in by_number]
    if matching and len(matching) < len(numbers):
        other = next(number for number in numbers if number not in by_number)
        reason = f"image_id {matching[0]} is the number of a photo, {other} is none"
        mend = "put the JSON of its data set, which lists the images, beside it"
        raise InputError(f"{path}: {reason}: image ids of results are those of their data set; {mend}")
    if matching:
        values: Values = {"number": matching[0], "photo": by_number[matching[0]]}
        warn(Finding("ids_taken_for_numbers", str(path), values))
    names = [by_number.get(each, str(each)) if isinstance(each, int) else each for each in ids]
    return [CocoImage(id=each, file_name=name, width=0, height=0) for each, name in zip(ids, names, strict=True)]


def _merge(parts: list[tuple[Path, CocoFile]]) -> CocoFile:
    """Merge several files with independent ids: categories are identified by name, annotations by their place."""
    merged, part_of = CocoFile(images=[], annotations=[]), dict[str, Path]()
    for number, (path, part) in enumerate(parts):
        names = {str(category.id): category.name for category in part.categories}
        merged.categories += [_Category(id=name, name=name) for name in names.values()]
        for image in part.images:
            if part_of.setdefault(image.file_name, path) is not path:
                message = f"{part_of[image.file_name]} and {path} both list {image.file_name}"
                raise InputError(f"{message}, expected the path of one of them")
            image.id = f"{number}/{image.id}"
        for annotation in part.annotations:
            annotation.id, annotation.image_id = None, f"{number}/{annotation.image_id}"
            annotation.category_id = names.get(str(annotation.category_id), annotation.category_id)
        merged.images += part.images
        merged.annotations += part.annotations
    return merged


def _find_images(path: Path, coco: CocoFile, scene: Scene) -> dict[str, int | None]:
    """{image id as text: view, or None}, checked."""
    image_ids = {str(image.id) for image in coco.images}
    listed = enumerate(coco.annotations, start=1)
    if orphans := [place if one.id is None else one.id for place, one in listed if str(one.image_id) not in image_ids]:
        warn(Finding("orphans", str(path), {"count": len(orphans), "first": orphans[0]}))
    if len(image_ids) < len(coco.images):
        raise InputError(f"{path}: {len(coco.images)} images have {len(image_ids)} ids, expected one each")
    names = [image.file_name for image in coco.images]
    views = find_views(names, scene, source=path, warn_of_loose=True)
    missing = [view for view in range(len(scene.views)) if view not in set(views)]
    if len(missing) == len(scene.views):
        photos, others = list_some([view.path.name for view in scene.views]), list_some(names)
        raise InputError(f"{path}: none of its images is a photo of the scene, expected {photos}, found {others}")
    if missing:
        first_view = f"view {missing[0]} ({scene.views[missing[0]].name})"
        counts: Values = {"count": len(missing), "first": first_view, "found": tuple(names)}
        warn(Finding("images_missing", str(path), counts))
    check_images_once(path, coco, views)
    for image, view in zip(coco.images, views, strict=True):
        width, height = (0, 0) if view is None else scene.cameras.sizes[view].tolist()
        if view is not None and (image.width, image.height) not in ((0, 0), (width, height)):  # 0 x 0: not known
            sizes = f"image {image.file_name} is {image.width} x {image.height}, its camera says {width} x {height}"
            raise InputError(f"{path}: {sizes}{describe_turn(scene.views[view].path)}")
    return {str(image.id): view for image, view in zip(coco.images, views, strict=True)}


def check_images_once(path: Path, coco: CocoFile, views: Sequence[int | None]) -> None:
    """Raises InputError: two images with annotations are of one view (or photo); `views` are those of the images."""
    annotated = {str(annotation.image_id) for annotation in coco.annotations}
    first_of: dict[int, CocoImage] = {}
    for image, view in zip(coco.images, views, strict=True):
        if view is not None and str(image.id) in annotated and first_of.setdefault(view, image) is not image:
            first = first_of[view]
            what = f"images {first.id} ({first.file_name}) and {image.id} ({image.file_name}) are of one photo"
            raise InputError(f"{path}: {what}, and both have annotations: is the data set in the file twice?")


def _decode_all(
    path: Path, annotations: list[tuple[int, CocoAnnotation]], size: list[int], *, has_ids: bool
) -> Iterator[tuple[int, np.ndarray]]:
    width, height = size
    for place, annotation in annotations:
        with faults_of(f"{path}: annotation {place if annotation.id is None else annotation.id}"):
            mask = decode_segmentation(annotation.segmentation, width, height)
        yield annotation.id if has_ids and isinstance(annotation.id, int) else place, mask


def decode_segmentation(segmentation: Any, width: int, height: int) -> np.ndarray:
    """(height, width) bool mask of an annotation's "segmentation", unchecked, as json read it: polygons, run lengths,
    plain or compressed, or a single polygon without a list around it, as VIA writes.

    Raises:
        InputError: another form, a number that is not finite, another size, run lengths that do not add up to the
            image, or polygons far larger than it. The message is a reason, without the annotation's id.
    """
    if is_bitmap(segmentation, height):
        try:
            bitmap = np.array(segmentation, bool)
        except ValueError:  # rows of different lengths
            raise InputError("its bitmap has rows of different lengths") from None
        if bitmap.shape != (height, width):
            raise InputError(f"its bitmap is {bitmap.shape[1]} x {bitmap.shape[0]}, expected {width} x {height}")
        return bitmap
    if isinstance(segmentation, list) and segmentation and not isinstance(segmentation[0], list):
        segmentation = [segmentation]
    try:
        checked = _SEGMENTATION.validate_python(segmentation)
    except ValidationError:
        raise InputError("its segmentation is neither polygons of finite numbers nor run lengths with a size") from None
    if isinstance(checked, list):
        return _decode_polygons(checked, width, height)
    if checked.size != (height, width):
        raise InputError(f"its mask is {checked.size[1]} x {checked.size[0]}, expected {width} x {height}")
    return decode_rle(checked.counts, width, height)


def is_bitmap(segmentation: Any, height: int) -> bool:
    """Whether a mask is rows of its pixels: true and false, as Segment Anything's arrays become in JSON, or 0 and 1."""
    if not isinstance(segmentation, list) or not segmentation or not isinstance(segmentation[0], list):
        return False
    first = segmentation[0]
    if any(isinstance(each, bool) for each in first):
        return True
    is_whole = len(segmentation) == height > 1 and len({len(row) for row in segmentation}) == 1 and len(first) > 6
    return is_whole and all(each in (0, 1) for row in segmentation for each in row)


def check_segmentations(segmentations: Iterable[tuple[Any, Sequence[int]]]) -> None:
    """Check all masks of a file, each with the width and height of its photo, for a form that would be misread. Raises
    InputError if all corners of the polygons lie between 0 and 1, as shares of the size do; many lie outside of the
    photos, as those of larger ones do; or run lengths go along the rows."""
    polygons, down, across = [], 0.0, 0.0
    for segmentation, (width, height) in segmentations:
        if isinstance(segmentation, list) and segmentation and not is_bitmap(segmentation, height):
            outlines = segmentation if isinstance(segmentation[0], list) else [segmentation]
            polygons += [(part, width, height) for part in outlines]
        elif isinstance(segmentation, dict) and isinstance(segmentation.get("counts"), list) and width != height:
            with suppress(TypeError, ValueError):  # of another form, which the decoder names
                counts = np.array(segmentation["counts"], np.int64)
                down, across = np.add((down, across), shared_neighbours(counts, width, height))
    numbers = [x for part, _, _ in polygons for x in (part if isinstance(part, list) else [None])]
    if polygons and all(isinstance(x, (int, float)) and 0 <= x <= 1 for x in numbers):
        raise InputError("all corners lie between 0 and 1: are they shares of the photo's size? expected pixels")
    if across > 2 * down:
        raise InputError("its run lengths go along the rows, expected down the columns: of mask.T, or by pycocotools")
    corners = np.concatenate([np.zeros((0, 2)), *(_relative(*each) for each in polygons)])
    corners = corners[(np.abs(corners) <= FAR).all(1)]  # the decoder refuses what lies farther away
    is_out = (np.abs(corners - 0.5) > 0.5 + OUTSIDE).any(1)
    if len(polygons) >= FEW and is_out.mean() > MANY_OUTSIDE:
        x, y = corners[is_out].max(0)
        what = f"corners lie up to {x:.1f} widths and {y:.1f} heights from the photo's corner"
        raise InputError(f"{what}: were they drawn on larger photos?")


def _relative(part: Any, width: int, height: int) -> np.ndarray:
    """Corners (C, 2) of a polygon, in widths and heights of its photo; none where it is no polygon."""
    is_polygon = isinstance(part, list) and len(part) % 2 == 0
    is_polygon = is_polygon and all(isinstance(x, (int, float)) and abs(x) < 1 << 50 for x in part)
    return np.array(part if is_polygon else [], float).reshape(-1, 2) / (width, height)


def _decode_polygons(polygons: list[list[float]], width: int, height: int) -> np.ndarray:
    """Decode polygons; distant corners and many long edges, unbounded memory for pycocotools, are refused."""
    if not any(polygons) or any(len(polygon) % 2 for polygon in polygons):
        raise InputError("its segmentation is not of the expected polygons x1, y1, x2, y2, x3, y3 and so on")
    polygons = [polygon for polygon in polygons if len(polygon) >= 6]
    if not polygons:  # a point, or a line: no pixels
        return np.zeros((height, width), bool)
    outlines = [np.array(polygon).reshape(-1, 2) for polygon in polygons]
    if max(np.abs(corners).max() for corners in outlines) > FAR * max(width, height):
        raise InputError("a polygon reaches far out of the image")
    length = sum(np.abs(corners - np.roll(corners, 1, axis=0)).max(1).sum() for corners in outlines)
    if length > width * height + 100 * (width + height):  # the outline of every second pixel is as long as this
        raise InputError(f"its polygons are {length:.0f} pixels long, more than any outline in the image")
    rle = coco_mask.merge(coco_mask.frPyObjects(polygons, height, width))
    return decode_rle(rle["counts"].decode("ascii"), width, height)


def write_coco(
    path: Path, images: list[dict[str, Any]], annotations: list[dict[str, Any]], *, category: str = "instance"
) -> None:
    """Write a COCO file of one category; annotations carry "segmentation" (RLE) and their own keys."""
    for number, annotation in enumerate(annotations, start=1):
        rle = annotation["segmentation"]
        annotation |= {"id": number, "category_id": 1, "iscrowd": 0}
        annotation |= {"area": int(coco_mask.area(rle)), "bbox": coco_mask.toBbox(rle).tolist()}
    content = {"images": images, "categories": [{"id": 1, "name": category}], "annotations": annotations}
    path.write_text(json.dumps(content) + "\n", encoding="utf-8")
