"""Results as training samples: masks that `mvseg infer` found and the other views verified, or that a person corrected.

A mask is a label when it was matched with a score of at least 0.5 and its edges come from the photo, or when a person
made or confirmed it. All others are ignored, not background: a mask that only the other views show, or one or two
views, one that matches nothing, one that matches badly.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pydantic import BaseModel

from mvseg.errors import InputError
from mvseg.formats.coco import CocoAnnotation, CocoFile
from mvseg.formats.json_file import Items, read_json
from mvseg.formats.scene_folder import load_scene
from mvseg.masks import SURE
from mvseg.training.data import Sample, SampleList

INSTANCES, RUN = "instances.json", "run.json"


class _Mask(CocoAnnotation):
    instance_id: int
    match_score: float
    from_other_views: bool = False
    from_few_views: bool = False
    corrected: str | None = None

    @property
    def is_label(self) -> bool:
        is_sure = self.instance_id > 0 and self.match_score >= SURE
        return self.corrected is not None or (is_sure and not self.from_other_views and not self.from_few_views)


class _Masks(CocoFile):
    annotations: Items[_Mask]  # type: ignore[assignment]


class _Config(BaseModel):
    scene: Path


class _Run(BaseModel):
    config: _Config


def list_results(folder: Path) -> SampleList:
    """The samples of a result folder of `mvseg infer` or `mvseg match`, or of all results in a folder.

    Returns:
        One sample for each photo, named "<result>/<photo>". Photos are those of the scene that run.json names.

    Raises:
        InputError: no result, one of a version that did not write what is needed, one without photos or without a mask
            to learn from, or whose photos are gone.
    """
    is_result = (folder / INSTANCES).is_file()
    found = [folder] if is_result else sorted(path.parent for path in folder.glob(f"*/{INSTANCES}"))
    if not found:
        raise InputError(f"{folder}: holds no result (no {INSTANCES}), expected a folder that `mvseg infer` wrote")
    return SampleList(tuple(sample for result in found for sample in _list_photos(result)), ("leaf",))


def _list_photos(result: Path) -> list[Sample]:
    try:
        content, scene = read_json(result / INSTANCES, _Masks), read_json(result / RUN, _Run).config.scene
    except (OSError, InputError) as error:
        message = f"is no result of this version of mvseg ({str(error).splitlines()[0]}); run `mvseg infer` again"
        raise InputError(f"{result}: {message}") from None
    if not any(mask.is_label for mask in content.annotations):
        raise InputError(f"{result}: holds no mask that is sure enough to learn from, expected a result with leaves")
    if not scene.is_dir():
        raise InputError(f"{result}: its scene {scene} is gone, expected the photos where they were")
    photo_of: dict[str, Any] = {view.name + view.path.suffix: view.path for view in load_scene(scene).views}
    samples = []
    for image in sorted(content.images, key=lambda image: image.file_name):
        photo = photo_of.get(image.file_name)
        if photo is None or not photo.is_file():
            message = f"its photo {image.file_name} is not in {scene}, expected the photos of the result"
            raise InputError(f"{result}: {message}")
        masks = tuple(
            mask.model_copy(update={"category_id": 1, "iscrowd": int(not mask.is_label)})
            for mask in content.annotations
            if mask.image_id == image.id
        )
        name, size = f"{result.name}/{image.file_name}", (image.width, image.height)
        samples.append(Sample(name=name, photo=photo, annotations=masks, size=size, class_of={1: 1}))
    return samples
