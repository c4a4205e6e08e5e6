"""All options of a run: what `mvseg infer` and `run_scene` take."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from mvseg.detection.config import DetectConfig
from mvseg.errors import InputError, check_choices
from mvseg.matching.config import MatchConfig
from mvseg.reconstruction.config import ReconstructConfig
from mvseg.traits.config import TraitsConfig, Up

ENOUGH_VIEWS = 20  # limit: more add time, and next to nothing else (docs/notes/detector.md)


@dataclass(frozen=True)
class RunConfig:
    """From photos, or masks, to ids and shapes.

    Attributes:
        detect: how instances are found in photos; has no effect when masks are given.
        match: how regions are matched across views.
        reconstruct: how instances become shapes; None for ids only.
        traits: which instances count as leaves in the tables of traits.
        learn: let the views teach the detector, where it finds the masks: so many rounds at most, or "off"; "auto" does
            where the detector does not know the species: most leaves score less than it is sure of, or the views choose
            a smaller size than its own.
        views: take so many views, evenly spread by direction around what the cameras look at; "all" for all; None for
            all where masks are given, and `ENOUGH_VIEWS` otherwise; of views from one place only the first, unless
            "all" is said of given masks. Views that corrections name are taken besides.
        scale: factor of all lengths of the world; None for 1. Cameras that state their unit need `unit` with it.
        unit: name of the world's unit after that; None for that of the scene.
        up: the direction that points up in the world, as three numbers; "rig" finds it from cameras that were held
            level, "board" from ArUco markers that lie flat; None for that of the scene.
        report: write report.html, the result as one page.
        coco_crowd: how annotations with `iscrowd` in a COCO file are treated: "mask": as all others; "ignore": left
            out.
        categories: names of the categories whose masks are taken, with commas between them ("leaf,petiole"), where the
            masks have categories; None for all.
        stem_category: name of the category whose masks show stems, with `categories` for those of leaves. Stems get
            ids and nodes, but do not count as leaves. None: no category does.
    """

    detect: DetectConfig = DetectConfig()
    match: MatchConfig = MatchConfig()
    reconstruct: ReconstructConfig | None = ReconstructConfig()
    traits: TraitsConfig = TraitsConfig()
    learn: int | Literal["auto", "off"] = "auto"
    views: int | Literal["all"] | None = None
    scale: float | None = None
    unit: str | None = None
    up: Up | None = None
    report: bool = True
    coco_crowd: Literal["mask", "ignore"] = "mask"
    categories: str | None = None
    stem_category: str | None = None

    def __post_init__(self) -> None:
        check_choices(self)
        if isinstance(self.learn, int) and self.learn < 1:
            raise InputError(f"learn is {self.learn}, expected 1 or more rounds, auto or off")
        if isinstance(self.views, int) and self.views < 2:
            raise InputError(f"views is {self.views}, expected 2 or more, or all")
        if self.scale is not None and not 0 < self.scale < math.inf:
            raise InputError(f"scale is {self.scale:g}, expected a positive number")
        if self.up is not None and not isinstance(self.up, str) and not 0 < math.hypot(*self.up) < math.inf:
            raise InputError(f"up is {self.up}, expected a direction: three finite numbers, not all 0")
        if self.stem_category is not None and self.categories is None:
            raise InputError("stem_category is given without categories, expected the names of those of leaves, too")

    @property
    def category_names(self) -> list[str]:
        """`categories` as a list; empty for all."""
        return [] if self.categories is None else [name.strip() for name in self.categories.split(",")]
