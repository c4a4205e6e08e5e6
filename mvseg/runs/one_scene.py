"""One scene from its folder to its result folder."""

from __future__ import annotations

import platform
from contextlib import ExitStack
from dataclasses import asdict, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import torch

from mvseg._version import made_by
from mvseg.config import RunConfig
from mvseg.detection.cached_detections import claim_cache, delete_cached
from mvseg.detection.config import DetectConfig
from mvseg.detectors.weights_file import DETECTOR_FILE
from mvseg.errors import collect_warnings, warn
from mvseg.findings.finding import Finding, keep_causes
from mvseg.formats.photos import Photos
from mvseg.pipeline.run_scene import run_scene
from mvseg.results.card import Card, make_card
from mvseg.results.earlier import Output, check_out
from mvseg.results.folder import REPORT_FILE, photos_folder, save_result
from mvseg.results.result import Result
from mvseg.runs.recorded_run import record_places
from mvseg.runs.request import RunRequest
from mvseg.system.atomic import resolve_place, sweep_abandoned
from mvseg.system.progress import PASSES, ROUND
from mvseg.system.running import now_running, running, timed
from mvseg.system.say import say


def run_one_scene(request: RunRequest, *, num_workers: int = 1) -> None:
    """One scene from its folder to its result folder; InputWarnings go to stderr and to run.json.

    Raises InputError: bad input; corrections of another scene, unless they are forced; `out` holds what may not be
    overwritten; it is read by this run; or another run detects for `out` now.
    """
    out = request.out
    place = resolve_place(out)
    sweep_abandoned(place)
    request = request.with_found()
    names = ("instances.json", *((REPORT_FILE,) if request.config.report else ()))
    names += ("plant.json", "scene.glb", "traits.csv", "traits_wide.csv") if request.config.reconstruct else ()
    output = Output("result", (request.scene,), request.inputs, overwrite=request.overwrite, names=names)
    check_out(out, output)
    replaces = " (in place of an earlier result)" if place.is_dir() and any(place.iterdir()) else ""
    cache, finds = place.with_name(f"{place.name}.detections"), request.masks is None
    with ExitStack() as stack:
        stack.enter_context(running(plan=_plan_stages(request.config, finds=finds)))
        if finds and stack.enter_context(claim_cache(cache, request.scene, overwrite=request.overwrite)):
            say(f"mvseg: going on from the detections in {cache}, for equal photos and options", to_stderr=True)
        with running(num_workers=num_workers):
            result, card = solve_scene(request, cache=cache)
        is_shown = now_running().progress
        if left_out := len(result.views_left_out):
            num_taken, more = len(result.scene.views), "" if request.config.views else "; --views all takes all"
            say(f"mvseg: {num_taken} of {num_taken + left_out} views are taken{more}", to_stderr=True)
        for finding in result.findings:
            if finding.level != "note" and not (is_shown and finding == card.doubt):
                say(f"mvseg: warning: {finding}", to_stderr=True)
        with timed("write"):
            save_scene(result, card, request=request, output=output)
        if finds:
            delete_cached(cache)
    num_masks, num_views = len(result.regions), len(result.scene.views)
    masks_of_kind = f"{num_masks} masks ({result.mask_kind})" if result.mask_kind else f"{num_masks} masks"
    say(f"{out}: {result.matching.num_instances} instances from {masks_of_kind} in {num_views} views{replaces}")
    if is_shown:
        lines = {"found": card.summary, "in doubt": str(card.doubt or ""), "next": card.next_step}
        lines |= {"look at": str(out / REPORT_FILE)} if request.config.report else {}
        for word, sentence in lines.items():
            if sentence:
                say(f"mvseg: {word}: {sentence}", to_stderr=True)


def _plan_stages(config: RunConfig, *, finds: bool) -> list[str]:
    """Plan the stages of a run: the passes that most need, and all rounds of learning that it may need."""
    first: tuple[str, ...] = ("match", "choose")
    if finds:
        from mvseg.pipeline.learn import ROUNDS  # loads torchvision

        first = PASSES if config.detect.image_size is None else ("detect", *first)
        first += ROUND * int({"off": 0, "auto": ROUNDS}.get(str(config.learn), config.learn))
    shapes, traits = (("snap", "surfaces"), ("voxels", "measure")) if config.reconstruct is not None else ((), ())
    return ["load", *first, *shapes, "check", *traits, "write"]


def solve_scene(request: RunRequest, *, cache: Path) -> tuple[Result, Card]:
    """The result of one scene, and the card: the last lines of the run; warnings that are not of its input are passed
    on."""
    config, learned = request.config, request.learned
    with collect_warnings() as noticed, TemporaryDirectory() as place:
        if request.masks is not None and config.detect != DetectConfig():
            warn(Finding("detect_options_unused"))
        if learned.weights is not None:
            path = Path(place) / DETECTOR_FILE
            path.write_bytes(learned.weights)
            config = replace(config, detect=replace(config.detect, weights=str(path)), learn="off")
        masks, edits, force = request.masks, request.corrections, request.force_corrections
        result = run_scene(request.scene, masks, config, corrections=edits, force_corrections=force, cache=cache)
    if learned.weights is not None:
        result = replace(result, learned=learned)
    result = replace(result, findings=keep_causes((*noticed, *result.findings)))
    return result, make_card(result, request.out)


def save_scene(result: Result, card: Card, *, request: RunRequest, output: Output) -> None:
    """Write the result folder, run.json included. `output`: what may be replaced."""
    run = describe_run(result, request.masks, request.config)
    run["card"] = card.as_json()
    run["config"] |= record_places(request.scene, request.out, request.masks, request.corrections)
    save_result(result, request.out, run, report=request.config.report, output=output)


def describe_run(result: Result, masks: Path | None, config: RunConfig) -> dict[str, Any]:
    """Origin of a result, for run.json: version, inputs and photos with their SHA-256 (without `masks`, of the
    detector's weights, too), the options of the stages that ran, and the findings."""
    return {
        **made_by(),
        "torch": torch.__version__,
        "python": platform.python_version(),
        "inputs": dict(result.inputs),
        "photo_sha256": _hash_photos(result),
        "config": _describe_options(masks, config),
        "findings": [each.as_json() for each in result.findings],
    }


def _describe_options(masks: Path | None, config: RunConfig) -> dict[str, Any]:
    options = asdict(config)
    if masks is not None:
        del options["detect"], options["learn"]
    elif Path(config.detect.weights).exists():  # a file of the user, whatever the working directory is
        options["detect"]["weights"] = str(Path(config.detect.weights).resolve())
    if config.reconstruct is None:
        for name in ("reconstruct", "traits", "scale", "unit", "up"):
            del options[name]
    return options


def _hash_photos(result: Result) -> dict[str, str]:
    views, photos = result.scene.views, result.photos or Photos(result.scene)
    if not photos.exist:
        return {}
    folder = photos_folder(views[0])
    return {view.path.relative_to(folder).as_posix(): photos.sha256(index) for index, view in enumerate(views)}
