"""A scene, opened for a run: which views are taken, how the world stands, and the masks if they are given."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import torch
from torch import Tensor

from mvseg.config import ENOUGH_VIEWS, RunConfig
from mvseg.corrections.file import Corrections
from mvseg.corrections.same_scene import named_views
from mvseg.errors import InputError, warn
from mvseg.findings.finding import Finding, Values
from mvseg.formats.find_views import natural_order
from mvseg.formats.masks.recognise import recognise_masks
from mvseg.formats.photos import Photos, check_photos, require_photos
from mvseg.formats.scene_folder import load_scene, read_masks
from mvseg.masks import STEM_CLASS, Masks
from mvseg.matching.match import check_baselines, find_disagreement
from mvseg.matching.result import Matching
from mvseg.reconstruction.spread_views import find_repeated, spread_views
from mvseg.reconstruction.surface.surface_cache import Cache
from mvseg.scene import Scene
from mvseg.system.file_hash import hash_files
from mvseg.system.running import timed
from mvseg.traits.up import place_scene
from mvseg.verification.choose import Judges

if TYPE_CHECKING:  # loads torchvision
    from mvseg.detection.proposals import Proposer


@dataclass(frozen=True, eq=False)
class Opened:
    """A scene, opened for a run.

    Attributes:
        scene: with the views that are taken; `photos` of these.
        given: their masks, matched to nothing; None: a detector is to find them.
        mask_kind: source of those ("COCO", "label images", ...); "" without any.
        views_left_out: names of the other views.
        inputs: {file or folder: SHA-256 as it was read} of cameras, masks, or the detector's weights, and edits.
        cache: of surfaces and snapped edges, see `fit_surfaces` and `snap_masks`.
        proposer: with the detector that looks; None: the one whose weights `config` names.
    """

    scene: Scene
    photos: Photos
    config: RunConfig
    given: Masks | None = None
    mask_kind: str = ""
    views_left_out: tuple[str, ...] = ()
    inputs: Mapping[Path, str] = field(default_factory=dict)
    cache: Cache = field(default_factory=dict)
    proposer: Proposer | None = None

    @property
    def names(self) -> list[str]:
        """Names of the views."""
        return [view.name for view in self.scene.views]

    def find_disagreement(self, matching: Matching) -> Finding | None:
        """Find out whether the views disagree about the masks, see `mvseg.matching.match.find_disagreement`."""
        return find_disagreement(matching, self.names, is_detected=self.given is None)

    @property
    def holds(self) -> bool:
        """Whether masks are held to what they were matched to: given ones, and those that the views may not choose."""
        return self.given is not None or not self.config.detect.verify

    @property
    def judges(self) -> Judges:
        """Means to judge candidates by."""
        shapes, detect = self.config.reconstruct, self.config.detect
        return Judges(
            cameras=self.scene.cameras.to("cpu"),
            has_surfaces=not self.holds or (shapes is not None and shapes.check_ids and shapes.shape != "voxels"),
            holds=self.holds,
            photos=self.photos if self.photos.exist and not self.holds else None,
            min_probability=detect.min_probability,
            cache=self.cache,
        )


def open_scene(
    folder: Path | str,
    masks: Path | str | None = None,
    config: RunConfig = RunConfig(),
    *,
    corrections: Corrections | None = None,
) -> Opened:
    """Cameras of the views that are taken, those that corrections name among them, and their masks if there are any.

    Warns (InputWarning) of given masks in views that are left out.
    """
    with timed("load"):
        folder, masks = Path(folder), None if masks is None else Path(masks)
        before = {} if masks is None else {masks: _hash_masks(masks)}
        loaded = load_scene(folder)
        files = [loaded.source, None if corrections is None else corrections.source]
        inputs = before | {path: hash_files(path) for path in files if path is not None}
        photos = Photos(loaded)
        whole = place_scene(loaded, photos, scale=config.scale, unit=config.unit, up=config.up)
        once = masks is None or config.views != "all"
        taken = _take_views(whole, config.views or ("all" if masks else ENOUGH_VIEWS), corrections, once=once)
        scene = whole.select(taken)
        left_out = tuple(view.name for index, view in enumerate(whole.views) if index not in taken)
        check_photos(scene)
        check_baselines(scene.cameras)
        photos = photos.select(scene, taken.tolist())
        if masks is None and config.stem_category is not None:
            raise InputError("stem_category names a category of given masks, and there are none (--masks)")
        if masks is None:
            require_photos(scene, folder)
            inputs |= _hash_weights(config)
            return Opened(scene, photos, config, views_left_out=left_out, inputs=inputs)
        mask_files = recognise_masks(whole, masks)
        names = [config.category_names, *([[config.stem_category]] if config.stem_category is not None else [])]
        regions = [read_masks(whole, mask_files, crowd=config.coco_crowd, categories=each) for each in names]
        if before != {masks: _hash_masks(masks)}:
            raise InputError(f"{masks}: has changed while it was read, expected masks that are complete")
        parts = [each.of_views(taken) if left_out else each for each in regions]
        if config.views is not None and left_out:
            num_given = len(regions[0])
            counts: Values = {"count": num_given - len(parts[0]), "total": num_given, "taken": len(taken)}
            views: Values = {"num_views": len(whole.views), "views": config.views or 0}
            warn(Finding("masks_of_other_views", str(masks), {**counts, **views}))
        given = Masks.of(parts[0])
        for stems in parts[1:]:
            both = Masks.concatenate((given, Masks.of(stems, classes=torch.full((len(stems),), STEM_CLASS))))
            given = both.select(both.view_index.argsort(stable=True))
        kind = mask_files.kind
        return Opened(scene, photos, config, given=given, mask_kind=kind, views_left_out=left_out, inputs=inputs)


def _hash_masks(masks: Path) -> str:
    try:
        return hash_files(masks)
    except OSError:
        return ""  # what reads them says why they cannot be read


def _hash_weights(config: RunConfig) -> dict[Path, str]:
    from mvseg.detectors.zoo import weights_path  # loads torchvision

    path = weights_path(config.detect.weights)
    return {path: hash_files(path)} if path.is_file() else {}


def _take_views(scene: Scene, most: int | Literal["all"], corrections: Corrections | None, *, once: bool) -> Tensor:
    """(S,) int64, ascending: the views that are taken, see `RunConfig.views`. Their names decide between equally good
    choices, so that the order of the views does not matter.

    `once`: one view of those from one place, so that a burst, or two equal frames of a film, do not agree with
    themselves: of a real basil with each view twice, areas were off by 8 %.
    """
    order = torch.tensor(sorted(range(len(scene.views)), key=lambda view: natural_order(scene.views[view].name)))
    is_repeated = find_repeated(scene.cameras[order])
    if once and 2 <= int((~is_repeated).sum()) < len(order):
        warn(Finding("views_repeated", values={"count": int(is_repeated.sum()), "total": len(order)}))
        order = order[~is_repeated]
    taken = order if most == "all" else order[spread_views(scene.cameras[order], most)]
    named = [] if corrections is None else named_views(corrections, scene)
    return torch.tensor(sorted({*taken.tolist(), *named}))
