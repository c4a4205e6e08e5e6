"""The result folder of one scene: written whole or not at all.

Numbers in files are instance ids: label 3, `leaf_003.ply`, leaf 3 in `traits.csv` and `"instance_id": 3` in
`instances.json` are one leaf. A region that is matched to nothing has -1 there, and 0 in the label images.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from mvseg.corrections.file import dump_edits
from mvseg.detectors.weights_file import DETECTOR_FILE
from mvseg.formats.coco import write_coco
from mvseg.formats.image_file import write_png
from mvseg.formats.label_png import write_label_png
from mvseg.formats.photos import Photos
from mvseg.formats.run_lengths import encode_mask
from mvseg.masks import Origin
from mvseg.results.earlier import RESULT, Output, replace_result
from mvseg.results.overlay import draw_overlay
from mvseg.results.photo_masks import labels_in_photo, mask_in_photo
from mvseg.results.report.pictures import Picture, draw_picture
from mvseg.results.result import Result
from mvseg.results.run_record import FORMAT
from mvseg.scene import View
from mvseg.system.running import progress_bar

REPORT_FILE = "report.html"
BEFORE_EDITS_FILE = "before_edits.bin"  # see `mvseg.pipeline.before_edits`
CORRECTED = {Origin.CORRECTED: "outline", Origin.CUT: "split", Origin.CONFIRMED: "confirm"}  # the edit that made a mask


def save_result(
    result: Result, out: Path, run: Mapping[str, Any] | None = None, *, report: bool = True, output: Output = RESULT
) -> None:
    """Write a result folder; an earlier result at the same path is replaced, and the user's files there stay.

    The folder appears complete or not at all. The overlays are drawn on the photos, or on grey when there are none.

    `run` are entries of run.json besides timings and counts: version, config, inputs, warnings; None: those that a
    loaded result knows of its run. `output` says what may be replaced; by default any result. Raises InputError: `out`
    cannot be written or holds something that is not a result (see `check_out`), or a photo is broken, or missing while
    others exist.
    """
    if run is None:
        run = {} if result.run is None else result.run.as_json()
    record = {**run, **describe_result(result)}
    with replace_result(out, record, output) as folder:
        pictures = _write_images(result, folder)
        _write_instances(result, folder)
        if result.surfaces is not None or result.voxels is not None:
            from mvseg.results.plant_files import write_plant  # loads trimesh and scikit-image

            write_plant(result, folder)
        if result.learned.weights is not None:
            (folder / DETECTOR_FILE).write_bytes(result.learned.weights)
        if result.before_edits is not None:
            (folder / BEFORE_EDITS_FILE).write_bytes(result.before_edits)
        if report:
            from mvseg.results.report.page import write_report  # loads trimesh

            write_report(folder / REPORT_FILE, result, pictures, run=record)


def describe_result(result: Result) -> dict[str, Any]:
    """Entries of run.json about the outcome of a run: scene, matching, traits, corrections, counts and timings."""
    report, scene = result.matching.report, result.scene
    shares = None if report.view_explained is None else [_or_none(share) for share in report.view_explained.tolist()]
    record: dict[str, Any] = {
        "format": FORMAT,
        "scene": scene.name,
        "unit": scene.unit or None,
        "up": scene.up,
        "photos": str(photos_folder(scene.views[0]).resolve()) if scene.views else None,
        "views": {"taken": [view.name for view in scene.views], "left_out": list(result.views_left_out)},
        "mask_kind": result.mask_kind or None,
        "matched_by": report.method,
        "residual_px": report.residual_px,
        "matching": {"has_probabilities": report.has_probabilities, "explained": report.explained}
        | {"view_explained": shares},
    }
    if (traits := result.traits) is not None:
        world = {"unit": traits.unit or None, "up": traits.up, "rejected": traits.rejected}
        record["traits"] = world | {"up_from": traits.up_from}
    if (learned := result.learned).agreed_area:
        record["learned"] = {"rounds": learned.rounds, "agreed_area": learned.agreed_area}
    if result.corrections is not None and result.corrections.edits:
        record["edits"] = dump_edits(result.corrections.edits)
    if result.fates:
        record["corrections"] = [asdict(each) for each in result.fates]
    record["counts"] = {"regions": len(result.regions), "instances": result.matching.num_instances}
    return record | {"seconds": {stage: round(wall, 3) for stage, wall in result.seconds.items()}}


def _or_none(number: float) -> float | None:
    return None if math.isnan(number) else number


def photos_folder(view: View) -> Path:
    """The folder that the names of all views start from."""
    parents = view.path.parents
    return parents[min(view.name.count("/"), len(parents) - 1)]


def _write_images(result: Result, folder: Path) -> list[Picture]:
    scene, masks, photos = result.scene, result.masks, result.photos or Photos(result.scene)
    pictures = []
    for index, view in progress_bar([*enumerate(scene.views)], name="writing pictures", unit="view"):
        width, height = scene.cameras.sizes[index].tolist()
        write_label_png(folder / "labels" / f"{view.name}.png", labels_in_photo(result, index))
        photo = photos(index) if photos.exist else np.full((height, width, 3), 40, np.uint8)
        pictures.append(draw_picture(photo, masks, view=index))
        overlay = folder / "overlay" / f"{view.name}.png"
        overlay.parent.mkdir(parents=True, exist_ok=True)
        write_png(overlay, draw_overlay(photo, masks, view=index))
    return pictures


def _write_instances(result: Result, folder: Path) -> None:
    scene, images = result.scene, []
    for index, view in enumerate(scene.views):
        width, height = scene.cameras.sizes[index].tolist()
        file_name = view.name + view.path.suffix  # with its subfolder, so that it can be found again
        image = {"id": index + 1, "file_name": file_name, "name": view.name, "width": width, "height": height}
        camera: dict[str, Any] = {name: getattr(scene.cameras, name)[index].tolist() for name in ("K", "R", "t")}
        if (lens := view.lens) is not None:
            camera["lens"] = {"model": lens.model_name, "params": list(lens.params)}
        images.append(image | {"camera": camera})
    shown = progress_bar(range(len(result.regions)), name="writing masks", unit="mask")
    write_coco(folder / "instances.json", images, [_annotate(result, region) for region in shown])


def _annotate(result: Result, region: int) -> dict[str, Any]:
    masks, view = result.masks, int(result.masks.view_index[region])
    instance, kind = int(masks.instance_ids[region]), int(masks.classes[region])
    track, chance = {"track_id": instance} if instance > 0 else {}, result.instances.probabilities.get(instance)
    origin, score = Origin(int(masks.origin[region])), float(masks.detection_scores[region])
    source: dict[str, Any] = {}
    if origin == Origin.GIVEN:
        source["source_label"] = int(masks.regions.labels[region])
    elif math.isfinite(score):
        source["score"] = round(score, 4)
    if origin in (Origin.DETECTED, Origin.OTHER_VIEWS):
        source["from_other_views"] = origin == Origin.OTHER_VIEWS
    if origin in CORRECTED:
        source["corrected"] = CORRECTED[origin]
    masks_of_frames = {"segmentation": encode_mask(mask_in_photo(result, region))}
    if result.scene.views[view].lens is not None:
        width, height = result.scene.cameras.sizes[view].tolist()
        masks_of_frames["undistorted"] = encode_mask(result.regions.mask(region, width, height).cpu().numpy())
    return {
        "image_id": view + 1,
        "instance_id": instance,
        **track,
        "attributes": {"instance_id": instance} | track,  # what datumaro and CVAT keep
        "match_score": round(float(masks.match_scores[region]), 4),
        **({} if chance is None else {"probability": round(chance, 4)}),
        **source,
        **masks_of_frames,
        **({"mask_class": kind} if kind != 1 else {}),
    }
