"""A result that the user corrects: the plant is found once, and each edit runs again only what follows."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, suppress
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any

import numpy as np
import torch
from pydantic import BaseModel, Field

from mvseg.corrections.file import Corrections, Point, dump_edits
from mvseg.corrections.rough_outline import refine_outline
from mvseg.corrections.same_scene import check_made_for, mark_photos, with_marks
from mvseg.detection.cached_detections import CachedDetections
from mvseg.detectors.weights_file import DETECTOR_FILE
from mvseg.errors import InputError, collect_warnings
from mvseg.findings.finding import Finding
from mvseg.formats.lens import photo_from_pinhole, pinhole_from_photo
from mvseg.masks import Masks
from mvseg.matching.result import Matching, MatchReport
from mvseg.pipeline.apply_edits import apply_edits
from mvseg.pipeline.before_edits import MOST_BYTES, unpack_plant
from mvseg.pipeline.find_in_photos import find_in_photos
from mvseg.pipeline.finish import shape_leaves
from mvseg.pipeline.learn import learn
from mvseg.pipeline.open_scene import open_scene
from mvseg.pipeline.plant import Plant, match_given
from mvseg.reconstruction.surface.leaf_surface import LeafSurface
from mvseg.regions import name_regions, stack_regions
from mvseg.results.folder import BEFORE_EDITS_FILE
from mvseg.results.read import load_result, read_detector
from mvseg.results.report.correct import describe_fate, measure_angles
from mvseg.results.report.page import build_page, describe_update
from mvseg.results.report.pictures import Picture, draw_picture
from mvseg.results.result import Result
from mvseg.runs.recorded_run import read_recorded
from mvseg.server.leaf_news import tell_drawn, tell_vanished
from mvseg.server.saved_edits import Update, read_saved
from mvseg.server.stable_numbers import give_numbers
from mvseg.system.atomic import lock_folder
from mvseg.system.file_hash import hash_files
from mvseg.system.running import running
from mvseg.verification.numbers import EVIDENCE

MOST_CORNERS = 10_000  # limit: corners of an outline that the page sends


class _Rough(BaseModel):
    view: str
    polygon: Annotated[list[Point], Field(min_length=3, max_length=MOST_CORNERS)]


class OpenResult:
    """A result folder with its scene, and its masks if they were given. `notice` is for the user; "" for nothing."""

    def __init__(self, folder: Path) -> None:
        """Read the scene, and its masks if they were given. Raises InputError: this is no result, or one that this
        version does not understand; its scene, its masks or its photos are gone."""
        self.folder = folder
        self.run = read_recorded(folder)
        self._detector = read_detector(folder)
        self._changes = [each for each in self.run.changes if each.where != str(self.run.corrections)]
        changes = (as_sentence(each) for each in self._changes)
        self.notice = " ".join(("What you see is computed anew.", *changes)) if self._changes else ""
        config = self.run.config
        if self._detector is not None:  # it has learned this plant: nobody waits for that again
            config = replace(config, detect=replace(config.detect, weights=str(folder)), learn="off")
        # the views that edits name are taken
        self.opened = open_scene(self.run.scene, self.run.masks, config, corrections=read_saved(folder))
        self.scene, self.photos = self.opened.scene, self.opened.photos
        if not self.photos.exist:
            raise InputError(f"{self.scene.views[0].path}: the photos of this result are gone, expected them there")
        self.answers = {"outline": self.outline}
        self.marks = mark_photos(self.photos)
        self._numbers: dict[str, int] = {}  # of the leaf that each mask showed last
        self._before: tuple[Plant, Mapping[int, LeafSurface] | None] | None = None  # before edits, and its surfaces
        self._newest: tuple[Result, list[Picture]] | None = None  # that the page corrects, and a picture of each view
        self.summary_before = ""  # of the result that the newest whole one replaced
        self.learned: tuple[Plant, list[Finding]] | None = None  # since the detector learned the plant

    @property
    def learner(self) -> OpenResult | None:
        """Itself, where there is a detector that may learn, and views choose what it finds."""
        return None if self.opened.holds else self

    def read_edits(self) -> tuple[Corrections, str]:
        found = read_saved(self.folder)
        with collect_warnings() as noticed:
            check_made_for(found, self.photos)
        return found, " ".join(filter(None, (self.notice, *map(as_sentence, noticed))))

    def mark(self, corrections: Corrections) -> Corrections:
        return with_marks(corrections, self.scene, self.marks)

    def page(self, corrections: Corrections) -> str:
        run, (saved, pictures) = self.run.record.as_json(), self._saved_page
        made_with = () if saved.corrections is None else saved.corrections.edits
        run["card"] = (run.get("card") or {}) | {"before": self.summary_before, "edits": dump_edits(made_with)}
        return build_page(replace(saved, corrections=corrections), pictures, run=run, is_served=True)

    def updates(self, corrections: Corrections, is_old: Callable[[], bool]) -> Iterator[Update]:
        result, outcomes, messages = self.recompute(corrections, is_old)
        before, pictures = self._newest or self._saved_page
        sizes = result.scene.cameras.sizes.tolist()
        pictures = [each.with_masks(result.masks, view=n, size=tuple(sizes[n])) for n, each in enumerate(pictures)]
        known = () if before.corrections is None else before.corrections.edits
        new = [each for each in corrections.edits if each not in known]
        vanished = tell_vanished(before, result, new=new)
        news = describe_update(result, pictures)
        news["told"] = tell_drawn(result, new=new, angles=measure_angles(result))
        news["agreedArea"] = () if self.learned is None else self.learned[0].learned.agreed_area
        self._newest = result, pictures
        yield Update(news, outcomes, vanished + messages)
        if not self.opened.holds:
            _ = self._now[0].editable  # all edits begin with it

    @cached_property
    def _saved_page(self) -> tuple[Result, list[Picture]]:
        saved, views = self.saved_result, range(len(self.scene.views))
        return saved, [draw_picture(self.photos(view), saved.masks, view=view, is_whole=True) for view in views]

    @cached_property
    def saved_result(self) -> Result:
        """The result as it lies in the folder, for the page to begin with; without masks where it shows other views, or
        another version of mvseg wrote it in a way that this one cannot read."""
        with suppress(InputError):
            saved = load_result(self.folder)
            if [view.name for view in saved.scene.views] == [view.name for view in self.scene.views]:
                ids = zip(name_regions(saved.regions), saved.masks.instance_ids.tolist(), strict=True)
                self._numbers.update({name: number for name, number in ids if number > 0})
                return replace(saved, scene=self.scene, photos=self.photos)
        return Result(self.scene, Matching(Masks.of(stack_regions([], len(self.scene.views))), MatchReport("none")))

    def recompute(self, corrections: Corrections, is_old: Callable[[], bool]) -> tuple[Result, list[str], list[str]]:
        """The result with these corrections, without traits and voxels, bit for bit that of `mvseg infer --again`:
        earlier fits are taken where they would be fitted to the same. Also the problem of each edit, "" for none, and
        sentences of the findings that the run did not report. Findings are compared by code, as edits change their
        values. Leaves keep their numbers from one result to the next, see `keep_numbers`.

        Raises Cancelled: `is_old`, which is asked between the stages, said so; InputError: see the stages.
        """
        plant, noticed = self._now
        with running(is_cancelled=is_old), collect_warnings() as more:
            edited = apply_edits(plant, corrections)
            is_changed = edited.matching is not plant.matching
            result = shape_leaves(edited, same_segmenter=self._fit_before(plant) if is_changed else None)
        previous, _ = self._newest or self._saved_page
        shown = keep_numbers(replace(result, corrections=corrections), self._numbers, previous.masks)
        told = {"edit", *(each.get("code") for each in self.run.record.findings)}
        new = dict.fromkeys(as_sentence(each) for each in noticed + more if each.code not in told)
        return shown, [describe_fate(fate) for fate in shown.fates], [*new]

    def learn(self, corrections: Corrections, is_old: Callable[[], bool], report: Callable[[str], None]) -> None:
        """Let the detector learn the leaves that the views agree about, and those that the user outlined, in one round
        that begins with the weights of the run; `learned` is the outcome, and None undoes it.

        Raises Cancelled: `is_old`, asked at every step, said so; InputError: nothing was learned.
        """
        with running(is_cancelled=is_old, report=report), collect_warnings() as findings, TemporaryDirectory() as place:
            cache = CachedDetections(Path(place))
            learned = learn(self._plant_before[0], cache=cache, corrections=corrections, rounds=1)
        if learned.learned.weights is None:
            raise InputError(" ".join(map(as_sentence, findings)))
        self.learned = learned, findings

    def again(self, place: Path) -> list[str]:
        """`mvseg infer --again`, with options by which the detector of the page finds the whole result, whichever lies
        in the folder by now; its weights are written into the folder `place`."""
        weights = self._detector if self.learned is None else self.learned[0].learned.weights
        again = ["infer", "--again", str(self.folder.resolve())]
        if weights == read_detector(self.folder):
            return again
        if weights is None:
            return [*again, "--learn", "off"]
        (place / DETECTOR_FILE).write_bytes(weights)
        return [*again, "--detector", str(place / DETECTOR_FILE)]

    def reopened(self) -> OpenResult:
        """The result as it is in the folder now."""
        opened = OpenResult(self.folder)
        opened.summary_before = (self.run.record.as_json().get("card") or {}).get("found", "")
        return opened

    def outline(self, text: bytes) -> dict[str, Any]:
        """Refine a rough outline, both in pixels of the user's photo. Raises InputError: a request of another form, no
        such view, or nothing to outline."""
        scene = self.scene
        try:
            asked = _Rough.model_validate_json(text)
            view = [each.name for each in scene.views].index(asked.view)
        except ValueError:
            what = '{"view": name of a photo, "polygon": [[x, y], ...]}'
            raise InputError(f"expected {what}, 3 to {MOST_CORNERS} points in the photo") from None
        rough = np.array(asked.polygon)
        lens, K = scene.views[view].lens, scene.cameras.K[view].cpu().numpy()
        straight = rough if lens is None else pinhole_from_photo(lens, K, rough)
        if not np.isfinite(straight).all():
            raise InputError("the rough outline leaves what the lens shows")
        found = refine_outline(self.photos(view), straight)
        placed = found if lens is None else photo_from_pinhole(lens, K, found)
        return {"polygon": np.round(placed, 2).tolist()}

    @property
    def _now(self) -> tuple[Plant, list[Finding]]:
        return self._plant_before if self.learned is None else self.learned

    @cached_property
    def _plant_before(self) -> tuple[Plant, list[Finding]]:
        content = self._before_edits()
        if content is not None and (before := unpack_plant(content, self.opened)) is not None:
            return before
        with collect_warnings() as noticed:
            plant = find_in_photos(self.opened) if self.opened.given is None else match_given(self.opened)
        return plant, noticed

    def _fit_before(self, plant: Plant) -> Mapping[int, LeafSurface] | None:
        if self._before is None or self._before[0] is not plant:
            self._before = plant, shape_leaves(plant).surfaces
        return self._before[1]

    def _before_edits(self) -> bytes | None:
        path, said = self.folder / BEFORE_EDITS_FILE, self.run.record
        is_same = not self._changes and said.torch == torch.__version__ and path.is_file()
        is_same = is_same and path.stat().st_size <= MOST_BYTES
        return path.read_bytes() if is_same and hash_files(path) == said.files.get(BEFORE_EDITS_FILE) else None


def as_sentence(finding: Finding) -> str:
    text = str(finding)
    return f"{text[:1].upper()}{text[1:]}" + ("" if text.endswith("?") else ".")


def keep_numbers(result: Result, number_of: dict[str, int], previous: Masks | None = None) -> Result:
    """Give leaves the numbers that most of their masks' pixels had last, and the others new ones, see `give_numbers`.

    Args:
        number_of: {name of a mask: number of its leaf}; learns those of the result.
        previous: masks that the page shows, with their numbers: a mask without a known name, as a detector that has
            learned finds it, votes for the leaf of the mask that it covers (`EVIDENCE.fits`). None: there are none.
    """
    masks = result.masks
    names, ids, areas = name_regions(masks.regions), masks.instance_ids.tolist(), masks.regions.areas.tolist()
    named = [(ids[row], areas[row], name, row) for row, name in enumerate(names) if ids[row] > 0]
    votes = Counter[tuple[int, int]]()
    for instance, area, name, row in named:
        if name in number_of:
            votes[instance, number_of[name]] += area
        elif previous is not None:
            mask = masks.regions.placed(row)
            beside = (previous.view_index == masks.view_index[row]) & (previous.instance_ids > 0)
            for other in beside.nonzero()[:, 0].tolist():
                if previous.regions.placed(other).iou(mask) > EVIDENCE.fits:
                    votes[instance, int(previous.instance_ids[other])] += area
    numbers = give_numbers(votes, {each[0] for each in named}, number_of.values())
    number_of.update({name: numbers[instance] for instance, _, name, _ in named})

    kept = replace(masks, instance_ids=torch.tensor([numbers.get(each, -1) for each in ids]).to(masks.instance_ids))
    return replace(result, matching=result.matching.with_masks(kept), instances=result.instances.renumber(numbers))


def open_alone(folder: Path) -> AbstractContextManager[None]:
    """Keep a second process from correcting the same result; the lock ends with this process, however it ends. Raises
    InputError: another one has it open."""
    return lock_folder(folder, other="another mvseg correct has this result open")


def check_writable(folder: Path) -> None:
    """Raises InputError: nothing can be written to the folder."""
    if not os.access(folder, os.W_OK | os.X_OK):
        raise InputError(f"{folder}: cannot be written to, so corrections would be lost; expected a copy of your own")
