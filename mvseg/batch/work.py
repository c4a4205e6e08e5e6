"""Work on one scene of a batch: its result is made unless it exists; a failure becomes a sentence in its status.

One hash is the key of all that a result depends on: a result with the same key need not be made again.
"""

from __future__ import annotations

import hashlib
import json
import os
import time
import traceback
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from mvseg._version import code_hash
from mvseg.batch.scene_list import BatchScene
from mvseg.batch.status import Status, read_status, scene_state, write_status
from mvseg.config import RunConfig
from mvseg.errors import InputError, collect_warnings, say_fault
from mvseg.formats.masks.yolo import name_files
from mvseg.formats.scene_folder import load_scene
from mvseg.results.earlier import RUN_FILE, Output, check_out
from mvseg.results.run_record import load_run
from mvseg.runs.one_scene import save_scene, solve_scene
from mvseg.runs.request import RunRequest
from mvseg.scene import Scene
from mvseg.system.atomic import lock_folder, sweep_abandoned
from mvseg.system.file_hash import hash_files
from mvseg.system.threads import stay_on_one_thread


@dataclass(frozen=True)
class Finished:
    """A scene that is done or has failed; `is_kept`: an earlier run did it, with the same inputs and options."""

    status: Status
    is_kept: bool = False


def work_on_scene(out: Path, config: RunConfig, scene: BatchScene) -> Finished:
    """Work on one scene, on one thread, while no other process does; `out` is the absolute folder of all results.
    Raises OSError if the scene's status cannot be written."""
    stay_on_one_thread()
    folder, place, started = scene_state(out, scene.name), out / scene.name, time.monotonic()
    folder.mkdir(parents=True, exist_ok=True)
    with lock_folder(folder, wait=True):
        earlier = read_status(folder)
        try:
            request = RunRequest(scene.folder, scene.masks, place, config, corrections=scene.corrections)
            request = request.with_found(scene.beside)
            with collect_warnings():  # the run itself gives them
                key = scene_key(load_scene(scene.folder), request)
            if earlier is not None and earlier.key == key and _is_done(earlier, place):
                return Finished(earlier, is_kept=True)
            write_status(folder, Status(state="running", scene=str(scene.folder), key=key))
            status = _finish(request, cache=folder / "detections")
        except Exception as error:  # whatever it is, the other scenes continue
            status, key = _describe_failure(error, scene), ""
        seconds = round(time.monotonic() - started, 3)
        status = status.model_copy(update={"key": key, "seconds": seconds, "peak_mb": _peak_mb()})
        write_status(folder, status)
    return Finished(status)


def _is_done(status: Status, result: Path) -> bool:
    run = result / RUN_FILE
    if status.state != "done" or not run.is_file() or hash_files(run) != status.result:
        return False
    return all((result / name).is_file() for name in load_run(result).files)


def _finish(request: RunRequest, *, cache: Path) -> Status:
    sweep_abandoned(request.out)
    # the name in the batch says whose the result is: scenes may have moved
    output = Output("result", reads=(request.scene, *request.inputs))
    check_out(request.out, output)
    result, card = solve_scene(request, cache=cache)
    save_scene(result, card, request=request, output=output)
    return Status(
        state="done",
        scene=str(request.scene),
        result=hash_files(request.out / RUN_FILE),
        instances=result.matching.num_instances,
        masks=len(result.regions),
        views=len(result.scene.views),
        warnings=[str(each) for each in result.findings if each.level != "note"],
    )


def _describe_failure(error: Exception, scene: BatchScene) -> Status:
    trace = ""
    if isinstance(error, InputError):
        sentence = str(error)
    elif isinstance(error, OSError | MemoryError):
        sentence = say_fault(error)
    else:
        trace = "".join(traceback.format_exception(error))
        last = traceback.extract_tb(error.__traceback__)[-1]
        place = f"{Path(last.filename).name}, line {last.lineno}"
        sentence = f"unexpected {type(error).__name__} in {place}: {error}"
    return Status(state="failed", scene=str(scene.folder), sentence=" ".join(sentence.split()), trace=trace)


def _peak_mb() -> float | None:
    """Peak memory of this process. (What Linux's `getrusage` says starts with that of its parent.)"""
    try:
        lines = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
        return round(next(int(line.split()[1]) for line in lines if line.startswith("VmHWM:")) / 1e3, 1)  # kB
    except (OSError, ValueError, StopIteration):
        return None


def scene_key(scene: Scene, request: RunRequest) -> str:
    """The hash of a scene's inputs and of the options of a request.

    It covers the cameras as they were read; names, sizes and times of photos and masks, which reveal changes without
    reading gigabytes; without masks, the detector's weights; all options and mvseg's code; but not the paths of the
    files. Hidden files are ignored. Raises OSError if a file cannot be read, InputError if the weights are not there.
    """
    options, masks = asdict(request.config), request.masks
    if masks is None:
        from mvseg.detectors.zoo import weights_path  # loads torchvision

        options["detect"]["weights"] = None  # their hash counts, not their name
        others: Any = hash_files(Path(weights_path(request.config.detect.weights)))
    else:
        del options["detect"]
        others = [_describe_file(path, masks) for path in _mask_files(masks)]
    edits = None if request.corrections is None else hash_files(request.corrections)
    photos = [_describe_file(view.path, view.path.parent) for view in scene.views if view.path.is_file()]
    told = [code_hash(), _describe_scene(scene), photos, others, edits, options]
    return hashlib.sha256(json.dumps(told, default=str).encode()).hexdigest()


def _describe_scene(scene: Scene) -> list[Any]:
    cameras, of_views = scene.cameras, [view.lens for view in scene.views]
    lenses = [None if each is None else [each.model_name, each.width, each.height, *each.params] for each in of_views]
    numbers = [tensor.tolist() for tensor in (cameras.K, cameras.R, cameras.t, cameras.sizes)]
    return [scene.name, scene.unit, scene.up, [view.name for view in scene.views], lenses, numbers]


def _describe_file(path: Path, start: Path) -> list[str | int]:
    about = path.stat()
    return [Path(os.path.relpath(path, start)).as_posix(), about.st_size, about.st_mtime_ns]


def _mask_files(masks: Path) -> list[Path]:
    if not masks.is_dir():
        return [masks]
    files = sorted(path for path in masks.rglob("*") if path.is_file() and not path.name.startswith("."))
    return files + [path for path in name_files(masks) if path.is_file() and path.parent != masks]
