"""Detections cached while a scene is worked on, so that a run that was cut off goes on from them.

One .safetensors file per photo, in a folder that `mvseg infer` deletes when the result is there, and that `mvseg batch`
keeps for the next batch. Its name is a hash of everything that the detections depend on: the photo, its camera, the
weights and the options. A hidden file says whose photos they are of.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import safetensors.torch
from torch import Tensor

from mvseg.errors import InputError
from mvseg.formats.photos import Photos, photo_bits
from mvseg.system.atomic import is_partial, lock_folder, write_whole

CACHED_NAME = re.compile(r"(learned-)?[0-9a-f]{64}\.safetensors")
SCENE_FILE = ".scene"
FIELDS = {"boxes", "labels", "scores", "masks", "frame"}
T = TypeVar("T")


@dataclass(frozen=True, eq=False)
class CachedDetections:
    """Cache of the detections of a run: its folder, made with the first file, and the names of the files that this run
    has `used`; the others are of other photos, detectors or options."""

    folder: Path
    used: set[str] = field(default_factory=set)

    def get(
        self, made_from: Any, compute: Callable[[], bytes], read: Callable[[Path], T | None], *, kind: str = ""
    ) -> T:
        """Read what follows from `made_from` alone, which JSON can write, from its file; where `read` gives None, the
        file is written first, with the content that is computed."""
        path = self.folder / f"{kind}{hashlib.sha256(json.dumps(made_from).encode()).hexdigest()}.safetensors"
        self.used.add(path.name)
        if (answer := read(path)) is None:
            content = compute()
            path.parent.mkdir(parents=True, exist_ok=True)
            write_whole(path, lambda partial: partial.write_bytes(content))
            answer = read(path)
            assert answer is not None, f"expected {path.name} as it was written"
        return answer


def describe_photo(photos: Photos, view: int) -> list[Any]:
    """All that the undistorted photo of a view depends on."""
    scene = photos.scene
    lens, K = scene.views[view].lens, scene.cameras.K[view].tolist()
    camera = [None if lens is None else [lens.model_name, list(lens.params)], K, scene.cameras.sizes[view].tolist()]
    return [photos.sha256(view), photo_bits(scene, view), camera]


def encode_detections(detections: dict[str, Tensor]) -> bytes:
    """Content of the file for the detections of one photo: float and int64 tensors, see `run_heads`."""
    return safetensors.torch.save({key: value.cpu().contiguous() for key, value in detections.items()})


def read_detections(path: Path) -> dict[str, Tensor] | None:
    """Read detections, the same bits, on the CPU; None where there is nothing, or something else."""
    try:
        detections = safetensors.torch.load(path.read_bytes())
    except (OSError, safetensors.SafetensorError):
        return None
    return detections if detections.keys() == FIELDS else None


def delete_cached(folder: Path, *, but: Collection[str] = ()) -> None:
    """Delete all cached files except those of the given names, and the folder if it is empty then."""
    if not folder.is_dir():
        return
    for path in [*folder.iterdir()]:
        is_cached = CACHED_NAME.fullmatch(path.name) or (is_partial(path) and CACHED_NAME.match(path.name[1:]))
        if path.name not in but and (is_cached or (path.name == SCENE_FILE and not but)):
            path.unlink(missing_ok=True)
    if not any(folder.iterdir()):
        folder.rmdir()


@contextmanager
def claim_cache(folder: Path, scene: Path, *, overwrite: bool = False) -> Iterator[bool]:
    """Have the folder of cached detections of a scene for one run, which may delete it; gives whether it holds some.

    Args:
        folder: made if it is missing; deleted in the end if nothing was cached.
        overwrite: take it also when it holds what was found in another scene's photos.

    Raises:
        InputError: another run works with it, or it is another scene's.
    """
    made = [parent for parent in folder.parents if not parent.exists()]
    folder.mkdir(parents=True, exist_ok=True)
    try:
        with lock_folder(folder):
            try:
                owner, place = folder / SCENE_FILE, os.fsencode(os.path.realpath(scene))
                earlier = owner.read_bytes() if owner.is_file() else place
                if earlier != place and not overwrite:
                    why = f"keeps what a run that was cut off found in the photos of {os.fsdecode(earlier)}"
                    raise InputError(f"{folder}: {why}, not of {scene}; expected another --out, or --overwrite true")
                write_whole(owner, lambda partial: partial.write_bytes(place))
                yield _holds_some(folder)
            finally:
                if not _holds_some(folder):
                    delete_cached(folder)
    finally:
        with suppress(OSError):  # it holds some, or is another run's
            for each in (folder, *made):
                each.rmdir()


def _holds_some(folder: Path) -> bool:
    return folder.is_dir() and any(CACHED_NAME.fullmatch(path.name) for path in folder.iterdir())
