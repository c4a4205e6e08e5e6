"""Options of `mvseg pose`: of structure from motion, and what is known of the world."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from mvseg.errors import InputError, check_ranges
from mvseg.formats.board import BoardConfig
from mvseg.poses.numbers import STRUCTURE

Pairs = Literal["exhaustive", "sequential"]
# Lenses that a rig file can hold.
CameraModel = Literal["SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV"]


@dataclass(frozen=True)
class PoseConfig:
    """How the cameras of photos are estimated.

    Attributes:
        pairs: which photos are compared: all pairs (exhaustive), or neighbours in the order of their names and a few
            further away, the last being neighbours of the first (sequential). By default all pairs of up to 30 photos;
            of more, neighbours and those that look alike, and all pairs of photos that these leave out.
        image_size: photos whose longer side has more pixels are scaled down to it for finding features; to 1600
            at the first attempt, which is quick.
        camera_model: COLMAP's name of the lens.
        shared_camera: true: one camera took all photos, with one zoom; false: every photo has a camera of its own. By
            default photos of one folder, size and (EXIF) focal length share one.
        calibration: file of OpenCV or ROS with the camera matrix and distortion of all photos; they are then not
            estimated.
        min_registered: number of photos that must register; by default 60 %, and at least 3.
        frames: of a video, at most so many become photos.
    """

    pairs: Pairs | None = None
    image_size: int = 2000
    camera_model: CameraModel = "SIMPLE_RADIAL"
    shared_camera: bool | None = None
    calibration: Path | None = None
    min_registered: int | None = None
    frames: int = 60

    def __post_init__(self) -> None:
        least = (STRUCTURE.least, math.inf)
        check_ranges(self, image_size=(64, math.inf), min_registered=least, frames=least)
        if self.calibration is not None and self.shared_camera is False:
            raise InputError("shared_camera is false beside a calibration, expected one of them")


@dataclass(frozen=True)
class WorldFacts:
    """Facts that are known of the world; at most one of the first four.

    Attributes:
        board: a printed ChArUco board, which then defines the axes of the world.
        marker: side of the printed markers (their black squares).
        distance: two photos, markers as marker:7, or spots as a.jpg:812,455+b.jpg:790,470 (pixels from the top left
            corner of photos that show it), and how far apart they are.
        positions: file of the camera positions, see `formats/positions.py`.
        unit: name of the unit of these lengths.
    """

    board: BoardConfig | None = None
    marker: float | None = None
    distance: tuple[str, str, float] | None = None
    positions: Path | None = None
    unit: str = ""

    @property
    def scales(self) -> list[str]:
        """Names of options that give a scale."""
        return [name for name in ("board", "marker", "distance", "positions") if getattr(self, name) is not None]

    def __post_init__(self) -> None:
        if len(given := self.scales) > 1:
            raise InputError(f"{' and '.join(given)} both give a scale, expected one of them")
        for name, length in {"marker": self.marker, "distance": self.distance and self.distance[2]}.items():
            if length is not None and not 0 < length < math.inf:
                raise InputError(f"{name} is {length:g} long, expected a positive number")
