"""The whole method as a list of stages: each takes what is known of a scene, and gives it back with more."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from mvseg.config import RunConfig
from mvseg.corrections.file import Corrections, load_corrections
from mvseg.corrections.same_scene import check_made_for
from mvseg.results.result import Result
from mvseg.stages import (
    State,
    check_cameras,
    check_ids,
    choose,
    choose_corrected,
    correct,
    correct_instances,
    detect,
    follow,
    load,
    match,
    match_refined,
    measure,
    reconstruct,
    say_what_is_missing,
    settle_edits,
    snap,
    split,
)
from mvseg.system.running import running

Stage = Callable[[State], State]
BEFORE_EDITS = ("detect", "match", "split", "choose")  # stages of detected masks, that no edit changes


def run_scene(
    folder: Path | str,
    masks: Path | str | None = None,
    config: RunConfig = RunConfig(),
    *,
    corrections: Corrections | Path | str | None = None,
    force_corrections: bool = False,
    cache: Path | str | None = None,
) -> Result:
    """From a scene folder, with or without masks, to ids in every view and, if asked for, shapes in 3D and traits.

    Args:
        folder: the scene, see `load_scene`.
        masks: of any kind that `load_masks` reads; None: a detector finds them in the photos.
        config: the options of all stages.
        corrections: of a person, or the file of them, see `load_corrections`; without any edits they change nothing.
        force_corrections: apply them even if they were made for other photos.
        cache: folder for the detections in this scene's photos, made when it is needed: a run that was cut off goes on
            from them, and one with other options of later stages uses them again. What it holds of other photos or
            options is deleted; `delete_cached` deletes the rest.

    Returns:
        The result; nothing is written but what `cache` says.

    Raises:
        InputError: bad input; corrections of another scene; see the stages.
    """
    begun = time.perf_counter()
    folder, masks, cache = Path(folder), *(None if path is None else Path(path) for path in (masks, cache))
    if isinstance(corrections, Path | str):
        corrections = load_corrections(corrections)
    has_edits = corrections is not None and len(corrections.edits) > 0
    state = load(folder, masks, config, corrections=corrections, cache=cache)
    if corrections is not None and not force_corrections:
        check_made_for(corrections, state.photos)
    seconds = {"load": time.perf_counter() - begun}
    with running(keep=True):
        for name, stage in list_stages(config, has_masks=masks is not None, has_edits=has_edits).items():
            begun = time.perf_counter()
            state = stage(state)
            seconds[name] = time.perf_counter() - begun
    return replace(state, seconds=seconds).result()


def list_stages(config: RunConfig, *, has_masks: bool, has_edits: bool = False) -> dict[str, Stage]:
    """The stages that a config asks for, in their order.

    Masks that were given are checked by surfaces where they are to be cut, since these know best which ones show two
    leaves. What a detector found is cut before surfaces are fitted to it. Edits are about the masks that a person sees:
    those that were given, or what was found without edits; then the stages before them run once more.
    """
    shapes = config.reconstruct
    is_verified = not has_masks and config.detect.verify  # the views choose
    is_checked = shapes is not None and shapes.check_ids and shapes.shape != "voxels" and not is_verified
    first = match_refined if config.refine_poses else match
    cut = split if config.split_merged and not is_checked else None
    listed = {
        "detect": None if has_masks else detect,
        "match": first,
        "split": cut,
        "choose": choose if is_verified else None,
    }
    if has_edits:
        listed = {} if has_masks else listed
        listed |= {
            "correct": correct,
            "match_corrected": first if has_masks else match,
            "correct_instances": correct_instances,
            "follow": follow if is_verified or shapes is not None else None,
            "split_corrected": cut,
            "choose_corrected": choose_corrected if is_verified else None,
        }
    listed |= {
        "snap": snap if is_verified else None,
        "say_what_is_missing": say_what_is_missing if is_verified else None,
        "check": check_cameras,
        "check_ids": check_ids if is_checked else None,
        "split_checked": split if config.split_merged and is_checked else None,
        "reconstruct": None if shapes is None else reconstruct,
        "settle": settle_edits if has_edits else None,
        "measure": None if shapes is None else measure,
    }
    return {name: stage for name, stage in listed.items() if stage is not None}
