"""Detections that are kept until a result is there: the same bits back, and never for another photo or option."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from mvseg.detection import proposals as proposing
from mvseg.detection.cached_detections import (
    CachedDetections,
    claim_cache,
    delete_cached,
    describe_photo,
    encode_detections,
    read_detections,
)
from mvseg.detection.config import DetectConfig
from mvseg.detection.detect_scene import detect_scene
from mvseg.detection.numbers import DETECTION
from mvseg.errors import InputError
from mvseg.formats.photos import Photos, read_photo
from mvseg.formats.scene_folder import load_scene
from scene_folders import HEIGHT, WIDTH, edit_rig, write_image, write_scene
from warned import warns_of

FOUND = {
    "boxes": torch.rand(3, 4),
    "labels": torch.ones(3, dtype=torch.int64),
    "scores": torch.rand(3),
    "masks": torch.rand(3, 1, 28, 28),
    "frame": torch.tensor([128, 96]),
}


def keep(folder: Path) -> dict[str, torch.Tensor]:
    return CachedDetections(folder).get("a photo", lambda: encode_detections(FOUND), read_detections)


def test_the_same_bits_come_back(tmp_path: Path) -> None:
    keep(tmp_path)
    back = CachedDetections(tmp_path).get("a photo", bytes, read_detections)
    assert {key: (value.dtype, value.tolist()) for key, value in back.items()} == {
        key: (value.dtype, value.tolist()) for key, value in FOUND.items()
    }


@pytest.mark.parametrize("content", [None, b"", b"torn off", b"\x02\0\0\0\0\0\0\0{}"])
def test_what_is_broken_counts_as_absent(content: bytes | None, tmp_path: Path) -> None:
    path = tmp_path / "file.safetensors"
    if content is not None:
        path.write_bytes(content)
    assert read_detections(path) is None


def test_another_photo_or_camera_has_another_name(tmp_path: Path) -> None:
    folder = write_scene(tmp_path / "plant")
    names = []

    def note() -> None:
        names.append(str(describe_photo(Photos(load_scene(folder)), 1)))

    note()
    edit_rig(folder, 1, distortion=[0.1, 0, 0, 0, 0])
    note()
    write_image(folder / "images" / "001.png", 255 - read_photo(load_scene(folder), 2))
    note()
    assert len(set(names)) == 3
    note()
    assert names[-1] == names[-2]
    deep = np.full((HEIGHT, WIDTH, 3), 1000, np.uint16)
    write_image(folder / "images" / "001.png", deep)
    note()
    write_image(folder / "images" / "002.png", 4 * deep)  # 12 bits: they brighten the first one less
    note()
    assert len(set(names)) == 5


def test_only_what_mvseg_put_there_is_deleted(tmp_path: Path) -> None:
    kept = tmp_path / "kept"
    delete_cached(kept)
    keep(kept)
    (kept / f".{'0' * 64}.safetensors.partial").touch()
    (kept / "notes.txt").touch()
    delete_cached(kept)
    assert [path.name for path in kept.iterdir()] == ["notes.txt"]
    (kept / "notes.txt").unlink()
    delete_cached(kept)
    assert not kept.exists()


class TestClaim:
    def test_only_of_the_same_scene(self, tmp_path: Path) -> None:
        kept, scene = tmp_path / "kept", tmp_path / "a"
        with claim_cache(kept, scene) as holds_some:
            assert not holds_some
            keep(kept)
        with claim_cache(kept, scene) as holds_some:
            assert holds_some
        message = rf"kept: keeps what .* found in the photos of {scene}, not of .*b; expected another --out, or"
        with pytest.raises(InputError, match=message):
            claim_cache(kept, tmp_path / "b").__enter__()
        assert len(list(kept.glob("*.safetensors"))) == 1
        with claim_cache(kept, tmp_path / "b", overwrite=True):
            delete_cached(kept)
        assert list(tmp_path.iterdir()) == []

    def test_by_one_run_at_a_time(self, tmp_path: Path) -> None:
        with claim_cache(tmp_path / "kept", tmp_path), pytest.raises(InputError, match="another run is writing"):
            claim_cache(tmp_path / "kept", tmp_path).__enter__()

    def test_a_run_that_fails_before_leaves_nothing(self, tmp_path: Path) -> None:
        with pytest.raises(InputError), claim_cache(tmp_path / "new" / "er" / "kept", tmp_path):
            raise InputError
        assert list(tmp_path.iterdir()) == []
        (tmp_path / "kept").mkdir()
        (tmp_path / "kept" / "notes.txt").touch()
        with claim_cache(tmp_path / "kept", tmp_path):
            pass
        assert [path.name for path in (tmp_path / "kept").iterdir()] == ["notes.txt"]


def test_a_detector_that_proposes_masks_everywhere_is_bounded_and_said(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene, config = load_scene(write_scene(tmp_path / "plant", 2)), DetectConfig(min_score=0.2)
    kept = CachedDetections(tmp_path / "kept")
    everything = detect_scene(Photos(scene), config, cache=kept).proposals()
    assert everything.regions.num_per_view.min() > 2
    monkeypatch.setattr("mvseg.detection.detect_scene.DETECTION", replace(DETECTION, most_proposals=2))
    with warns_of("very_many_proposals"):
        best = detect_scene(Photos(scene), config, cache=kept).proposals()
    assert best.regions.num_per_view.tolist() == [2, 2]
    for view in range(2):
        scores = everything.detection_scores[everything.view_index == view]
        assert torch.equal(best.detection_scores[best.view_index == view], scores.sort(descending=True)[0][:2])


def test_other_code_detects_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scene, names = load_scene(write_scene(tmp_path / "plant", 2)), []
    for code in ("one", "other"):
        monkeypatch.setattr("mvseg.detection.detect_scene.code_hash", lambda code=code: code)
        cache = CachedDetections(tmp_path / "kept")
        detect_scene(Photos(scene), DetectConfig(min_score=0.2), cache=cache)
        delete_cached(cache.folder, but=cache.used)
        names.append({path.name for path in (tmp_path / "kept").iterdir()})
    assert [len(each) for each in names] == [2, 2]
    assert not names[0] & names[1]


def test_a_run_that_was_cut_off_goes_on_from_its_detections(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scene, keep = load_scene(write_scene(tmp_path / "plant", 2)), tmp_path / "kept"
    config = DetectConfig(min_score=0.2)
    whole = detect_scene(Photos(scene), config).sure.masks
    assert len(whole.regions)
    ran: list[tuple[int, ...]] = []
    run_heads = proposing.run_heads

    def count(model: object, photo: torch.Tensor, **options: object) -> dict[str, torch.Tensor]:
        ran.append(tuple(photo.shape))
        if len(ran) == 2:
            raise KeyboardInterrupt
        return run_heads(model, photo, **options)  # type: ignore[arg-type]

    monkeypatch.setattr(proposing, "run_heads", count)
    with pytest.raises(KeyboardInterrupt):
        detect_scene(Photos(scene), config, cache=CachedDetections(keep))
    assert len(list(keep.iterdir())) == 1
    resumed = detect_scene(Photos(scene), config, cache=CachedDetections(keep)).sure.masks
    assert len(ran) == 2 + 1  # the first photo was not looked at again
    assert torch.equal(resumed.regions.crops, whole.regions.crops)
    assert torch.equal(resumed.detection_scores, whole.detection_scores)
    assert torch.equal(resumed.instance_ids, whole.instance_ids)
    other = CachedDetections(keep)
    detect_scene(Photos(scene), DetectConfig(min_score=0.04), cache=other)
    assert len(ran) == 2 + 1 + 2
    delete_cached(keep, but=other.used)
    assert len(list(keep.iterdir())) == 2  # those of other options are gone
