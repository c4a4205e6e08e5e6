"""One scene from its folder to its result folder."""

from __future__ import annotations

import platform
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import asdict, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal

import torch

from mvseg._version import made_by
from mvseg.checks.check_scene import check_scene
from mvseg.config import RunConfig
from mvseg.detection.cached_detections import claim_cache, delete_cached
from mvseg.detection.config import DetectConfig
from mvseg.detectors.weights_file import DETECTOR_FILE
from mvseg.errors import InputError, collect_warnings, warn
from mvseg.formats.find_views import list_some
from mvseg.formats.photos import Photos
from mvseg.pipeline.run_scene import run_scene
from mvseg.results.card import make_card
from mvseg.results.earlier import Output, check_out
from mvseg.results.folder import REPORT_FILE, photos_folder, save_result
from mvseg.results.read import load_learned
from mvseg.results.result import NOTHING_LEARNED, Learned, Result
from mvseg.runs.recorded_run import read_recorded, record_places
from mvseg.system.atomic import resolve_place, sweep_abandoned
from mvseg.system.running import now_running, running, timed
from mvseg.system.say import say


def run_one_scene(
    scene: Path,
    masks: Path | None,
    out: Path,
    *,
    config: RunConfig,
    corrections: Path | None = None,
    force_corrections: bool = False,
    num_workers: int = 1,
    overwrite: bool = False,
    learned: Learned = NOTHING_LEARNED,
) -> None:
    """One scene from its folder to its result folder; InputWarnings go to stderr and to run.json.

    `learned`: weights that have learned this scene before are used, and not learned again.

    Raises:
        InputError: bad input; corrections of another scene, unless `force_corrections` is set; `out` holds a result of
            another scene, what another command wrote, or what a run found in its photos, and `overwrite` is not set; it
            is read by this run; or another run detects for `out` now.
    """
    place = resolve_place(out)
    sweep_abandoned(place)
    masks = None if masks is None else find_masks(scene, masks)
    corrections = None if corrections is None else find_masks(scene, corrections, what="corrections")
    reads = tuple(path for path in (masks, corrections) if path is not None)
    output = Output("result", of=(scene,), reads=reads, overwrite=overwrite)
    check_out(out, output)
    replaces = " (in place of an earlier result)" if place.is_dir() and any(place.iterdir()) else ""
    cache = place.with_name(f"{place.name}.detections")
    with ExitStack() as stack:
        stack.enter_context(running(stages=_plan_stages(config, masks)))
        if masks is None and stack.enter_context(claim_cache(cache, scene, overwrite=overwrite)):
            say(f"mvseg: going on from the detections in {cache}, for equal photos and options", to_stderr=True)
        with running(num_workers=num_workers):
            place_of_weights = Path(stack.enter_context(TemporaryDirectory()))
            result, messages = solve_scene(
                scene,
                masks,
                _with_learned(config, learned, place_of_weights),
                corrections=corrections,
                force_corrections=force_corrections,
                cache=cache,
            )
        if left_out := len(result.views_left_out):
            num_taken, more = len(result.scene.views), "" if config.views else "; --views all takes all"
            say(f"mvseg: {num_taken} of {num_taken + left_out} views are taken, evenly spread{more}", to_stderr=True)
        card, is_shown = make_card(result, out, scene=scene, masks=masks), now_running().progress
        for message in messages:
            if not (is_shown and card.doubt and card.doubt in message):
                say(f"mvseg: warning: {message}", to_stderr=True)
        if learned.weights is not None:
            result = replace(result, learned=learned)
        with timed("write"):
            save_scene(result, scene, out, masks=masks, config=config, messages=messages, output=output)
        if masks is None:
            delete_cached(cache)
    num_masks, num_views = len(result.regions), len(result.scene.views)
    masks_of_kind = f"{num_masks} masks ({result.mask_kind})" if result.mask_kind else f"{num_masks} masks"
    say(f"{out}: {result.matching.num_instances} instances from {masks_of_kind} in {num_views} views{replaces}")
    if is_shown:
        lines = {"found": card.found, "in doubt": card.doubt, "next": card.next_step}
        lines |= {"look at": str(out / REPORT_FILE)} if config.report else {}
        for word, sentence in lines.items():
            if sentence:
                say(f"mvseg: {word}: {sentence}", to_stderr=True)


def _plan_stages(config: RunConfig, masks: Path | None) -> tuple[tuple[str, ...], ...]:
    """What progress counts, see `Running.stages`."""
    finds = (("detect",), ("match", "choose", "learn", "follow")) if masks is None else (("match", "follow"),)
    shapes, traits = (("snap", "surfaces"),), (("voxels", "measure"),)
    has_shapes = config.reconstruct is not None
    return (*finds, *(shapes if has_shapes else ()), ("check",), *(traits if has_shapes else ()), ("write",))


def _with_learned(config: RunConfig, learned: Learned, folder: Path) -> RunConfig:
    """The same with weights that have learned the scene before, in a file in this folder."""
    if learned.weights is None:
        return config
    path = folder / DETECTOR_FILE
    path.write_bytes(learned.weights)
    return replace(config, detect=replace(config.detect, weights=str(path)), learn="off")


def run_again(
    folder: Path,
    *,
    out: Path | None = None,
    learn: int | Literal["auto", "off"] | None = None,
    detector: Path | None = None,
    corrections: Path | None = None,
    force_corrections: bool = False,
    num_workers: int = 1,
    overwrite: bool = False,
) -> None:
    """The run that made a result once more, with its options; stderr says what has changed since.

    Args:
        folder: the result.
        out: where the new one goes; None: in its place.
        learn: in how many rounds the views teach the detector, see `RunConfig.learn`; None: what the run has learned
            before is used.
        detector: file of weights that have learned this scene; None: that of the result, if it has one.
        corrections: file of a person's edits; None: that of the run, if it had one.
        force_corrections, num_workers, overwrite: as of `run_one_scene`.

    Raises:
        InputError: see `read_recorded` and `run_one_scene`.
    """
    run = read_recorded(folder)
    for change in run.changes:
        say(f"mvseg: {change}", to_stderr=True)
    learned = load_learned(folder, run.said)
    if detector is not None:
        learned = replace(learned, weights=detector.read_bytes(), rounds=1)
    edits = corrections or run.corrections
    run_one_scene(
        run.scene,
        None if run.masks is None else run.masks.resolve(),
        folder if out is None else out,
        config=run.config if learn is None else replace(run.config, learn=learn),
        learned=learned if learn is None else NOTHING_LEARNED,
        corrections=None if edits is None else Path(edits).resolve(),
        force_corrections=force_corrections,
        num_workers=num_workers,
        overwrite=overwrite,
    )


def solve_scene(
    scene: Path,
    masks: Path | None,
    config: RunConfig,
    *,
    corrections: Path | None = None,
    force_corrections: bool = False,
    cache: Path,
) -> tuple[Result, list[str]]:
    """The result of one scene and the InputWarnings on the way, each once; other warnings are passed on."""
    with collect_warnings() as messages:
        if masks is not None and config.detect != DetectConfig():
            warn("the detect options have no effect: masks are given")
        result = run_scene(
            scene,
            masks,
            config,
            corrections=corrections,
            force_corrections=force_corrections,
            cache=cache,
        )
    return result, messages  # each once: each matching of a detector's loop may repeat a warning


def save_scene(
    result: Result,
    scene: Path,
    out: Path,
    *,
    masks: Path | None,
    config: RunConfig,
    messages: Sequence[str],
    output: Output,
) -> None:
    """Write the result folder, run.json included; with the report, the findings of the checks of the scene and its
    masks. `output`: what may be replaced."""
    run = describe_run(result, masks, config, messages=messages)
    corrections = None if result.corrections is None else result.corrections.source
    run["card"] = asdict(make_card(result, out, scene=scene, masks=masks))
    run["config"] |= record_places(scene, out, masks, corrections)
    if config.report:
        # of what features say the run has warned
        check = check_scene(result.scene, result.regions, photos=result.photos, features=False)
        run["checks"] = [asdict(finding) for finding in check.findings]
    save_result(result, out, run, report=config.report, output=output)


def describe_run(
    result: Result, masks: Path | None, config: RunConfig, *, messages: Sequence[str] = ()
) -> dict[str, Any]:
    """Where a result comes from, for run.json: version, inputs and photos with their SHA-256 (without `masks`, of the
    detector's weights, too), the options of the stages that ran, and the `messages` of the run."""
    options = asdict(config)
    if masks is not None:
        del options["detect"], options["learn"]
    if config.reconstruct is None:
        for name in ("reconstruct", "traits", "scale", "unit", "up"):
            del options[name]
    elif Path(config.detect.weights).exists():  # a file of the user, whatever the working directory is
        options["detect"]["weights"] = str(Path(config.detect.weights).resolve())
    return {
        **made_by(),
        "torch": torch.__version__,
        "python": platform.python_version(),
        "inputs": dict(result.inputs),
        "photo_sha256": _hash_photos(result),
        "config": options,
        "warnings": list(messages),
    }


def _hash_photos(result: Result) -> dict[str, str]:
    """{path of a photo in their folder: SHA-256}; nothing where there are no photos."""
    views, photos = result.scene.views, result.photos or Photos(result.scene)
    if not photos.exist:
        return {}
    folder = photos_folder(views[0])
    return {view.path.relative_to(folder).as_posix(): photos.sha256(index) for index, view in enumerate(views)}


def find_masks(scene: Path, masks: Path, beside: Path = Path(), *, what: str = "masks") -> Path:
    """Where masks, or `what` else is given with a scene, lie.

    A relative path may start at the scene folder or at `beside`, as long as only one of the two exists.
    """
    inside, outside = scene / masks, beside / masks
    if inside.exists() and outside.exists() and not inside.samefile(outside):
        raise InputError(f"both {inside} and {outside.resolve()} exist, expected --{what} with the full path of one")
    if scene.is_dir() and not inside.exists() and not outside.exists() and not masks.is_absolute():
        found = list_some(sorted(path.name for path in scene.iterdir()))
        places = f"in {scene}, which holds {found}, nor in {beside.resolve()}"
        raise InputError(f"{masks}: no such {what} {places}; --{what} says where they are")
    return inside if inside.exists() else outside
