"""Sharp frames of a video, evenly spread by motion, as photos.

Corners are followed from frame to frame (Lucas and Kanade's optical flow in a pyramid), and how far they have moved in
the picture says how far the camera has come. Where it stands still, frames would be equal; where it runs, they are few.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from mvseg.arrays import Floats
from mvseg.errors import InputError, warn
from mvseg.findings.finding import Finding
from mvseg.poses.numbers import STRUCTURE, VIDEO
from mvseg.system.running import progress_bar

Grey = NDArray[np.uint8]

VIDEO_SUFFIXES = (".mp4", ".mov", ".m4v", ".3gp", ".avi", ".mkv", ".webm")
SILENT = "-8"  # of FFmpeg's log, which is for its developers


@dataclass(frozen=True, eq=False)
class Footage:
    """Motion in every frame, or in every second or third one.

    Attributes:
        frames: (F,) int64, numbers of the frames in the video, from 0.
        motion: (F,) how far the picture has moved since the first frame, in longer sides of it; it never falls.
        sharpness: (F,) variance of the Laplacian.
        share: part of the file's seconds that could be read.
    """

    frames: NDArray[np.int64]
    motion: Floats
    sharpness: Floats
    share: float = 1.0


def is_video(path: Path) -> bool:
    """Whether a path is a file with a video's suffix."""
    return path.is_file() and path.suffix.lower() in VIDEO_SUFFIXES


def write_frames(clip: Path, folder: Path, numbers: Sequence[int]) -> list[str]:
    """Write frames of a video, by their numbers from 0, into a new folder as JPEG, upright; returns their names, in
    order of time. Raises InputError if the video cannot be opened."""
    folder.mkdir(parents=True)
    names = []
    with _opened(clip) as video:
        for number, frame in _read(video, {*numbers}.__contains__):
            names.append(frame_name(number))
            if not cv2.imwrite(str(folder / names[-1]), frame, [cv2.IMWRITE_JPEG_QUALITY, STRUCTURE.quality]):
                raise OSError(f"{folder / names[-1]} cannot be written")
    return names


def frame_name(number: int) -> str:
    """Name of the photo that a frame becomes."""
    return f"frame-{number:06d}.jpg"


def watch(clip: Path) -> Footage:
    """Measure motion and sharpness over a video, in `VIDEO.per_second` frames of each second. Warns (InputWarning) of a
    video that ends early: it is cut short or damaged, or the first of its streams is shorter. Raises InputError if the
    video cannot be opened, or has no frames."""
    rows: list[tuple[int, float, float, float]] = []
    with _opened(clip) as video, progress_bar(name="video", unit="frame") as bar:
        rate = video.get(cv2.CAP_PROP_FPS)
        every = max(1, round(rate / VIDEO.per_second)) if 0 < rate < 1000 else 1
        # the bit rate, rounded down, is the file's: of the seconds of its longest stream; counts of frames may lie
        kilobits = video.get(cv2.CAP_PROP_BITRATE)
        seconds = clip.stat().st_size * 8e-3 / (kilobits + 1) if kilobits > 0 else 0.0
        if clip.suffix.lower() == ".avi" and rate > 0:  # the index is at the end; nothing is hidden by trimming
            seconds = max(seconds, video.get(cv2.CAP_PROP_FRAME_COUNT) / rate)
        track, base = None, 0.0
        for number, frame in _read(video, lambda number: number % every == 0):
            grey = _shrink(frame)
            track, moved, gone = _follow(track, grey)
            motion = max(base + moved, rows[-1][1] if rows else 0.0)
            time = video.get(cv2.CAP_PROP_POS_MSEC) / 1000
            rows.append((number, motion, float(cv2.Laplacian(grey, cv2.CV_64F).var()), time))
            base += gone
            bar.update(1)
    if not rows:
        raise InputError(f"{clip}: no frame of the video can be read, expected MP4, MOV, 3GP, AVI, MKV or WebM")
    frames, moves, sharpness, times = map(np.array, zip(*rows, strict=True))
    share = float(times[-1] + np.diff(times).max(initial=1 / max(rate, 1))) / seconds if seconds else 1.0
    if share < VIDEO.whole:
        warn(Finding("film_ends_early", clip.name, {"share": share}))
    return Footage(frames=frames, motion=moves, sharpness=sharpness, share=share)


def check_motion(clip: Path, footage: Footage, chosen: Sequence[int]) -> None:
    """Raises InputError: the frames that were chosen are too few, as the picture moves too little."""
    if not footage.sharpness.any():  # as OpenCV 5.0 reads interlaced films
        raise InputError(f"{clip}: frames show one colour, expected a film that is not interlaced (ffmpeg -vf bwdif)")
    if len(chosen) < STRUCTURE.least:
        moved, wanted = footage.motion[-1], STRUCTURE.least * VIDEO.step
        message = f"the picture moves by {moved:.0%} of its longer side in {len(footage.frames)} frames"
        if footage.share < VIDEO.whole:
            message += f" ({footage.share:.0%} of the film; no more can be read)"
        raise InputError(f"{clip}: {message}, expected {wanted:.0%} or more: a walk round the plant")


def choose_frames(footage: Footage, *, most: int) -> list[int]:
    """Numbers of frames that are about `VIDEO.step` (or a `most`-th of all motion, if that is more) apart. The motion
    is cut into equal parts, and the sharpest frame in the middle half of each is taken: two in a row are half a part to
    one and a half parts apart, where the video has frames there."""
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


def fill_gaps(footage: Footage, chosen: Sequence[int], registered: Collection[int], *, most: int) -> list[int]:
    """Add to the chosen frames, in ascending order, one in the middle of each gap of which an end did not register:
    photos there join the others. At most `most` in all; the widest gaps first, by motion."""
    middles = []
    for before, after in pairwise(chosen):
        inside = np.flatnonzero((footage.frames > before) & (footage.frames < after))
        if len(inside) and not (before in registered and after in registered):
            ends = np.interp((before, after), footage.frames, footage.motion)
            middle = inside[np.abs(footage.motion[inside] - ends.mean()).argmin()]
            middles.append((float(ends[0] - ends[1]), int(footage.frames[middle])))
    return sorted({*chosen, *(number for _, number in sorted(middles)[: max(most - len(chosen), 0)])})


@dataclass(frozen=True, eq=False)
class _Track:
    """Corners that are followed: where they were found, where they are (C, 1, 2) float32, and the picture there."""

    start: NDArray[np.float32]
    now: NDArray[np.float32]
    grey: Grey


def _follow(track: _Track | None, grey: Grey) -> tuple[_Track, float, float]:
    """Corners in the next picture; their motion since found, and what of it to add to all later, in longer sides."""
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
            raise InputError(f"{clip}: the video cannot be opened, expected MP4, MOV, 3GP, AVI, MKV or WebM")
        yield video
    finally:
        video.release()


def _read(video: cv2.VideoCapture, is_wanted: Callable[[int], bool]) -> Iterator[tuple[int, NDArray[np.uint8]]]:
    """Numbers and frames (H, W, 3) BGR, in square pixels, of wanted numbers; smeared ones are left out."""
    number = num_failed = 0
    is_smeared = False
    while num_failed < VIDEO.damaged:
        if not video.grab():  # seeking would be quicker, and lands elsewhere in many files
            num_failed, is_smeared = num_failed + 1, True
            continue
        num_failed = 0
        is_smeared = is_smeared and int(video.get(cv2.CAP_PROP_FRAME_TYPE)) != ord("I")
        if not is_smeared and is_wanted(number):
            is_read, frame = video.retrieve()
            if is_read:
                yield number, square_pixels(np.asarray(frame, np.uint8), *_aspect(video))
        number += 1


def _aspect(video: cv2.VideoCapture) -> tuple[float, float]:
    width, height = video.get(cv2.CAP_PROP_SAR_NUM), video.get(cv2.CAP_PROP_SAR_DEN)
    if width <= 0 or height <= 0:
        return 1.0, 1.0
    is_turned = int(video.get(cv2.CAP_PROP_ORIENTATION_META)) % 180 == 90 and video.get(cv2.CAP_PROP_ORIENTATION_AUTO)
    return (height, width) if is_turned else (width, height)


def square_pixels(frame: NDArray[np.uint8], width: float, height: float) -> NDArray[np.uint8]:
    """A frame (H, W, 3) whose pixels are `width` x `height`, in square ones; the shorter side of a pixel stays."""
    least = min(width, height)
    size = round(frame.shape[1] * width / least), round(frame.shape[0] * height / least)
    return frame if size == frame.shape[1::-1] else np.asarray(cv2.resize(frame, size), np.uint8)
