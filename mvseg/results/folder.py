"""The result folder of one scene: written whole or not at all.

Numbers in files are instance ids: label 3, `leaf_003.ply`, row 3 of `traits.csv` and `"instance_id": 3` in
`instances.json` are one leaf. A region that is matched to nothing has -1 there, and 0 in the label images.
"""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from mvseg.errors import InputError
from mvseg.formats.atomic import folder_whole
from mvseg.formats.coco import encode_mask, write_coco
from mvseg.formats.image_file import write_png
from mvseg.formats.label_png import write_label_png
from mvseg.formats.lens import distort
from mvseg.formats.mesh import write_glb, write_ply
from mvseg.formats.photos import read_photo
from mvseg.reconstruction.surface.leaf_surface import LeafSurface
from mvseg.reconstruction.voxels import VoxelGrid
from mvseg.results.earlier import RUN_FILE, check_out, keep_user_files, list_files
from mvseg.results.overlay import draw_contact_sheet, draw_overlay, instance_color
from mvseg.results.result import Result


def save_result(result: Result, out: Path, run: dict[str, Any], *, progress: bool = False) -> None:
    """Write a result folder; an earlier result at the same path is replaced, and the user's files there stay.

    The folder appears complete or not at all: it is written next to `out` and moved there at the end; until then an
    earlier result stays. The overlays are drawn on the photos, or on grey when the scene has none.

    Args:
        result: the result.
        out: the folder.
        run: what goes into run.json besides timings and counts: version, config, inputs, warnings.
        progress: show a progress bar over the views.

    Raises:
        InputError: `out` cannot be written or holds something that is not a result (see `check_out`), or a photo is
            broken, or missing while others exist.
    """
    check_out(out)
    try:
        with folder_whole(out) as folder:
            _write_images(result, folder, progress)
            _write_instances(result, folder)
            if result.shapes is not None:
                _write_shapes(result, folder)
            counts = {"regions": len(result.regions), "instances": result.matching.num_instances}
            seconds = {stage: round(wall, 3) for stage, wall in result.seconds.items()}
            matched = {"matched_by": result.matching.method, "residual_px": result.matching.residual_px}
            written = {"counts": counts, "seconds": seconds, "files": list_files(folder)}
            text = json.dumps(run | matched | written, indent=1, default=str)
            (folder / RUN_FILE).write_text(text + "\n", encoding="utf-8")
            keep_user_files(out, folder)
    except OSError as error:
        raise InputError(f"{out}: the output folder is not writable ({error.strerror})") from None


def _write_images(result: Result, folder: Path, progress: bool) -> None:
    scene, ids = result.scene, result.matching.instance_ids
    overlays, has_photos = [], any(view.path.exists() for view in scene.views)
    views = list(enumerate(scene.views))
    for index, view in tqdm(views, desc="pictures", unit="view", disable=not progress):
        width, height = scene.cameras.sizes[index].tolist()
        labels = result.regions.label_map(index, ids, (width, height)).cpu().numpy().astype(np.uint16)
        labels = distort(labels, view.lens, scene.cameras.K[index].cpu().numpy())
        write_label_png(folder / "labels" / f"{view.name}.png", labels)
        photo = read_photo(scene, index) if has_photos else np.full((height, width, 3), 40, np.uint8)
        overlays.append(draw_overlay(photo, result.regions, result.matching, view=index))
        overlay = folder / "overlay" / f"{view.name}.png"
        overlay.parent.mkdir(parents=True, exist_ok=True)
        write_png(overlay, overlays[-1])
    write_png(folder / "contact.png", draw_contact_sheet(overlays, [view.name for view in scene.views]))


def _write_instances(result: Result, folder: Path) -> None:
    """instances.json: every region, in the frame of the photo the user took."""
    scene, images = result.scene, []
    for index, view in enumerate(scene.views):
        width, height = scene.cameras.sizes[index].tolist()
        file_name = view.name + view.path.suffix  # with its subfolder, so that it can be found again
        images.append({"id": index + 1, "file_name": file_name, "name": view.name, "width": width, "height": height})
    others = {mask.region: mask.other for mask in result.matching.merged}
    annotations = []
    for region in range(len(result.regions)):
        annotation = _annotate(result, region)
        if region in others:
            annotation["other_instance_id"] = others[region]
        annotations.append(annotation)
    write_coco(folder / "instances.json", images, annotations)


def _annotate(result: Result, region: int) -> dict[str, Any]:
    """The entry of one region in instances.json, without what COCO itself requires."""
    view = int(result.regions.view_index[region])
    width, height = result.scene.cameras.sizes[view].tolist()
    mask = result.regions.mask(region, width, height).cpu().numpy().astype(np.uint8)
    K = result.scene.cameras.K[view].cpu().numpy()
    if result.detection_scores is None:
        source: dict[str, Any] = {"source_label": int(result.regions.labels[region])}
    else:
        source = {"score": round(float(result.detection_scores[region]), 4)}
    return {
        "image_id": view + 1,
        "instance_id": int(result.matching.instance_ids[region]),
        "match_score": round(float(result.matching.match_scores[region]), 4),
        **source,
        "segmentation": encode_mask(distort(mask, result.scene.views[view].lens, K)),
    }


VOXEL_COLUMNS = ("volume", "x_min", "y_min", "z_min", "x_max", "y_max", "z_max")
SURFACE_COLUMNS = ("area", "area_sd", "length", "length_sd", "width", "width_sd", "quality")


def _write_shapes(result: Result, folder: Path) -> None:
    """leaves/*.ply, scene.glb and traits.csv."""
    (folder / "leaves").mkdir()
    shapes = result.shapes or {}
    meshes, colors, rows = {}, {}, []
    ids, views = result.matching.instance_ids, result.regions.view_index
    for instance in range(1, result.matching.num_instances + 1):
        row: dict[str, Any] = {"id": instance, "views": len(views[ids == instance].unique())}
        if result.matching.support is not None:
            row["sure_views"] = int(result.matching.support[instance - 1])
        shape = shapes.get(instance)
        if shape is not None:
            row |= _surface_traits(shape) if isinstance(shape, LeafSurface) else _voxel_traits(shape)
            mesh = shape.mesh()
            if len(mesh.faces):
                name = f"leaf_{instance:03d}"
                meshes[name], colors[name] = mesh, instance_color(instance)
                write_ply(folder / "leaves" / f"{name}.ply", mesh, colors[name])
        rows.append(row)
    write_glb(folder / "scene.glb", meshes, colors)
    has_surfaces = any(isinstance(shape, LeafSurface) for shape in shapes.values())
    columns = ["id", "views", "sure_views", *(SURFACE_COLUMNS if has_surfaces else VOXEL_COLUMNS), "unit"]
    with (folder / "traits.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, columns, lineterminator="\n")
        writer.writeheader()
        writer.writerows(row | {"unit": result.scene.unit} for row in rows)


def _surface_traits(surface: LeafSurface) -> dict[str, str]:
    """Area, length and width in the scene's unit, each with its standard deviation, and the reasons to doubt them."""
    quality = {"quality": "; ".join(surface.quality.reasons) or "good"}
    if not surface.exists:
        return quality
    values = (surface.area, surface.length, surface.width)
    names = ("area", "length", "width")
    traits = dict(zip(names, values, strict=True)) | {
        f"{name}_sd": deviation for name, deviation in zip(names, surface.deviations, strict=True)
    }
    return {name: f"{value:.6g}" for name, value in traits.items()} | quality


def _voxel_traits(grid: VoxelGrid) -> dict[str, str]:
    """Volume in cubed world units, and the corners of the bounding box in world units."""
    points, half = grid.points, grid.voxel_size / 2
    low, high = points.amin(0) - half, points.amax(0) + half
    corners = [*zip(("x_min", "y_min", "z_min"), low.tolist(), strict=True)]
    corners += [*zip(("x_max", "y_max", "z_max"), high.tolist(), strict=True)]
    return {"volume": f"{grid.volume:.6g}"} | {name: f"{value:.6g}" for name, value in corners}
