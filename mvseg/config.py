"""All options of a run: what `mvseg infer` and `run_scene` take."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from mvseg.matching.config import MatchConfig
from mvseg.multiview.config import DetectConfig
from mvseg.reconstruction.config import ReconstructConfig


@dataclass(frozen=True)
class RunConfig:
    """From photos, or masks, to ids and shapes.

    Attributes:
        detect: how instances are found in photos; has no effect when masks are given.
        match: how regions are matched across views.
        reconstruct: how instances become shapes; None for ids only.
        split_merged: cut a mask that seems to cover two instances in two.
        coco_crowd: what annotations with `iscrowd` are in a COCO file of masks: "mask", one like all others, or
            "ignore", left out.
    """

    detect: DetectConfig = DetectConfig()
    match: MatchConfig = MatchConfig()
    reconstruct: ReconstructConfig | None = ReconstructConfig()
    split_merged: bool = False
    coco_crowd: Literal["mask", "ignore"] = "mask"
