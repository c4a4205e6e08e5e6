"""The whole method on a page: from a scene's folder to the same id for a leaf in every view, and its shape.

Everybody calls these lines: `mvseg infer` and `mvseg batch` call `run_scene`, and the page that the user corrects keeps
one `Plant`, and calls those that follow it.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

from mvseg.config import RunConfig
from mvseg.corrections.file import Corrections, load_corrections
from mvseg.corrections.same_scene import check_made_for
from mvseg.detection.cached_detections import CachedDetections, delete_cached
from mvseg.errors import check_arguments, note_warnings
from mvseg.findings.finding import keep_causes
from mvseg.pipeline.apply_edits import apply_edits
from mvseg.pipeline.before_edits import pack_plant
from mvseg.pipeline.finish import check_result, measure, shape_leaves
from mvseg.pipeline.open_scene import open_scene
from mvseg.pipeline.plant import match_given
from mvseg.results.result import Result
from mvseg.system.running import running


@check_arguments
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
        masks: of any kind that `load_masks` reads; None: a detector finds them in the photos.
        corrections: of the user, or the file of them, see `load_corrections`; without any edits they change nothing.
        force_corrections: apply them even if they were made for other photos.
        cache: folder for the detections in this scene's photos, made when it is needed: a run that was cut off goes on
            from them, and one with other options of later stages uses them again. What it holds of other photos or
            options is deleted; `delete_cached` deletes the rest.

    Returns:
        The result; nothing is written but what `cache` says.

    Raises:
        InputError: bad input; corrections of another scene; see the stages.
    """
    if isinstance(corrections, Path | str):
        corrections = load_corrections(corrections)
    with note_warnings() as noticed, running() as now, TemporaryDirectory() as place:
        opened = open_scene(folder, masks, config, corrections=corrections)
        if corrections is not None and not force_corrections:
            check_made_for(corrections, opened.photos)
        with note_warnings() as findings_before:
            if opened.given is not None:
                plant = match_given(opened)
            else:
                from mvseg.pipeline.find_in_photos import find_in_photos  # loads torchvision
                from mvseg.pipeline.learn import learn

                detections = CachedDetections(Path(cache or place))
                plant = find_in_photos(opened, cache=detections)
                plant = learn(plant, cache=detections, corrections=corrections)
                delete_cached(detections.folder, but=detections.used)
        edited = apply_edits(plant, corrections)
        before = None if edited.matching is plant.matching else shape_leaves(plant).surfaces
        result = check_result(shape_leaves(edited, same_segmenter=before), edited)
        result = measure(result, config, corrections)
        packed = pack_plant(plant, findings_before)
    findings = keep_causes((*noticed, *result.findings))
    return replace(result, findings=findings, corrections=corrections, before_edits=packed, seconds=now.seconds)
