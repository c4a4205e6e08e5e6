"""The result folder of one scene: written whole or not at all.

Numbers in files are instance ids: label 3, `leaf_003.ply`, leaf 3 in `traits.csv` and `"instance_id": 3` in
`instances.json` are one leaf. A region that is matched to nothing has -1 there, and 0 in the label images.
"""

from __future__ import annotations

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
from mvseg.formats.mesh import simplify_mesh, write_glb, write_ply
from mvseg.formats.photos import read_photo
from mvseg.reconstruction.shapes import best_shape
from mvseg.reconstruction.surface.leaf_surface import LeafSurface
from mvseg.results.earlier import RUN_FILE, check_out, keep_user_files, list_files
from mvseg.results.gltf import describe_leaves, describe_world, gltf_from_world
from mvseg.results.overlay import draw_contact_sheet, draw_overlay, draw_tile, instance_color
from mvseg.results.report.page import write_report
from mvseg.results.report.pictures import Picture, draw_picture
from mvseg.results.result import Result
from mvseg.results.rims import visible_rims
from mvseg.traits.measure import Traits
from mvseg.traits.table import write_long, write_wide

REPORT_FILE = "report.html"
MAX_FACES = 4000  # triangles of a leaf in scene.glb; its own file has all of them


def save_result(
    result: Result,
    out: Path,
    run: dict[str, Any],
    *,
    progress: bool = False,
    draw_rims: bool = True,
    report: bool = True,
) -> None:
    """Write a result folder; an earlier result at the same path is replaced, and the user's files there stay.

    The folder appears complete or not at all: it is written next to `out` and moved there at the end; until then an
    earlier result stays. The overlays are drawn on the photos, or on grey when the scene has none.

    Args:
        result: the result.
        out: the folder.
        run: what goes into run.json besides timings and counts: version, config, inputs, warnings.
        progress: show a progress bar over the views.
        draw_rims: draw the rims of the surfaces into the overlays, where there are surfaces.
        report: write report.html, too.

    Raises:
        InputError: `out` cannot be written or holds something that is not a result (see `check_out`), or a photo is
            broken, or missing while others exist.
    """
    check_out(out)
    try:
        with folder_whole(out) as folder:
            pictures = _write_images(result, folder, progress, draw_rims=draw_rims)
            _write_instances(result, folder, progress)
            if result.surfaces is not None or result.voxels is not None:
                _write_shapes(result, folder)
            if result.traits is not None:
                write_long(folder / "traits.csv", result.traits)
                write_wide(folder / "traits_wide.csv", result.traits)
            counts = {"regions": len(result.regions), "instances": result.matching.num_instances}
            seconds = {stage: round(wall, 3) for stage, wall in result.seconds.items()}
            matched = {"matched_by": result.matching.method, "residual_px": result.matching.residual_px}
            measured = {} if result.traits is None else {"traits": _describe_traits(result.traits)}
            said = run | matched | measured | {"counts": counts, "seconds": seconds}
            if report:
                write_report(folder / REPORT_FILE, result, pictures, run=said)
            text = json.dumps(said | {"files": list_files(folder)}, indent=1, default=str)
            (folder / RUN_FILE).write_text(text + "\n", encoding="utf-8")
            keep_user_files(out, folder)
    except OSError as error:
        raise InputError(f"{out}: the output folder is not writable ({error.strerror})") from None


def _write_images(result: Result, folder: Path, progress: bool, *, draw_rims: bool) -> list[Picture]:
    """Labels, overlays and the contact sheet; what the report shows of the photos, which are read only once."""
    scene, ids = result.scene, result.matching.instance_ids
    tiles, pictures, has_photos = [], [], any(view.path.exists() for view in scene.views)
    rims = visible_rims((result.surfaces or {}) if draw_rims else {}, scene.cameras)
    views = list(enumerate(scene.views))
    for index, view in tqdm(views, desc="pictures", unit="view", disable=not progress):
        width, height = scene.cameras.sizes[index].tolist()
        labels = result.regions.label_map(index, ids, (width, height)).cpu().numpy().astype(np.uint16)
        labels = distort(labels, view.lens, scene.cameras.K[index].cpu().numpy())
        write_label_png(folder / "labels" / f"{view.name}.png", labels)
        photo = read_photo(scene, index) if has_photos else np.full((height, width, 3), 40, np.uint8)
        drawn = draw_overlay(photo, result.regions, result.matching, view=index, rims=rims[index])
        tiles.append(draw_tile(photo, result.regions, result.matching, view=index))
        pictures.append(draw_picture(photo, result.regions, result.matching, view=index))
        overlay = folder / "overlay" / f"{view.name}.png"
        overlay.parent.mkdir(parents=True, exist_ok=True)
        write_png(overlay, drawn)
    write_png(folder / "contact.png", draw_contact_sheet(tiles, [view.name for view in scene.views]))
    return pictures


def _write_instances(result: Result, folder: Path, progress: bool) -> None:
    """instances.json: every region, in the frame of the photo the user took."""
    scene, images = result.scene, []
    for index, view in enumerate(scene.views):
        width, height = scene.cameras.sizes[index].tolist()
        file_name = view.name + view.path.suffix  # with its subfolder, so that it can be found again
        images.append({"id": index + 1, "file_name": file_name, "name": view.name, "width": width, "height": height})
    others = {mask.region: mask.other for mask in result.matching.merged}
    annotations = []
    for region in tqdm(range(len(result.regions)), desc="masks", unit="mask", disable=not progress):
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
    instance = int(result.matching.instance_ids[region])
    track = {"track_id": instance} if instance > 0 else {}
    if result.detection_scores is None:
        source: dict[str, Any] = {"source_label": int(result.regions.labels[region])}
    else:
        source = {"score": round(float(result.detection_scores[region]), 4)}
        if result.from_other_views is not None:
            source["from_other_views"] = bool(result.from_other_views[region])
    return {
        "image_id": view + 1,
        "instance_id": instance,
        **track,
        "attributes": {"instance_id": instance} | track,  # what datumaro and CVAT keep
        "match_score": round(float(result.matching.match_scores[region]), 4),
        **source,
        "segmentation": encode_mask(distort(mask, result.scene.views[view].lens, K)),
    }


def _write_shapes(result: Result, folder: Path) -> None:
    """leaves/*.ply and scene.glb: credible surfaces, for other instances voxels. The voxels of a leaf that has both get
    a file of their own."""
    (folder / "leaves").mkdir()
    meshes, colors = {}, {}
    for instance in range(1, result.matching.num_instances + 1):
        shape = best_shape(instance, result.surfaces, result.voxels)
        name, color = f"leaf_{instance:03d}", instance_color(instance)
        if shape is not None and len((mesh := shape.mesh()).faces):
            meshes[name], colors[name] = simplify_mesh(mesh, MAX_FACES), color
            write_ply(folder / "leaves" / f"{name}.ply", mesh, color, instance_id=instance)
        if isinstance(shape, LeafSurface) and result.voxels and instance in result.voxels:
            voxels = result.voxels[instance].mesh()
            write_ply(folder / "leaves" / f"{name}_voxels.ply", voxels, color, instance_id=instance)
    about, extras = describe_world(result.scene), describe_leaves(result.traits)
    write_glb(
        folder / "scene.glb", meshes, colors, matrix=gltf_from_world(result.scene), about=about, extras=extras
    )


def _describe_traits(traits: Traits) -> dict[str, Any]:
    """What run.json says of the traits: the world they are measured in, and how many instances are no leaves."""
    return {"unit": traits.unit or None, "up": traits.up, "rejected": traits.rejected}
