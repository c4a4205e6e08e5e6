"""Photos or a video of one plant, from their folder or file to a scene folder."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import pycolmap

from mvseg._version import made_by
from mvseg.checks.camera_plan import WALK_FILE, draw_walk
from mvseg.errors import InputError, collect_warnings, warn
from mvseg.findings.finding import Finding, list_some
from mvseg.formats.opencv_yaml import Calibration, read_calibration
from mvseg.formats.positions import read_positions
from mvseg.poses.config import PoseConfig, WorldFacts
from mvseg.poses.focal_length import FocalLength, focal_lengths, least_sure
from mvseg.poses.known_world import Placement, place
from mvseg.poses.lens_faults import LensReport, find_lens_fault
from mvseg.poses.mapping import IMAGES, Structure, find_structure, move_structure, write_cameras, write_structure
from mvseg.poses.numbers import STRUCTURE
from mvseg.poses.photo_files import PhotoFile, copy_photos, list_photos
from mvseg.poses.video import check_motion, choose_frames, fill_gaps, frame_name, is_video, watch, write_frames
from mvseg.results.earlier import Output, replace_result
from mvseg.scene import Scene
from mvseg.system.atomic import sweep_abandoned
from mvseg.system.running import now_running, report_step
from mvseg.system.say import say
from mvseg.traits.config import Up
from mvseg.traits.up import place_scene


def pose_photos(
    photos: Path,
    out: Path,
    *,
    config: PoseConfig = PoseConfig(),
    world: WorldFacts = WorldFacts(),
    up: Up | None = None,
) -> Scene:
    """Estimate the cameras of photos, and write a scene folder that `load_scene` reads: whole, or not at all.

    An earlier scene of this kind at `out` is replaced; files that the user put there (masks, notes) stay.

    Args:
        photos: folder of photos, with one folder per camera below it or none; or a video, of which sharp frames become
            the photos.
        out: the scene folder: images/ (upright copies), cameras.json, sparse/0, walk.svg and pose.json.
        up: the direction of up in the known world, or how to find it.

    Raises InputError: a photo or the video is broken, the video shows too little motion, too few photos register, world
    facts do not fit them or name a unit of no length, or `out` holds something else.
    """
    if world.unit and not world.scales:  # the lengths of the world would get it, and are arbitrary
        raise InputError(f"unit is {world.unit}, and no length is known: expected --marker, --distance, ... with it")
    is_clip, file = is_video(photos), config.calibration
    output = Output("scene", of=(photos,), reads=tuple(path for path in (file, world.positions) if path is not None))
    sweep_abandoned(out)
    source, names = (photos, []) if is_clip else list_folder(photos, out)
    calibration = None if file is None else read_calibration(file.parent, file.name)
    if world.positions is not None:
        read_positions(world.positions)  # to find mistakes in it before the minutes that follow
    start, run = time.perf_counter(), dict[str, Any](made_by())
    with replace_result(out, run, output) as folder:
        with collect_warnings() as findings:
            images = folder / IMAGES
            if is_clip:
                files, structure = _find_structure_of_clip(photos, folder, config=config, calibration=calibration)
            else:
                files = copy_photos(source, names, images)
                structure = find_structure(images, files, config=config, calibration=calibration, work=folder)
            report = find_lens_fault(structure.model) if calibration is None else LensReport(None, structure.model)
            structure = replace(structure, model=report.model)
            lengths = focal_lengths(structure.model, is_given=calibration is not None)
            for finding in (*_lens_findings(report, files), *least_sure(lengths).doubts("focal_length_unsure")):
                warn(finding)
            placement = place(write_structure(structure, folder), world)
            scene = move_structure(structure, placement.similarity, folder)
            scene = place_scene(replace(scene, unit=placement.unit, up=placement.up), up=up)
            write_cameras(scene, folder)
        walk = write_walk(scene, folder, out)
        run |= describe_poses(structure, placement, files=files, lengths=lengths)
        run |= {
            "config": {"photos": str(photos), **asdict(config), "known": asdict(world), "up": up},
            "square_pixels": "measured" if report.is_square_known else "assumed",
            "up": scene.up,
            "findings": [each.as_json() for each in findings],
            "seconds": round(time.perf_counter() - start, 1),
        }
    for finding in findings:
        say(f"mvseg: warning: {finding}", to_stderr=True)
    if now_running().progress:
        say(summarize_poses(out, structure, placement=placement, scene=scene))
        say(f"  {least_sure(lengths).describe()}" + (", the least sure" if len(lengths) > 1 else ""))
        if not report.is_square_known:
            say("  pixels are taken as square: photos from one height do not show it")
        say(walk)
        say(f"next: mvseg infer {out}")
    return scene


def write_walk(scene: Scene, folder: Path, out: Path) -> str:
    """Write the cameras from above into a folder that becomes `out`; returns the lines that tell of it."""
    sentence, picture = draw_walk(scene)
    (folder / WALK_FILE).write_text(picture, encoding="utf-8")
    return f"  {sentence}\nmvseg: look at: {out / WALK_FILE}"


def _lens_findings(report: LensReport, photos: Sequence[PhotoFile]) -> list[Finding]:
    """The fault of the lens; and where squashed photos would not show it, photos of a size that no camera has."""
    findings = [] if report.finding is None else [report.finding]
    if not report.is_square_known and any(each.width == each.height for each in photos):
        findings.append(Finding("square_pixels", values={"width": photos[0].width, "height": photos[0].height}))
    return findings


def list_folder(photos: Path, out: Path) -> tuple[Path, list[str]]:
    """The folder of the photos and their names, as from `list_photos`. Raises InputError: no photos, or they are inside
    `out`."""
    source, names = list_photos(photos)
    if out.resolve() in (source.resolve(), *source.resolve().parents):
        raise InputError(f"{out}: the photos lie in it, expected a folder of its own for the scene")
    return source, names


def _find_structure_of_clip(
    clip: Path, folder: Path, *, config: PoseConfig, calibration: Calibration | None
) -> tuple[list[PhotoFile], Structure]:
    """Choose frames of a video as photos, and estimate their cameras; frames from gaps join while too few register."""
    footage = watch(clip)
    chosen = choose_frames(footage, most=config.frames)
    check_motion(clip, footage, chosen)
    files: dict[int, PhotoFile] = {}
    while True:
        new = [number for number in chosen if number not in files]
        with tempfile.TemporaryDirectory(dir=folder, prefix="frames-") as work:
            names = write_frames(clip, Path(work) / "frames", new)
            copied = copy_photos(Path(work) / "frames", names, folder / IMAGES)
        files |= {number: file for number in new for file in copied if file.name == frame_name(number)}
        photos = [files[number] for number in sorted(files)]
        failure: InputError | None = None
        try:
            structure = find_structure(folder / IMAGES, photos, config=config, calibration=calibration, work=folder)
            registered = {number for number, file in files.items() if file.name in structure.registered}
        except InputError as error:
            failure, registered = error, set()
        filled = fill_gaps(footage, sorted(files), registered, most=config.frames)
        if len(registered) >= STRUCTURE.enough * len(files) or len(filled) == len(files):
            if failure is not None:
                raise failure
            return photos, structure
        report_step(f"{len(registered)} of {len(files)} frames register; {len(filled) - len(files)} between join them")
        chosen = filled


def describe_poses(
    structure: Structure, placement: Placement, *, files: Sequence[PhotoFile], lengths: Sequence[FocalLength]
) -> dict[str, Any]:
    """Entries of pose.json besides options and files."""
    cameras = [camera for _, camera in sorted(structure.model.cameras.items())]
    return {
        "pycolmap": pycolmap.__version__,
        "photos": len(files),
        "registered": list(structure.registered),
        "not_registered": list(structure.left_out),
        "other_models": list(structure.other_models),
        "turned_upright": [photo.name for photo in files if photo.is_turned],
        "residual_px": round(structure.residual_px, 4),
        "points": structure.model.num_points3D(),
        "lenses": [
            {"model": each.model_name, "params": list(map(float, each.params)), "focal_length": asdict(length)}
            for each, length in zip(cameras, lengths, strict=True)
        ],
        "scale": {name: getattr(placement, name) for name in ("unit", "source", "residual", "left_out")},
    }


def summarize_poses(out: Path, structure: Structure, *, placement: Placement, scene: Scene) -> str:
    """The lines that a run ends with."""
    num, lost, points = len(structure.registered), len(structure.left_out), structure.model.num_points3D()
    lines = [f"{out}: {num} of {num + lost} photos registered, {structure.residual_px:.2f} px, {points} points"]
    if lost:
        lines.append(f"  not registered: {list_some(structure.left_out)}")
    if structure.other_models:
        numbers = " and ".join(map(str, structure.other_models))
        lines.append(f"  separate models: {numbers} photos fit only each other; photos in between would join them")
    lines.append(f"  {placement.describe()}")
    up = "unknown (--up X Y Z, rig or board)" if scene.up is None else " ".join(f"{x:.3f}" for x in scene.up)
    lines.append(f"  up is {up}")
    return "\n".join(lines)
