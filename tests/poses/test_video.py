"""Clips that pan over a picture: where the camera is at each frame, and which frames are sharp, is known."""

from __future__ import annotations

import shutil
import subprocess
from contextlib import nullcontext
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest

from mvseg.errors import InputError
from mvseg.formats.image_file import read_rgb
from mvseg.poses.numbers import VIDEO
from mvseg.poses.video import (
    Footage,
    check_motion,
    choose_frames,
    fill_gaps,
    is_video,
    square_pixels,
    watch,
    write_frames,
)
from room_scene import texture
from warned import warns_of

WIDTH, HEIGHT = 320, 240
# It stands still, walks, runs and comes to rest: pixels of the picture at each frame.from warned import warns_of

PLACES = np.concatenate([np.zeros(12), np.arange(1, 121), 120 + np.arange(1, 21) * 4, np.full(12, 200)]).astype(int)


def write_clip(path: Path, frames: list[np.ndarray], rate: float = 15.0, codec: str = "mp4v") -> Path:
    height, width = frames[0].shape[:2]
    video = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*codec), rate, (width, height))
    assert video.isOpened()
    for frame in frames:
        video.write(frame)
    video.release()
    return path


def pan(places: np.ndarray, *, sharp_every: int = 1) -> list[np.ndarray]:
    """Parts of a picture; all frames but every so many are blurred."""
    picture = texture(0, grains=(4, 12, 40, 100))
    frames = [np.ascontiguousarray(picture[100 : 100 + HEIGHT, x : x + WIDTH]) for x in places]
    return [f if k % sharp_every == 0 else cv2.GaussianBlur(f, (0, 0), 4) for k, f in enumerate(frames)]


watch_once = cache(watch)


@pytest.fixture(scope="module")
def walk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_clip(tmp_path_factory.mktemp("clip") / "walk.mp4", pan(PLACES, sharp_every=3))


def test_motion_and_sharpness_are_measured(walk: Path) -> None:
    footage = watch_once(walk)
    assert footage.frames.tolist() == list(range(len(PLACES)))
    np.testing.assert_allclose(footage.motion * WIDTH, PLACES, atol=0.04 * PLACES[-1])
    assert (np.diff(footage.motion) >= 0).all()
    is_sharp = footage.frames % 3 == 0
    assert footage.sharpness[is_sharp].min() > footage.sharpness[~is_sharp].max()


def test_frames_are_sharp_and_spread_by_motion(walk: Path, tmp_path: Path) -> None:
    names = write_frames(walk, tmp_path / "frames", choose_frames(watch_once(walk), most=60))
    assert sorted(path.name for path in (tmp_path / "frames").iterdir()) == names
    numbers = np.array([int(name[len("frame-") : -len(".jpg")]) for name in names])
    assert (np.diff(numbers) > 0).all()
    steps = np.diff(PLACES[numbers]) / WIDTH / VIDEO.step
    assert len(names) == pytest.approx(PLACES[-1] / WIDTH / VIDEO.step, abs=2)
    assert (steps > 0.4).all()
    assert (steps < 2.1).all()
    assert (numbers[numbers < 130] % 3 == 0).all()  # where the camera runs, a step holds two frames only
    drawn = pan(PLACES, sharp_every=3)
    for name, number in zip(names, numbers, strict=True):
        photo = read_rgb(tmp_path / "frames" / name).astype(int)
        assert np.abs(photo - drawn[number][..., ::-1]).mean() < 12  # the frame of that number, after two lossy codecs


def test_fast_videos_are_looked_at_fifteen_times_a_second(tmp_path: Path) -> None:
    clip = write_clip(tmp_path / "fast.mp4", pan(np.arange(60) * 2), rate=60.0)
    footage = watch(clip)
    assert footage.frames.tolist() == list(range(0, 60, 4))
    assert footage.motion[-1] * WIDTH == pytest.approx(112, rel=0.05)


@pytest.mark.parametrize("most", [3, 7, 100])
@pytest.mark.parametrize("seed", range(3))
def test_laws_of_the_choice(most: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    motion = np.cumsum(rng.exponential(VIDEO.step / 6, 200) * (rng.random(200) < 0.8))
    footage = Footage(frames=np.arange(200) * 2, motion=motion, sharpness=rng.random(200))
    chosen = choose_frames(footage, most=most)
    assert chosen == sorted(set(chosen))
    assert set(chosen) <= set(footage.frames.tolist())
    part = motion[-1] / min(most, int(motion[-1] / VIDEO.step))
    assert len(chosen) >= 0.9 * motion[-1] / part
    assert np.diff(motion[np.array(chosen) // 2]).max() < 2 * part
    middle = np.abs(motion[:, None] / part % 1 - 0.5)[:, 0] <= 0.25
    for number in chosen:  # none in the middle of the same part is sharper
        same = middle & (motion // part == motion[number // 2] // part)
        assert footage.sharpness[number // 2] >= footage.sharpness[same].max(initial=0)


def test_gaps_are_filled_where_frames_did_not_register() -> None:
    footage = Footage(frames=np.arange(101), motion=np.linspace(0, 1, 101), sharpness=np.ones(101))
    chosen = [0, 20, 40, 60, 100]
    assert fill_gaps(footage, chosen, {*chosen}, most=60) == chosen
    assert fill_gaps(footage, chosen, {0, 20, 40}, most=60) == [0, 20, 40, 50, 60, 80, 100]
    assert fill_gaps(footage, chosen, {0, 20, 40}, most=6) == [0, 20, 40, 60, 80, 100]  # the widest first
    assert fill_gaps(footage, chosen, set(), most=60) == [0, 10, 20, 30, 40, 50, 60, 80, 100]
    assert fill_gaps(footage, [0, 1, 2], set(), most=60) == [0, 1, 2]  # no frames are between


def test_frames_of_a_video_whose_pixels_are_not_square() -> None:
    frame = np.arange(6 * 9 * 3, dtype=np.uint8).reshape(6, 9, 3)
    assert square_pixels(frame, 1, 1) is frame
    assert square_pixels(frame, 4, 3).shape == (6, 12, 3)
    assert square_pixels(frame, 2, 3).shape == (9, 9, 3)  # no pixel is lost
    np.testing.assert_array_equal(square_pixels(frame.repeat(4, 1), 8, 8), frame.repeat(4, 1))


@pytest.mark.parametrize("damage", ["cut short", "in the middle", "none"])
def test_a_film_that_ends_early_is_said(tmp_path: Path, damage: str) -> None:
    clip = write_clip(tmp_path / "walk.avi", pan(np.arange(40) * 3), codec="MJPG")
    data = bytearray(clip.read_bytes())
    if damage == "cut short":
        data = data[: len(data) // 3]
    elif damage == "in the middle":
        middle = data.index(b"00dc", len(data) // 2)
        data[middle : middle + 12] = bytes(12)
    clip.write_bytes(data)
    if damage == "cut short":
        with warns_of("film_ends_early"):
            footage = watch(clip)
        assert len(footage.frames) < 20
    else:
        assert len(watch(clip).frames) >= 37


@pytest.mark.skipif(shutil.which("ffmpeg") is None, reason="OpenCV writes plain films only")
@pytest.mark.parametrize(("options", "num"), [("-t 7 -i {0} -i {0} -map 0:v -map 1:v", 105), ("-ss 3.9 -i {0}", 105)])
def test_counts_of_frames_may_lie(walk: Path, tmp_path: Path, options: str, num: int) -> None:
    """The first of two streams is shorter; the frames before the place where a film was trimmed are in the file."""
    film = tmp_path / "film.mp4"
    subprocess.run(["ffmpeg", "-v", "error", *options.format(walk).split(), "-c", "copy", film], check=True)
    with warns_of("film_ends_early") if "map" in options else nullcontext():
        assert len(watch(film).frames) == pytest.approx(num, abs=2)


@pytest.mark.parametrize("places", [np.zeros(20, int), np.arange(20) // 2])
def test_too_little_motion_is_one_sentence(tmp_path: Path, places: np.ndarray) -> None:
    clip = write_clip(tmp_path / "still.mp4", pan(places))
    with pytest.raises(InputError, match=r"still.mp4: the picture moves by [0-3]% of its longer side in 20 f"):
        check_motion(clip, watch(clip), choose_frames(watch(clip), most=60))


def test_a_picture_without_texture_does_not_move(tmp_path: Path) -> None:
    clip = write_clip(tmp_path / "grey.mp4", [np.full((HEIGHT, WIDTH, 3), 120, np.uint8)] * 10)
    assert watch(clip).motion.tolist() == [0.0] * 10
    with pytest.raises(InputError, match=r"grey.mp4: frames show one colour, expected a film that is not interlaced"):
        check_motion(clip, watch(clip), [])


def test_a_cut_counts_as_a_step(tmp_path: Path) -> None:
    other = [np.ascontiguousarray(texture(1, grains=(4, 12, 40, 100))[:HEIGHT, :WIDTH])] * 6
    clip = write_clip(tmp_path / "cut.mp4", [*pan(np.zeros(6, int)), *other])
    motion = watch(clip).motion
    assert motion[5] < 0.01
    assert motion[6] - motion[5] >= 0.9 * VIDEO.step


@pytest.mark.parametrize("content", [b"", b"no video", b"\0\0\0\x20ftypisom" + bytes(200)])
def test_broken_videos_are_one_sentence(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "a.mp4").write_bytes(content)
    with pytest.raises(InputError, match=r"a.mp4: the video cannot be opened, expected MP4"):
        watch(tmp_path / "a.mp4")


def test_a_name_that_begins_as_a_protocol_does(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    clip = write_clip(tmp_path / "clip.mp4", pan(np.arange(10)))
    monkeypatch.chdir(tmp_path)
    assert len(watch(clip.rename("2026-05-01T10:30.mp4")).frames) == 10


def test_videos_are_files_with_their_suffixes(walk: Path, tmp_path: Path) -> None:
    (tmp_path / "b.MOV").write_bytes(b"")
    assert is_video(walk)
    assert is_video(tmp_path / "b.MOV")
    (tmp_path / "photo.jpg").write_bytes(b"")
    assert not any(is_video(tmp_path / name) for name in ("", "nowhere.mp4", "photo.jpg"))
