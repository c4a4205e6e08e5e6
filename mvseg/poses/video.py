"""Sharp frames of a video, evenly spread by motion, as photos.

Corners are followed from frame to frame (Lucas and Kanade's optical flow in a pyramid), and how far they have moved in
the picture says how far the camera has come. Where it stands still, frames would be equal; where it runs, they are few.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from mvseg.errors import InputError
from mvseg.poses.numbers import STRUCTURE, VIDEO
from mvseg.system.running import progress_bar

Grey = NDArray[np.uint8]
Floats = NDArray[np.float64]

VIDEO_SUFFIXES = (".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm")
SILENT = "-8"  # of FFmpeg's log, which is for its developers


@dataclass(frozen=True, eq=False)
class Footage:
    """Motion in every frame, or in every second or third one.

    Attributes:
        frames: (F,) int64, numbers of the frames in the video, from 0.
        motion: (F,) how far the picture has moved since the first frame, in longer sides of it; it never falls.
        sharpness: (F,) variance of the Laplacian.
    """

    frames: NDArray[np.int64]
    motion: Floats
    sharpness: Floats


def is_video(path: Path) -> bool:
    """Whether a path is a file with a video's suffix."""
    return path.is_file() and path.suffix.lower() in VIDEO_SUFFIXES


def write_frames(clip: Path, folder: Path, *, most: int) -> list[str]:
    """Write the sharp frames of a video into a new folder as JPEG, upright; returns their names, in order of time.

    Args:
        folder: made here.
        most: number of frames, at most; a video with less motion gives fewer.

    Raises:
        InputError: the video cannot be opened or read, or shows too little motion.
    """
    footage = watch(clip)
    chosen = set(choose_frames(footage, most=most))
    if len(chosen) < STRUCTURE.least:
        moved, wanted = footage.motion[-1], STRUCTURE.least * VIDEO.step
        message = f"the picture moves by {moved:.0%} of its longer side in {len(footage.frames)} frames"
        raise InputError(f"{clip}: {message}, expected {wanted:.0%} or more: a walk round the plant")
    folder.mkdir(parents=True)
    names = []
    with _opened(clip) as video:
        for number, frame in _read(video, sorted(chosen)):
            names.append(f"frame-{number:06d}.jpg")
            if not cv2.imwrite(str(folder / names[-1]), frame, [cv2.IMWRITE_JPEG_QUALITY, STRUCTURE.quality]):
                raise OSError(f"{folder / names[-1]} cannot be written")
    return names


def watch(clip: Path) -> Footage:
    """Measure motion and sharpness over a video, in `VIDEO.per_second` frames of each second.

    Raises:
        InputError: the video cannot be opened, or has no frames.
    """
    numbers: list[int] = []
    motion: list[float] = []
    sharpness: list[float] = []
    with _opened(clip) as video, progress_bar(name="video", unit="frame") as bar:
        rate = video.get(cv2.CAP_PROP_FPS)
        every = max(1, round(rate / VIDEO.per_second)) if 0 < rate < 1000 else 1
        track, base = None, 0.0
        for number, frame in _read(video, every=every):
            grey = _shrink(frame)
            track, moved, gone = _follow(track, grey)
            motion.append(max(base + moved, motion[-1] if motion else 0.0))
            base += gone
            numbers.append(number)
            sharpness.append(float(cv2.Laplacian(grey, cv2.CV_64F).var()))
            bar.update(1)
    if not numbers:
        raise InputError(f"{clip}: no frame of the video can be read, expected MP4, MOV, AVI, MKV or WebM")
    return Footage(frames=np.array(numbers), motion=np.array(motion), sharpness=np.array(sharpness))


def choose_frames(footage: Footage, *, most: int) -> list[int]:
    """Numbers of frames that are about `VIDEO.step` (or a `most`-th of all motion, if that is more) apart.

    The motion is cut into equal parts, and the sharpest frame in the middle half of each is taken: two in a row are
    half a part to one and a half parts apart, where the video has frames there.
    """
    total = float(footage.motion[-1])
    number = min(most, int(total / VIDEO.step + 1e-9))
    chosen: list[int] = []
    for part in range(number):
        place = footage.motion / total * number - part  # 0 to 1 within the part
        middle, whole = (place >= 0.25) & (place <= 0.75), (place >= 0) & (place <= 1)
        inside = np.flatnonzero(middle if middle.any() else whole)
        if len(inside):
            chosen.append(int(footage.frames[inside[np.argmax(footage.sharpness[inside])]]))
    return sorted(set(chosen))


@dataclass(frozen=True, eq=False)
class _Track:
    """Corners that are followed: where they were found, where they are (C, 1, 2) float32, and the picture there."""

    start: NDArray[np.float32]
    now: NDArray[np.float32]
    grey: Grey


def _follow(track: _Track | None, grey: Grey) -> tuple[_Track, float, float]:
    """The corners in the next picture; the median of how far they are from where they were found, and how much of that
    is to be added to all that follows, since new corners are found. In longer sides.

    A picture in which no corner is found again (a cut, a jerk) counts as `VIDEO.step`.
    """
    if track is None or not len(track.now):
        return _find_corners(grey), 0.0, 0.0
    now, found = _flow(track.grey, grey, track.now)
    back, returned = _flow(grey, track.grey, now)
    is_same = np.linalg.norm(back - track.now, axis=2)[:, 0] < 1  # pixel
    is_kept = found & returned & is_same
    if is_kept.sum() < VIDEO.least_corners:
        return _find_corners(grey), VIDEO.step, VIDEO.step
    start, now = track.start[is_kept], now[is_kept]
    moved = float(np.median(np.linalg.norm(now - start, axis=2))) / max(grey.shape)
    if moved < VIDEO.anew and is_kept.sum() >= VIDEO.least_followed * len(is_kept):
        return _Track(start=start, now=now, grey=grey), moved, 0.0
    return _find_corners(grey), moved, moved


def _flow(before: Grey, after: Grey, corners: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Positions of corners (C, 1, 2) in the other picture, and (C,) whether they were found."""
    moved, found, _ = cv2.calcOpticalFlowPyrLK(
        before, after, corners, np.zeros_like(corners), winSize=(VIDEO.window, VIDEO.window), maxLevel=VIDEO.levels
    )
    return np.asarray(moved, np.float32), np.asarray(found)[:, 0] == 1


def _find_corners(grey: Grey) -> _Track:
    found = cv2.goodFeaturesToTrack(grey, VIDEO.corners, 0.01, max(grey.shape) / 60)
    corners = np.zeros((0, 1, 2), np.float32) if found is None else np.asarray(found, np.float32)
    return _Track(start=corners, now=corners, grey=grey)


def _shrink(frame: NDArray[np.uint8]) -> Grey:
    grey = cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY)
    factor = VIDEO.small / max(grey.shape)
    small = grey if factor >= 1 else cv2.resize(grey, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)
    return np.asarray(small, np.uint8)


@contextmanager
def _opened(clip: Path) -> Iterator[cv2.VideoCapture]:
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", SILENT)
    video = cv2.VideoCapture(str(clip.resolve()))  # a relative path may begin as a protocol does
    try:
        if not video.isOpened():
            raise InputError(f"{clip}: the video cannot be opened, expected MP4, MOV, AVI, MKV or WebM")
        yield video
    finally:
        video.release()


def _read(
    video: cv2.VideoCapture, numbers: list[int] | None = None, *, every: int = 1
) -> Iterator[tuple[int, NDArray[np.uint8]]]:
    """Read numbers and frames (H, W, 3) BGR: the frames of given numbers, or one of every so many."""
    wanted = None if numbers is None else set(numbers)
    number = 0
    while video.grab():  # seeking would be quicker, and lands elsewhere in many files
        if number % every == 0 if wanted is None else number in wanted:
            is_read, frame = video.retrieve()
            if is_read:
                yield number, np.asarray(frame, np.uint8)
        number += 1
