"""How often a command decodes and hashes each photo of its scene."""

from __future__ import annotations

import hashlib
from collections import Counter
from pathlib import Path
from typing import Any

import pytest
from PIL import Image

from mvseg import demo_scene
from mvseg.cli import main
from mvseg.formats import image_file

SCENE = demo_scene()


class Reads:
    """How often each photo of the shipped plant was decoded and hashed."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.decoded, self.hashed = Counter[str](), Counter[str]()
        names = {path.read_bytes(): path.name for path in sorted((SCENE / "images").iterdir())}
        self.num_photos = len(names)
        decode, sha256 = image_file.read_image, hashlib.sha256

        def read_image(path: Path, size: tuple[int, int] | None = None) -> Image.Image:
            self.decoded.update([path.name] * (path.parent.name == "images"))
            return decode(path, size)

        def count_hash(data: bytes = b"", **how: Any) -> Any:
            self.hashed.update([names[data]] if data in names else [])
            return sha256(data, **how)

        monkeypatch.setattr(image_file, "read_image", read_image)
        monkeypatch.setattr(hashlib, "sha256", count_hash)


@pytest.fixture
def reads(monkeypatch: pytest.MonkeyPatch) -> Reads:
    return Reads(monkeypatch)


@pytest.mark.parametrize("masks", [True, False])
def test_infer_decodes_and_hashes_each_photo_once(masks: bool, tmp_path: Path, reads: Reads) -> None:
    given = ["--masks", "masks"] if masks else []
    assert main(["infer", str(SCENE), *given, "--out", str(tmp_path / "out"), "--quiet"]) == 0
    assert len(reads.decoded) == len(reads.hashed) == reads.num_photos
    assert {*reads.decoded.values(), *reads.hashed.values()} == {1}


def test_check_decodes_and_hashes_each_photo_once(reads: Reads) -> None:
    main(["check", str(SCENE), "--masks", "masks", "--quiet"])
    assert len(reads.decoded) == len(reads.hashed) == reads.num_photos
    assert {*reads.decoded.values(), *reads.hashed.values()} == {1}
