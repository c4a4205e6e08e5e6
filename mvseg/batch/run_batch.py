"""Runs many scenes, all or one part of them; finished scenes are not done again."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import closing, nullcontext, suppress
from dataclasses import asdict, dataclass, replace
from functools import partial
from itertools import chain
from pathlib import Path

from mvseg._version import made_by
from mvseg.batch.scene_list import BatchScene, list_scenes
from mvseg.batch.status import STATE, TABLES, Status, scene_state, write_status
from mvseg.batch.tables import write_tables
from mvseg.batch.work import Finished, work_on_scene
from mvseg.batch.workers import Engine, Lost, run_locally
from mvseg.config import RunConfig
from mvseg.errors import InputError
from mvseg.findings.finding import list_some
from mvseg.results.earlier import Output, check_out
from mvseg.system.atomic import is_partial, lock_folder, resolve_place, sweep_abandoned
from mvseg.system.running import progress_bar
from mvseg.system.say import say


@dataclass(frozen=True)
class BatchCounts:
    """Numbers of scenes; `resumed` are done scenes of an earlier run, `warned` are done scenes with warnings."""

    done: int
    resumed: int
    failed: int
    warned: int


def run_batch(
    source: Path,
    out: Path,
    config: RunConfig = RunConfig(),
    *,
    masks: Path | None = None,
    resume: bool = False,
    num_workers: int = 1,
    part: tuple[int, int] | None = None,
) -> BatchCounts:
    """From scene folders to result folders, by name, and the tables in `out/tables`. Failures are reported on stderr.

    Args:
        masks: in each scene folder, or beside them; None: a detector finds them.
        resume: continue the batch that `out` holds: scenes that are done with the same inputs and options are kept.
        num_workers: processes, >= 1.
        part: (k, n), every n-th scene from the k-th on, 1 <= k <= n: other parts may run at the same time, with the
            same `out` on a disk that all share. It continues what is there, and writes no tables: a last run without
            `part` that resumes does.

    Raises InputError: bad input, before any scene is started: the table, `out`; OSError: the folder of the batch cannot
    be written.
    """
    if num_workers < 1:
        raise InputError(f"num_workers is {num_workers}, expected at least 1")
    if part is not None and not 1 <= part[0] <= part[1]:
        raise InputError(f"part is {part[0]}/{part[1]}, expected K/N with K from 1 to N")
    scenes = list_scenes(source, out, masks)
    scenes = scenes if part is None else scenes[part[0] - 1 :: part[1]]
    if any(scene.masks is None for scene in scenes):
        config = _find_weights(config)
    place = resolve_place(out)
    _claim(out, resume=resume or part is not None)
    with lock_folder(place) if part is None else nullcontext():
        check_out(place / TABLES, Output("tables"))
        if any(is_partial(path) for path in place.iterdir()):  # a run was killed
            for scene in scenes:
                sweep_abandoned(place / scene.name)
        engine = partial(run_locally, partial(work_on_scene, place, config), num_workers=num_workers)
        finished = _work_on_all(scenes, engine, place)
        rows = [(scene, finished[index].status) for index, scene in enumerate(scenes)]
        if part is None:
            run = {**made_by(), "source": str(source), "masks": masks and str(masks)}
            write_tables(place / TABLES, place, rows, run={**run, "config": asdict(config)})
    done = [status for _, status in rows if status.state == "done"]
    resumed, warned = sum(each.is_kept for each in finished.values()), sum(bool(each.warnings) for each in done)
    return BatchCounts(done=len(done), resumed=resumed, failed=len(rows) - len(done), warned=warned)


def _find_weights(config: RunConfig) -> RunConfig:
    """Make the path of weights that do not ship absolute: workers may run elsewhere."""
    from mvseg.detectors.zoo import find_weights, weights_path  # loads torchvision

    weights = config.detect.weights
    if find_weights(weights) is not None:
        return config
    if not weights_path(weights).is_file():
        raise InputError(f"'{weights}' is neither a shipped detector (mvseg models) nor a file of weights")
    return replace(config, detect=replace(config.detect, weights=str(weights_path(weights).absolute())))


def _claim(out: Path, *, resume: bool) -> None:
    """Make `out` the folder of a batch; InputError if it holds something else, or a batch that is not to be resumed."""
    if out.exists() and not out.is_dir():
        raise InputError(f"{out}: is a file, expected a folder for the results")
    if (out / STATE).is_dir():
        if not resume:
            raise InputError(f"{out}: holds an earlier batch, expected --resume true or another --out")
    elif out.is_dir() and not all(is_partial(path) for path in out.iterdir()):
        raise InputError(f"{out}: holds files that are not a batch, expected a new or empty folder")
    (out / STATE).mkdir(parents=True, exist_ok=True)


def _work_on_all(scenes: Sequence[BatchScene], engine: Engine, out: Path) -> dict[int, Finished]:
    finished: dict[int, Finished] = {}
    again: list[int] = []
    running: dict[int, str] = {}  # in the order in which they began

    def show() -> None:
        bar.beside = f", {list_some(list(running.values()))}" if running else ""
        bar.update(0)

    def start(index: int) -> None:
        running[index] = scenes[index].name
        show()

    with progress_bar(total=len(scenes), name="batch", unit="scene") as bar:
        waiting = dict(enumerate(scenes))
        for items in chain([waiting], ({index: scenes[index]} for index in again)):
            try:
                with closing(engine(items, start)) as answers:
                    for index, answer in answers:
                        del running[index]
                        show()
                        if isinstance(answer, Lost) and items is waiting:
                            sentence = f"the process {answer.reason}; it is tried again"
                            say(f"mvseg: {scenes[index].name}: {sentence}", to_stderr=True)
                            again.append(index)
                            continue
                        finished[index] = _give_up(scenes[index], answer, out) if isinstance(answer, Lost) else answer
                        if finished[index].status.state == "failed":
                            say(f"mvseg: {scenes[index].name}: {finished[index].status.sentence}", to_stderr=True)
                        bar.update()
            finally:
                for index in running:  # killed workers did not clean up
                    sweep_abandoned(out / scenes[index].name)
    return finished


def _give_up(scene: BatchScene, lost: Lost, out: Path) -> Finished:
    sentence = f"the process that worked on this scene {lost.reason}, twice"
    folder = scene_state(out, scene.name)
    status = Status(state="failed", scene=str(scene.folder), sentence=sentence)
    with suppress(OSError):  # the tables report it, too
        folder.mkdir(parents=True, exist_ok=True)
        write_status(folder, status)
    sweep_abandoned(out / scene.name)
    return Finished(status)
