"""A scene folder: photos with their cameras and, perhaps, masks. Chooses the reader."""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import replace
from pathlib import Path

import numpy as np

from mvseg.errors import InputError, check_arguments, collect_warnings, warn
from mvseg.findings.finding import Finding, list_some
from mvseg.formats.bop import read_bop
from mvseg.formats.coco import Crowd, read_coco
from mvseg.formats.colmap import find_colmap_model, read_colmap
from mvseg.formats.find_views import find_file
from mvseg.formats.image_file import PHOTO_SUFFIXES
from mvseg.formats.masks.read_views import read_views
from mvseg.formats.masks.recognise import MaskFiles, recognise_masks
from mvseg.formats.masks.view_regions import stack_views
from mvseg.formats.masks.yolo import YOLO_TRACKS
from mvseg.formats.metashape import find_metashape, read_metashape
from mvseg.formats.rig import is_rig, read_rig
from mvseg.formats.transforms_json import read_transforms
from mvseg.formats.turntable import read_turntable
from mvseg.regions import Regions
from mvseg.scene import Scene

EXPECTED = "expected cameras.json, a COLMAP model in sparse/, transforms.json, or another kind of docs/formats.md"
# In the order in which they are looked for; Blender's scenes of NeRF have train, val and test.
READERS: dict[str, Callable[[Path], Scene]] = {
    "transforms.json": read_transforms,
    "transforms_train.json": read_transforms,
    "turntable.json": read_turntable,
    "*.xml": read_metashape,
    "scene_camera.json": read_bop,
}


@check_arguments
@np.errstate(over="ignore", invalid="ignore")  # absurd numbers become infinite: no camera has such, and it is named
def load_scene(folder: Path | str) -> Scene:
    """Load the cameras of a scene folder; photos are read later, when they are needed, and may be absent.

    Cameras come from the first that exists: `cameras.json` (rig file), a COLMAP model in `sparse/` or `colmap/sparse/`
    (see `find_colmap_model`), `transforms.json` or `transforms_train.json` (nerfstudio, instant-ngp, Blender),
    `turntable.json`, an XML file of Metashape, `scene_camera.json` (BOP). Another program's `cameras.json` is left out
    where another of these is there, which an InputWarning says. Names of photos may be composed or decomposed Unicode
    (macOS), whatever the files' are.

    Raises:
        InputError: the folder is missing or holds no cameras, or they are not sound; see the readers.
    """
    scene = _read_cameras(Path(folder))
    return replace(scene, views=tuple(replace(view, path=find_file(view.path)) for view in scene.views))


def _read_cameras(folder: Path) -> Scene:
    if not folder.is_dir():
        problem = "is a file, expected the scene's folder" if folder.exists() else "no such scene folder"
        raise InputError(f"{folder}: {problem}")
    rig = folder / "cameras.json"
    scene = None if rig.is_file() and is_rig(rig) else _read_others(folder)
    if scene is not None:
        if rig.is_file():
            warn(Finding("rig_not_used", str(rig), {"source": str(scene.source)}))
        return scene
    if rig.is_file():
        return read_rig(rig)  # also another program's: it says what is missing
    raise InputError(f"{folder}: no cameras, {EXPECTED}; {_describe(folder)}")


def _read_others(folder: Path) -> Scene | None:
    model = find_colmap_model(folder)
    if model is not None:
        return read_colmap(model, folder)
    found = _find_others(folder)
    return None if found is None else READERS[found[0]](found[1])


def _find_others(folder: Path) -> tuple[str, Path] | None:
    paths = ((name, find_metashape(folder) if name == "*.xml" else folder / name) for name in READERS)
    return next(((name, path) for name, path in paths if path is not None and path.is_file()), None)


def is_scene_folder(folder: Path) -> bool:
    """Whether a folder holds cameras of any kind that `load_scene` reads; they need not be sound."""
    with collect_warnings():  # of several models
        has_model = find_colmap_model(folder) is not None
    return has_model or (folder / "cameras.json").is_file() or _find_others(folder) is not None


def _describe(folder: Path) -> str:
    names = [path.relative_to(folder).as_posix() for path in sorted(folder.rglob("*"))]
    if photos := [name for name in names if name.lower().endswith(PHOTO_SUFFIXES)]:
        return f"found {len(photos)} photos ({photos[0]}, ...): mvseg pose {folder} --out SCENE estimates their cameras"
    return f"found {list_some(sorted(path.name for path in folder.iterdir()))}"


@check_arguments
def load_masks(scene: Scene, masks: Path | str, *, crowd: Crowd = "mask", categories: Collection[str] = ()) -> Regions:
    """Load the masks of every view, with the lens distortion of the scene removed.

    Args:
        masks: a COCO JSON file, or a folder with files that are named after the photos: label images (PNG, TIFF), NumPy
            files, labelme or Segment Anything JSON, YOLO text, or one image per mask; see `recognise_masks`.
        crowd: how COCO annotations with `iscrowd` are treated, see `read_coco`.
        categories: names of the categories that are taken, of COCO, labelme and YOLO files; all, if empty.

    Returns:
        Regions in the undistorted frame; `labels` holds the numbers of the masks in their files. Warns (InputWarning)
        of everything that is left out or matched by its base name only, of label images that hold 0 and 255 only, or a
        number per class, and of errors of `mvseg check` (`mask_faults`).

    Raises:
        InputError: a file is missing, broken, or does not fit its view, a category is not there, none of the masks that
            are there has a pixel, or label images were scaled with interpolation; see the readers.
    """
    return read_masks(scene, recognise_masks(scene, Path(masks)), crowd=crowd, categories=categories)


def read_masks(scene: Scene, files: MaskFiles, *, crowd: Crowd = "mask", categories: Collection[str] = ()) -> Regions:
    """The second half of `load_masks`: read the files that were recognised."""
    if categories and files.kind not in ("COCO", "labelme", "YOLO", YOLO_TRACKS):
        raise InputError(f"{files.source}: holds {files.kind}, which have no categories to select from")
    if files.kind == "COCO":
        parts = files.files[0]
        path = parts[0] if len(parts) == 1 else files.source
        return stack_views(read_coco(path, scene, parts=parts, crowd=crowd, categories=categories), scene, source=path)
    return stack_views(read_views(scene, files, wanted=categories), scene, source=files.source)
