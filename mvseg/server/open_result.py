"""A result that a person corrects: the outcome of a run is cached, and each edit reruns only what it
affects."""

from __future__ import annotations

import os
import warnings
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from functools import cached_property
from itertools import count
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mvseg.corrections.file import Corrections, load_corrections
from mvseg.errors import InputError, InputWarning
from mvseg.pipeline import BEFORE_EDITS, Stage, list_stages
from mvseg.reconstruction.surface.kept_surfaces import name_each
from mvseg.results.report.correct import describe_fate
from mvseg.results.result import Result
from mvseg.runs.recorded_run import read_recorded
from mvseg.stages import State, detect, load, reconstruct
from mvseg.system.atomic import lock_folder
from mvseg.verification.leaf_color import colors_of_leaves

CORRECTIONS_FILE = "corrections.json"
NOT_SHOWN = ("say_what_is_missing", "check", "measure")  # stages whose outcome the page does not show


class Superseded(Exception):
    """There are newer edits, so these results are not needed any more."""


class OpenResult:
    """A result folder with its scene, its masks (or what the detector finds), and the surfaces that are known already.

    Attributes:
        folder: of the result.
        run: that made it.
        notice: what a person should know of it; "" for nothing.
        found: the masks, not matched yet, or how to find them.
    """

    def __init__(self, folder: Path) -> None:
        """Read the scene and its masks; where a detector made them, find them again.

        Raises:
            InputError: this is no result, or one that this version does not understand; its scene, its masks or its
                photos are gone.
        """
        self.folder = folder
        self.run = read_recorded(folder)
        self.config, masks = self.run.config, self.run.masks
        changes = [each for each in self.run.changes if not each.startswith(f"{self.run.corrections}:")]
        self.notice = " ".join(("What you see is computed anew.", *changes)) if changes else ""
        saved = self.saved_corrections()  # the views that they name are taken
        state = replace(load(self.run.scene, masks, self.config, corrections=saved), corrections=None)
        if not state.photos.exist:
            raise InputError(f"{state.scene.views[0].path}: the photos of this result are gone, expected them there")
        self.found = state if masks is not None else detect(state)
        self._numbers: dict[str, int] = {}  # of the leaf that each mask showed last
        self.has_masks = masks is not None

    def saved_corrections(self) -> Corrections:
        """What was saved into the result folder before; none without the file."""
        path = self.folder / CORRECTIONS_FILE
        return load_corrections(path) if path.is_file() else Corrections()

    def matched(self) -> Result:
        """The masks with the ids that matching alone gives them, within a moment: for the page to begin with."""
        return list_stages(self.config, has_masks=self.has_masks)["match"](self.found).result()

    def recompute(self, corrections: Corrections, is_old: Callable[[], bool]) -> tuple[Result, list[str], list[str]]:
        """The result with these corrections, without traits and voxels; for each edit what hinders it, "" for nothing;
        and the other warnings on the way. Leaves keep their numbers from one result to the next, see `keep_numbers`.

        Where what was computed is kept (`running`), a surface is fitted anew only if its instance's masks differ from
        those in all results before. (A run from the command line fits all of them: each surface also depends a little
        on the masks that may hide it.)

        Raises:
            Superseded: `is_old`, which is asked between the stages, said so.
            InputError: see the stages.
        """
        state, messages = self._before_edits
        state = replace(state, corrections=corrections, colors=self._colors)
        stages = list_stages(self.config, has_masks=self.has_masks, has_edits=len(corrections.edits) > 0)
        left = {name: stage for name, stage in stages.items() if self.has_masks or name not in BEFORE_EDITS}
        state, more = _run(state, left, is_old)
        told = () if state.corrected is None else state.corrected.messages
        shown = keep_numbers(state.result(), self._numbers)
        outcomes = [describe_fate(fate) for fate in shown.fates]
        return shown, outcomes, [text for text in dict.fromkeys(messages + more) if text not in told]

    @cached_property
    def _colors(self) -> NDArray[np.bool_]:
        """The colours of leaves before all edits: they stay, so that an edit changes no mask of other leaves."""
        return colors_of_leaves(self.matched().masks.to("cpu"), self.found.photos)

    @cached_property
    def _before_edits(self) -> tuple[State, list[str]]:
        """What is known without a person, and the warnings on the way; it stays."""
        stages = list_stages(self.config, has_masks=self.has_masks)
        names = () if self.has_masks else BEFORE_EDITS[1:]
        return _run(self.found, {name: stages[name] for name in names if name in stages}, lambda: False)


def _run(state: State, stages: Mapping[str, Stage], is_old: Callable[[], bool]) -> tuple[State, list[str]]:
    """Run stages, without traits and voxels; and the warnings on the way."""
    messages: list[str] = []
    for name, stage in stages.items():
        if is_old():
            raise Superseded
        if name in NOT_SHOWN:
            continue
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always", InputWarning)
            state = reconstruct(state, with_voxels=False) if name == "reconstruct" else stage(state)
        messages += [str(each.message) for each in caught if issubclass(each.category, InputWarning)]
    return state, messages


def keep_numbers(result: Result, known: dict[str, int]) -> Result:
    """The result whose leaves have the numbers that most of their masks' pixels had last; the others get new ones, in
    their order. So ids may have gaps. `known`, {name of a mask: number of its leaf}, learns them."""
    masks = result.masks
    named = [(int(id), int(area), name) for id, area, name in
             zip(masks.instance_ids, masks.regions.areas, name_each(masks.regions), strict=True) if id > 0]  # fmt: skip
    votes = Counter[tuple[int, int]]()
    for instance, area, name in named:
        if name in known:
            votes[instance, known[name]] += area
    numbers: dict[int, int] = {}
    for instance, number in sorted(votes, key=lambda pair: (-votes[pair], pair)):
        if instance not in numbers and number not in numbers.values():
            numbers[instance] = number
    new = count(max(known.values(), default=0) + 1)
    for instance in sorted({each[0] for each in named} - set(numbers)):
        numbers[instance] = next(new)
    known.update({name: numbers[instance] for instance, _, name in named})

    def renumber(ids: Tensor) -> Tensor:
        return torch.tensor([numbers.get(each, -1) for each in ids.tolist()], dtype=torch.int64, device=ids.device)

    merged = [each for each in masks.merged if each.other in numbers]
    masks = masks.with_merged(merged)
    ids = replace(masks, instance_ids=renumber(masks.instance_ids), second_ids=renumber(masks.second_ids))
    return replace(result, matching=result.matching.with_masks(ids), instances=result.instances.renumber(numbers))


@contextmanager
def open_alone(folder: Path) -> Iterator[None]:
    """Keep a second process from correcting the same result; the lock ends with this process, however it ends.

    Raises:
        InputError: another one has it open.
    """
    with ExitStack() as stack:
        try:
            stack.enter_context(lock_folder(folder))
        except InputError:
            raise InputError(f"{folder}: another mvseg correct has this result open, expected one at a time") from None
        yield


def check_writable(folder: Path) -> None:
    """Raises InputError: nothing can be written to the folder."""
    if not os.access(folder, os.W_OK | os.X_OK):
        raise InputError(f"{folder}: cannot be written to, so corrections would be lost; expected a copy of your own")
