"""A result folder read back: the only reader of one. trimesh and scikit-image are imported where they are used: a
result of ids alone does not need them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
import pycolmap
import torch
from pydantic import BaseModel, Field, FiniteFloat
from torch import Tensor

from mvseg.corrections.file import FORMAT as EDITS_FORMAT
from mvseg.corrections.file import parse_corrections
from mvseg.crop import Crop
from mvseg.detectors.weights_file import DETECTOR_FILE
from mvseg.errors import InputError, check_arguments, faults_of, warn
from mvseg.findings.finding import Finding, Values
from mvseg.formats.image_file import file_name_problem
from mvseg.formats.json_file import Int64, Items, Matrix3, Pixels, Vector3, read_json
from mvseg.formats.label_png import read_label_png, read_labels
from mvseg.formats.lens import undistort
from mvseg.formats.run_lengths import Rle, decode_crop, decode_rle
from mvseg.masks import Masks, Origin
from mvseg.matching.result import Matching, MatchReport
from mvseg.regions import Regions, regions_from_label_maps, stack_regions
from mvseg.results.earlier import RUN_FILE
from mvseg.results.folder import CORRECTED
from mvseg.results.photo_masks import regions_in_photos
from mvseg.results.result import Instances, Learned, Result
from mvseg.results.run_record import FORMAT, RunRecord, find_place, load_run
from mvseg.scene import Cameras, Scene, View
from mvseg.system.file_hash import hash_files

if TYPE_CHECKING:  # loads trimesh and scikit-image
    from mvseg.reconstruction.surface.leaf_surface import LeafSurface
    from mvseg.reconstruction.voxels import VoxelGrid
    from mvseg.traits.measure import Traits

MOST_INSTANCES = 65534  # definition: number of instances that a label image of 16 bits can hold
READ_FILES = (
    DETECTOR_FILE, "instances.json", "traits.csv", "traits_wide.csv", "nodes.csv", "surfaces.npz", "voxels.npz"
)  # fmt: skip


class _Lens(BaseModel):
    model: str
    params: Items[FiniteFloat]


class _Camera(BaseModel):
    K: Matrix3
    R: Matrix3
    t: Vector3
    lens: _Lens | None = None


class _Image(BaseModel):
    id: int
    name: str
    file_name: str
    width: Pixels
    height: Pixels
    camera: _Camera


class _Mask(BaseModel):
    image_id: int
    instance_id: int = Field(ge=-1, le=MOST_INSTANCES)
    segmentation: Rle
    undistorted: Rle | None = None
    match_score: float = Field(0.0, ge=0, le=1)
    score: FiniteFloat = math.nan
    probability: FiniteFloat | None = None
    source_label: Int64 | None = None
    from_other_views: bool = False
    corrected: Literal["outline", "split", "confirm"] | None = None
    mask_class: Int64 = 1

    @property
    def origin(self) -> Origin:
        if self.corrected is not None:
            return {edit: origin for origin, edit in CORRECTED.items()}[self.corrected]
        if self.source_label is not None:
            return Origin.GIVEN
        return Origin.OTHER_VIEWS if self.from_other_views else Origin.DETECTED


class _Instances(BaseModel):
    images: Items[_Image]
    annotations: Items[_Mask]


def read_detector(folder: Path) -> bytes | None:
    """The weights that learned a plant; None where its result has none."""
    path = folder / DETECTOR_FILE
    return path.read_bytes() if path.is_file() else None


def load_learned(folder: Path, run: RunRecord) -> Learned:
    return Learned(read_detector(folder), rounds=run.learned.rounds, agreed_area=run.learned.agreed_area)


def find_result(folder: Path) -> Path:
    """The result folder that a path means: itself, or the only result in it (`mvseg match` writes one per scene).
    Raises InputError: it holds several results."""
    if (folder / "instances.json").is_file() or not folder.is_dir():
        return folder
    inside = sorted(path.parent for path in folder.glob("*/instances.json"))
    if len(inside) > 1:
        names = ", ".join(path.name for path in inside[:3]) + (", ..." if len(inside) > 3 else "")
        raise InputError(f"{folder}: holds {len(inside)} results ({names}), expected one of them: {inside[0]}")
    return inside[0] if inside else folder


@check_arguments
def load_result(folder: Path | str) -> Result:
    """The result in a folder that mvseg wrote; neither the scene folder nor the photos are opened.

    Numbers are as exact as the files: cameras, surfaces, voxels and masks come back as they were, match scores and
    probabilities with four decimals, traits with six digits. Data for the run and `mvseg correct` only is not read:
    `starts` of the instances, the candidates `left` out, and `before_edits`. `Scene.views` name the photos where they
    are now, if they moved together with the result.

    Args:
        folder: of one scene, as `mvseg infer`, `mvseg match` and `mvseg batch` write it.

    Returns:
        The result, on the CPU; `Result.run` holds its run.json.

    Raises:
        InputError: this is no result; it has another format than this version reads; a file is missing, broken, or
            another one than run.json lists.
    """
    folder = Path(folder)
    path = folder / "instances.json"
    if not path.is_file():
        raise InputError(f"{path}: is missing, expected a result folder")
    run = load_run(folder)
    if run.format < FORMAT:
        raise InputError(f"{folder}: has the format of an earlier version; mvseg infer --again {folder} makes it anew")
    content = read_json(path, _Instances)
    with faults_of(path):
        scene = _scene_of(folder, run, content.images)
        masks = _table_of(content, scene)
    traits = _traits_of(folder, run, scene)
    source = run.config.get("corrections")
    edits = {"format": EDITS_FORMAT, "edits": run.edits}
    instances = _instances_of(folder, run, content, traits=traits)
    check_unchanged(folder, run)
    return Result(
        scene=scene,
        matching=Matching(masks, _report_of(run)),
        instances=instances,
        learned=load_learned(folder, run),
        seconds=run.seconds,
        mask_kind=run.mask_kind or "",
        views_left_out=run.views.get("left_out", ()),
        corrections=parse_corrections(edits, None if source is None else Path(source)) if run.edits else None,
        fates=run.corrections,
        run=run,
    )


def check_unchanged(folder: Path, run: RunRecord) -> None:
    """Check that the files of a result that programs read are those that its run wrote. Raises InputError: one is
    another result's, or was changed, or cut."""
    for name in READ_FILES:
        path = folder / name
        if name in run.files and path.is_file() and hash_files(path) != run.files[name]:
            message = f"is not the file that {RUN_FILE} lists: changed since, or another result's"
            raise InputError(f"{path}: {message}; expected it as mvseg wrote it, or the result made again")


def read_instances(folder: Path, truth: Path) -> tuple[Regions, list[np.ndarray]]:
    """The masks and ids of a result, or of a folder of label PNGs, and the true labels of its views.

    `truth` is a folder of label PNGs, one per view, the same number for the same instance in every view; or another
    result, whose `labels` these are. Returns D regions in the frames of the photos, whose `labels` are the ids of
    instances.json (-1 = matched to nothing), and V true label maps. Photos without true labels are left out, as an
    InputWarning says. Raises InputError: the result or the truth is missing or broken; or no photo has true labels.
    """
    truth = truth / "labels" if (truth / "instances.json").is_file() else truth
    if not truth.is_dir():
        raise InputError(f"{truth}: no such folder of true labels")
    labels = sorted(folder.glob("*.png"))
    if labels and not (folder / "instances.json").is_file():
        maps = [read_labels(path) for path in labels]
        sizes = [(each.shape[1], each.shape[0]) for each in maps]
        return _with_truth(regions_from_label_maps(maps), sizes, truth, [path.name for path in labels])
    result = load_result(folder)
    sizes = [(width, height) for width, height in result.scene.cameras.sizes.tolist()]
    return _with_truth(regions_in_photos(result), sizes, truth, [f"{view.name}.png" for view in result.scene.views])


def _with_truth(
    regions: Regions, sizes: Sequence[tuple[int, int]], truth: Path, names: Sequence[str]
) -> tuple[Regions, list[np.ndarray]]:
    taken = [view for view, name in enumerate(names) if (truth / name).is_file()] or list(range(len(names)))
    if left_out := [name for view, name in enumerate(names) if view not in taken]:
        values: Values = {"count": len(left_out), "total": len(names), "names": tuple(left_out)}
        warn(Finding("no_true_labels", str(truth), values))
        regions = regions.of_views(torch.tensor(taken))
    return regions, [read_label_png(truth / names[view], *sizes[view]) for view in taken]


def _scene_of(folder: Path, run: RunRecord, images: Sequence[_Image]) -> Scene:
    for image in images:
        for name in (image.name, image.file_name):
            if problem := file_name_problem(name, folder="the folder of the photos"):
                raise InputError(f"image {name}: {problem}")
    photos = find_place(folder, run, run.photos or folder)
    views = []
    for image in images:
        lens = None
        if (stated := image.camera.lens) is not None:
            try:
                lens = pycolmap.Camera(model=stated.model, params=stated.params, width=image.width, height=image.height)
            except Exception as error:  # of any kind
                raise InputError(f"image {image.name}: its lens is none of COLMAP's ({error})") from None
        views.append(View(image.name, photos / image.file_name, lens))
    K, R = (_as_tensor([getattr(image.camera, name) for image in images], 3, 3) for name in ("K", "R"))
    t = _as_tensor([image.camera.t for image in images], 3)
    cameras = Cameras(K=K, R=R, t=t, sizes=_as_tensor([(image.width, image.height) for image in images], 2))
    return Scene(run.scene or folder.name, tuple(views), cameras, unit=run.unit or "", up=run.up)


def _as_tensor(numbers: object, *shape: int) -> Tensor:
    return torch.tensor(numbers, dtype=torch.float64).reshape(-1, *shape)


def _table_of(content: _Instances, scene: Scene) -> Masks:
    view_of, rows = {image.id: view for view, image in enumerate(content.images)}, list[tuple[int, Crop, int]]()
    for row, each in enumerate(content.annotations):
        with faults_of(f"annotations[{row}]"):
            if each.image_id not in view_of:
                raise InputError(f"there is no image {each.image_id}")
            view, label = view_of[each.image_id], row + 1 if each.source_label is None else each.source_label
            rows.append((view, _decode(each, scene, view), label))
    masks, read = content.annotations, Masks.of(stack_regions(rows, len(content.images)))
    return replace(
        read,
        instance_ids=torch.tensor([each.instance_id for each in masks], dtype=torch.int64),
        match_scores=torch.tensor([each.match_score for each in masks], dtype=torch.float32),
        detection_scores=torch.tensor([each.score for each in masks], dtype=torch.float32),
        classes=torch.tensor([each.mask_class for each in masks], dtype=torch.int64),
        origin=torch.tensor([each.origin for each in masks], dtype=torch.int64),
    )


def _decode(mask: _Mask, scene: Scene, view: int) -> Crop:
    (width, height), lens = scene.cameras.sizes[view].tolist(), scene.views[view].lens
    rle = mask.undistorted or mask.segmentation
    if lens is None or mask.undistorted is not None:
        return decode_crop(rle.counts, width, height)
    whole = decode_rle(rle.counts, width, height).astype(np.uint8)
    return Crop.of(undistort(whole, lens, scene.cameras.K[view].numpy()) > 0)


def _report_of(run: RunRecord) -> MatchReport:
    matching, shares = run.matching, run.matching.view_explained
    return MatchReport(
        method=run.matched_by,
        has_probabilities=matching.has_probabilities,
        residual_px=run.residual_px,
        explained=matching.explained,
        view_explained=None if shares is None else torch.tensor([math.nan if n is None else n for n in shares]),
    )


def _traits_of(folder: Path, run: RunRecord, scene: Scene) -> Traits | None:
    if run.traits is None or _find_file(folder, run, "traits.csv") is None:
        return None
    from mvseg.traits.table import read_traits

    world, paths = run.traits, (folder / "traits.csv", folder / "traits_wide.csv")
    nodes = _find_file(folder, run, "nodes.csv")
    unit = world.unit or ""
    up_from = world.up_from or ("" if world.up is None else "scene")  # earlier versions took no other
    return read_traits(*paths, nodes, plant=scene.name, unit=unit, up=world.up, up_from=up_from, rejected=world.kinds)


def _instances_of(folder: Path, run: RunRecord, content: _Instances, *, traits: Traits | None) -> Instances:
    chances = {each.instance_id: each.probability for each in content.annotations if each.probability is not None}
    surfaces: dict[int, LeafSurface] | None = None
    voxels: dict[int, VoxelGrid] | None = None
    files = [_find_file(folder, run, name) for name in ("surfaces.npz", "voxels.npz")]
    if any(files):
        from mvseg.results.shapes_file import read_surfaces, read_voxels

        surfaces = None if files[0] is None else read_surfaces(files[0])
        voxels = {} if files[1] is None else read_voxels(files[1])
    return Instances(probabilities=dict(sorted(chances.items())), surfaces=surfaces, voxels=voxels, traits=traits)


def _find_file(folder: Path, run: RunRecord, name: str) -> Path | None:
    """A file of the folder; None where the run wrote none. Raises InputError: run.json lists it, and it is gone."""
    if (folder / name).is_file():
        return folder / name
    if name in run.files:
        raise InputError(f"{folder / name}: is missing, expected the whole result that run.json lists")
    return None
