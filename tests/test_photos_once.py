"""How often a command decodes and hashes each photo of its scene."""

from __future__ import annotations

import hashlib
from collections import Counter
from pathlib import Path
from typing import Any

import pytest
from PIL import Image

from mvseg.cli import main
from mvseg.formats import image_file
from scene_folders import write_scene


class Reads:
    """How often each photo of a scene was decoded and hashed."""

    def __init__(self, scene: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.scene, self.decoded, self.hashed = scene, Counter[str](), Counter[str]()
        names = {path.read_bytes(): path.name for path in sorted((scene / "images").iterdir())}
        self.num_photos = len(names)
        decode, file_digest = image_file.read_image, hashlib.file_digest

        def read_image(path: Path, size: tuple[int, int] | None = None) -> Image.Image:
            self.decoded.update([path.name] * (path.parent.name == "images"))
            return decode(path, size)

        def count_hash(file: Any, *how: Any) -> Any:
            content = Path(file.name).read_bytes()
            self.hashed.update([names[content]] if content in names else [])
            return file_digest(file, *how)

        monkeypatch.setattr(image_file, "read_image", read_image)
        monkeypatch.setattr(hashlib, "file_digest", count_hash)

    def check(self) -> None:
        assert len(self.decoded) == len(self.hashed) == self.num_photos
        assert {*self.decoded.values(), *self.hashed.values()} == {1}


@pytest.fixture
def reads(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Reads:
    return Reads(write_scene(tmp_path / "plant"), monkeypatch)


DETECTED = pytest.param(["--detect.min_score", "0.05"], marks=pytest.mark.slow)


@pytest.mark.parametrize("given", [["--masks", "masks"], DETECTED])
def test_infer_decodes_and_hashes_each_photo_once(given: list[str], tmp_path: Path, reads: Reads) -> None:
    coarse = ["--reconstruct.shape", "voxels", "--reconstruct.voxel_budget", "500"]
    out = ["--out", str(tmp_path / "out"), "--quiet"]
    assert main(["infer", str(reads.scene), *given, *coarse, *out]) == 0
    reads.check()


def test_check_decodes_and_hashes_each_photo_once(reads: Reads) -> None:
    main(["check", str(reads.scene), "--masks", "masks", "--quiet"])
    reads.check()
