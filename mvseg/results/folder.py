"""The result of one scene, and its folder: written whole or not at all, read back for evaluation.

Numbers in files are instance ids plus one, because 0 means "nothing" in a label image: label 3, `leaf_003.ply`, row 3
of `traits.csv` and `"instance_id": 3` in `instances.json` are one leaf. There, a region matched to nothing has -1.
"""

from __future__ import annotations

import csv
import json
import os
import shutil
import tempfile
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from pydantic import BaseModel
from torch import Tensor
from tqdm import tqdm

from mvseg.errors import InputError
from mvseg.evaluation.truth import shown_instance
from mvseg.formats.coco import Rle, decode_rle, encode_mask, write_coco
from mvseg.formats.image_file import write_png
from mvseg.formats.json_file import Pixels, read_json
from mvseg.formats.label_png import read_label_png, write_label_png
from mvseg.formats.lens import distort
from mvseg.formats.mesh import write_glb, write_ply
from mvseg.formats.photos import read_photo
from mvseg.matching.match_regions import Matching
from mvseg.reconstruction.voxels import VoxelGrid
from mvseg.regions import Regions
from mvseg.results.overlay import draw_contact_sheet, draw_overlay, instance_color
from mvseg.scene import Scene

RUN_FILE = "run.json"


@dataclass(frozen=True, eq=False)
class Result:
    """Everything known about one scene.

    Attributes:
        scene: the scene.
        regions: D masks, undistorted.
        matching: their ids.
        shapes: {instance id: voxels}; None when only ids were asked for.
        seconds: {stage: wall time}.
        scores: (D,) float32, how sure a detector was of each mask; None when the masks were given.
    """

    scene: Scene
    regions: Regions
    matching: Matching
    shapes: dict[int, VoxelGrid] | None = None
    seconds: dict[str, float] = field(default_factory=dict)
    scores: Tensor | None = None


def save_result(result: Result, out: Path, run: dict[str, Any], *, progress: bool = False) -> None:
    """Write a result folder; an earlier result at the same place is replaced.

    The folder appears complete or not at all: it is written beside its place and moved there at the end; until then an
    earlier result stays. The overlays are drawn on the photos, or on grey when the scene has none at all.

    Args:
        result: the result.
        out: the folder.
        run: what goes to run.json, beside the timings and counts: version, config, inputs, warnings.
        progress: show a progress bar over the views.

    Raises:
        InputError: the place cannot be written, holds something that is no result, or a photo is broken or,
            when others are there, missing.
    """
    check_out(out)
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        partial = Path(tempfile.mkdtemp(prefix=f".{out.name}.", dir=out.resolve().parent))
    except OSError as error:
        raise InputError(f"{out}: the output folder is not writable ({error.strerror})") from None
    try:
        partial.chmod(0o755)
        _write_images(result, partial, progress)
        _write_instances(result, partial)
        if result.shapes is not None:
            _write_shapes(result, partial)
        counts = {"regions": len(result.regions), "instances": result.matching.num_instances}
        seconds = {stage: round(wall, 3) for stage, wall in result.seconds.items()}
        how = {"matched_by": result.matching.method, "residual_px": result.matching.residual_px}
        text = json.dumps(run | how | {"counts": counts, "seconds": seconds}, indent=1, default=str)
        (partial / RUN_FILE).write_text(text + "\n", encoding="utf-8")
        _move(partial, out.resolve())
    except OSError as error:
        raise InputError(f"{out}: the output folder is not writable ({error.strerror})") from None
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def check_out(out: Path) -> None:
    """Raises InputError when `out` is a file, lies where nothing can be written, or is a folder that holds something
    other than an earlier result."""
    place = out.resolve()
    if out.is_dir():
        if not os.access(place, os.R_OK) or (any(place.iterdir()) and not (place / RUN_FILE).is_file()):
            raise InputError(f"{out}: holds files that are no earlier result, expected a new or an empty folder")
    elif out.exists() or any(parent.is_file() for parent in place.parents):
        raise InputError(f"{out}: the output folder is not writable (a file is in its place)")
    nearest = next((parent for parent in place.parents if parent.exists()), place)
    if not os.access(nearest, os.W_OK | os.X_OK):
        raise InputError(f"{out}: the output folder is not writable (no right to write in {nearest})")


def _move(folder: Path, place: Path) -> None:
    """Move a folder to a place that may be taken; what was there is deleted after that, or stays if it fails."""
    earlier = folder.with_name(f"{folder.name}.earlier")
    if place.exists():
        place.rename(earlier)
    try:
        folder.rename(place)
    except OSError:
        if earlier.exists():
            earlier.rename(place)
        raise
    shutil.rmtree(earlier, ignore_errors=True)


def _write_images(result: Result, folder: Path, progress: bool) -> None:
    scene, ids = result.scene, result.matching.instance_ids
    overlays, has_photos = [], any(view.path.exists() for view in scene.views)
    views = list(enumerate(scene.views))
    for index, view in tqdm(views, desc="pictures", unit="view", disable=not progress):
        width, height = scene.cameras.sizes[index].tolist()
        labels = result.regions.label_map(index, ids + 1, width, height).cpu().numpy().astype(np.uint16)
        labels = distort(labels, view.lens, scene.cameras.K[index].cpu().numpy())
        write_label_png(folder / "labels" / f"{view.name}.png", labels)
        photo = read_photo(scene, index) if has_photos else np.full((height, width, 3), 40, np.uint8)
        overlays.append(draw_overlay(photo, result.regions, ids, index, result.matching.match_scores))
        overlay = folder / "overlay" / f"{view.name}.png"
        overlay.parent.mkdir(parents=True, exist_ok=True)
        write_png(overlay, overlays[-1])
    write_png(folder / "contact.png", draw_contact_sheet(overlays, [view.name for view in scene.views]))


def _write_instances(result: Result, folder: Path) -> None:
    """instances.json: every region, in the frame of the photo the user took."""
    scene, images, annotations = result.scene, [], []
    ids, scores = result.matching.instance_ids.tolist(), result.matching.match_scores.tolist()
    labels, views = result.regions.labels.tolist(), result.regions.view_index.tolist()
    others = {region: instance for region, _, instance in result.matching.merged.tolist()}
    for index, view in enumerate(scene.views):
        width, height = scene.cameras.sizes[index].tolist()
        file_name = view.name + view.path.suffix  # with its subfolder, so that it can be found again
        images.append({"id": index + 1, "file_name": file_name, "name": view.name, "width": width, "height": height})
    K = scene.cameras.K.cpu().numpy()

    def extras(number: int) -> dict[str, float]:
        also = {"other_instance_id": others[number] + 1} if number in others else {}
        if result.scores is None:
            return also | {"source_label": labels[number]}
        return also | {"score": round(float(result.scores[number]), 4)}

    for number, index in enumerate(views):
        width, height = scene.cameras.sizes[index].tolist()
        mask = result.regions.mask(number, width, height).cpu().numpy().astype(np.uint8)
        annotations.append(
            {
                "image_id": index + 1,
                "instance_id": ids[number] + 1 if ids[number] >= 0 else -1,
                "match_score": round(scores[number], 4),
                **extras(number),
                "segmentation": encode_mask(distort(mask, scene.views[index].lens, K[index])),
            }
        )
    write_coco(folder / "instances.json", images, annotations)


def _write_shapes(result: Result, folder: Path) -> None:
    """leaves/*.ply, scene.glb and traits.csv."""
    (folder / "leaves").mkdir()
    meshes, colors, rows = {}, {}, []
    ids, views = result.matching.instance_ids, result.regions.view_index
    for instance in range(result.matching.num_instances):
        row: dict[str, Any] = {"id": instance + 1, "views": len(views[ids == instance].unique())}
        if result.matching.support is not None:
            row["sure_views"] = int(result.matching.support[instance])
        grid = (result.shapes or {}).get(instance)
        if grid is not None and grid.volume > 0:
            name = f"leaf_{instance + 1:03d}"
            meshes[name], colors[name] = grid.mesh(), instance_color(instance)
            write_ply(folder / "leaves" / f"{name}.ply", meshes[name], colors[name])
            row |= _shape_traits(grid)
        rows.append(row)
    write_glb(folder / "scene.glb", meshes, colors)
    columns = ["id", "views", "sure_views", "volume", "x_min", "y_min", "z_min", "x_max", "y_max", "z_max", "unit"]
    with (folder / "traits.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, columns, lineterminator="\n")
        writer.writeheader()
        writer.writerows(row | {"unit": result.scene.unit} for row in rows)


def _shape_traits(grid: VoxelGrid) -> dict[str, str]:
    """Volume in cubed, corners of the bounding box in world units."""
    points, half = grid.points, grid.voxel_size / 2
    low, high = points.amin(0) - half, points.amax(0) + half
    corners = [*zip(("x_min", "y_min", "z_min"), low.tolist(), strict=True)]
    corners += [*zip(("x_max", "y_max", "z_max"), high.tolist(), strict=True)]
    return {"volume": f"{grid.volume:.6g}"} | {name: f"{value:.6g}" for name, value in corners}


class _Image(BaseModel):
    id: int
    name: str
    width: Pixels
    height: Pixels


class _Instance(BaseModel):
    image_id: int
    instance_id: int
    segmentation: Rle


class _Instances(BaseModel):
    images: list[_Image]
    annotations: list[_Instance]


def read_instances(folder: Path, truth: Path) -> tuple[Tensor, Tensor]:
    """Estimated and true instance ids of the regions of a result.

    Args:
        folder: a result folder.
        truth: a folder of label PNGs, one per view, the same number for the same instance in every view.

    Returns:
        (D,) int64 ids as in instances.json (-1 = matched to nothing) and (D,) int64 true labels: 0 for a region that
        mostly covers no instance, 65535 for one that is mostly ignored.

    Raises:
        InputError: the result or the truth is missing or broken.
    """
    path = folder / "instances.json"
    if not path.is_file():
        raise InputError(f"{path}: is missing, expected a result folder")
    if not truth.is_dir():
        raise InputError(f"{truth}: no such folder of true labels")
    content = read_json(path, _Instances)
    images = {image.id: image for image in content.images}
    labels = {
        number: read_label_png(truth / f"{image.name}.png", image.width, image.height)
        for number, image in images.items()
    }
    true = []
    for index, one in enumerate(content.annotations):
        if one.image_id not in images:
            raise InputError(f"{path}: annotations[{index}]: there is no image {one.image_id}")
        image = images[one.image_id]
        try:
            mask = decode_rle(one.segmentation.counts, image.width, image.height)
        except InputError as error:
            raise InputError(f"{path}: annotations[{index}]: {error}") from None
        true.append(shown_instance(labels[image.id], mask))
    ids = [one.instance_id for one in content.annotations]
    return torch.tensor(ids, dtype=torch.int64), torch.tensor(true, dtype=torch.int64)
