"""Detections kept while a scene is worked on, so that a run that was cut off goes on from them.

One .safetensors file per photo, in a folder that `mvseg infer` deletes when the result is there, and that `mvseg batch`
keeps for the next batch. Its name is a hash of everything that the detections depend on: the photo, its camera, the
weights and the options. A changed photo or option gets another name, so that detections are used again only where they
would be the same.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path

import safetensors.torch
from torch import Tensor

from mvseg.scene import Scene
from mvseg.system.atomic import is_partial, write_whole

KEPT_NAME = re.compile(r"[0-9a-f]{64}\.safetensors")
FIELDS = {"boxes", "labels", "scores", "masks", "frame"}


@dataclass(frozen=True)
class KeptDetections:
    """Where the detections of a run are kept.

    Attributes:
        folder: of the files; made with the first of them.
        made_by: the detector and its options, in words that differ when any of them does.
    """

    folder: Path
    made_by: str

    def path(self, scene: Scene, view: int, box: Sequence[int] | None = None) -> Path:
        """The file for the detections in the photo of a view, or in a box (xyxy) of it; the photo must exist."""
        lens, K = scene.views[view].lens, scene.cameras.K[view].tolist()
        size = scene.cameras.sizes[view].tolist()
        camera = [None if lens is None else [lens.model_name, list(lens.params)], K, size]
        with scene.views[view].path.open("rb") as file:
            photo = hashlib.file_digest(file, "sha256").hexdigest()
        text = json.dumps([photo, camera, self.made_by, box])
        return self.folder / f"{hashlib.sha256(text.encode()).hexdigest()}.safetensors"


def write_detections(path: Path, detections: dict[str, Tensor]) -> None:
    """Keep what a detector found in one photo: float and int64 tensors on the CPU, see `run_heads`."""
    path.parent.mkdir(parents=True, exist_ok=True)
    content = safetensors.torch.save({key: value.contiguous() for key, value in detections.items()})
    write_whole(path, lambda partial: partial.write_bytes(content))


def read_detections(path: Path) -> dict[str, Tensor] | None:
    """What `write_detections` wrote, the same bits; None where there is nothing, or something else."""
    try:
        detections = safetensors.torch.load(path.read_bytes())
    except (OSError, safetensors.SafetensorError):
        return None
    return detections if detections.keys() == FIELDS else None


def delete_kept(folder: Path, *, but: Collection[str] = ()) -> None:
    """Delete the kept detections but those of the given names, and the folder if nothing else is in it."""
    if not folder.is_dir():
        return
    for path in [*folder.iterdir()]:
        if path.name in but:
            continue
        is_half = is_partial(path) and KEPT_NAME.match(path.name[1:]) is not None
        if KEPT_NAME.fullmatch(path.name) or is_half:
            path.unlink(missing_ok=True)
    if not any(folder.iterdir()):
        folder.rmdir()
