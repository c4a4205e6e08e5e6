"""Requests of runs: the command line, a batch and `--again` make one each."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

from mvseg.config import RunConfig
from mvseg.errors import InputError
from mvseg.findings.finding import list_some
from mvseg.results.read import load_learned
from mvseg.results.result import NOTHING_LEARNED, Learned
from mvseg.runs.recorded_run import read_recorded
from mvseg.system.say import say


@dataclass(frozen=True)
class RunRequest:
    """One scene, from its folder to its result folder.

    Attributes:
        masks: file or folder; None: a detector finds them.
        force_corrections: apply them even if they were made for other photos.
        overwrite: replace another scene's result, output of another command, or detected masks in `out`.
        learned: weights that have learned this scene before; they are used, and nothing is learned again.
    """

    scene: Path
    masks: Path | None
    out: Path
    config: RunConfig
    corrections: Path | None = None
    force_corrections: bool = False
    overwrite: bool = False
    learned: Learned = NOTHING_LEARNED

    @property
    def inputs(self) -> tuple[Path, ...]:
        return tuple(path for path in (self.masks, self.corrections) if path is not None)

    def with_found(self, beside: Path = Path()) -> RunRequest:
        """The same with the places of masks and corrections, see `find_given`; only masks may lie `beside`."""
        masks = None if self.masks is None else find_given(self.scene, self.masks, beside)
        edits = None if self.corrections is None else find_given(self.scene, self.corrections, what="corrections")
        return replace(self, masks=masks, corrections=edits)


def repeat_run(
    folder: Path,
    *,
    out: Path | None = None,
    learn: int | Literal["auto", "off"] | None = None,
    detector: Path | None = None,
    corrections: Path | None = None,
) -> RunRequest:
    """The request that made a result, once more, with its options; stderr says what has changed since. Raises
    InputError: see `read_recorded`.

    Each None stays as it was: the place `out`; the weights learned before, of which `detector` is another file, and
    `learn` are rounds that learn them anew, see `RunConfig.learn`; and the `corrections`, a file of the user's edits.
    """
    run = read_recorded(folder)
    for change in run.changes:
        say(f"mvseg: {change}", to_stderr=True)
    learned, config = load_learned(folder, run.record), run.config
    if detector is not None:
        learned = replace(learned, weights=detector.read_bytes(), rounds=1)
    if learn is not None:
        learned, config = NOTHING_LEARNED, replace(config, learn=learn)
    masks, edits = (path and path.resolve() for path in (run.masks, corrections or run.corrections))
    return RunRequest(run.scene, masks, out or folder, config, corrections=edits, learned=learned)


def find_given(scene: Path, given: Path, beside: Path = Path(), *, what: str = "masks") -> Path:
    """Find masks, or `what` else is given with a scene. A relative path may start at the scene folder or at `beside`,
    as long as only one of the two exists. Raises InputError: both exist, or neither."""
    inside, outside = scene / given, beside / given
    if inside.exists() and outside.exists() and not inside.samefile(outside):
        raise InputError(f"both {inside} and {outside.resolve()} exist, expected --{what} with the full path of one")
    if scene.is_dir() and not inside.exists() and not outside.exists() and not given.is_absolute():
        found = list_some(sorted(path.name for path in scene.iterdir()))
        places = f"in {scene}, which holds {found}, nor in {beside.resolve()}"
        raise InputError(f"{given}: no such {what} {places}; --{what} says where they are")
    return inside if inside.exists() else outside
