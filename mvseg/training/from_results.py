"""Results as training samples: masks that `mvseg infer` found and the other views verified, or that the user corrected.
`are_labels` selects labels. All other masks are ignored, not background."""

from __future__ import annotations

from pathlib import Path

from mvseg.errors import InputError
from mvseg.formats.coco import CocoAnnotation
from mvseg.formats.run_lengths import encode_mask
from mvseg.results.photo_masks import mask_in_photo
from mvseg.results.read import load_result
from mvseg.training.data import Sample, SampleList
from mvseg.training.view_labels import are_labels


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
        rows = (result.masks.view_index == view).nonzero()[:, 0].tolist()
        masks = tuple(
            CocoAnnotation(
                id=row + 1,
                image_id=view + 1,
                category_id=1,
                segmentation=encode_mask(mask_in_photo(result, row)),
                iscrowd=int(not is_label[row]),
            )
            for row in rows
        )
        name = f"{folder.name}/{result.scene.views[view].name}{photo.suffix}"
        samples.append(Sample(name=name, photo=photo, annotations=masks, size=(width, height), class_of={"1": 1}))
    return sorted(samples, key=lambda sample: sample.name)
