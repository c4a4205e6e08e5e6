"""The plant before edits, stored in the result, so that `mvseg correct` need not detect again.

It holds only for the same version of mvseg and of torch, options, photos and cameras (see `RecordedRun.changes`).
"""

from __future__ import annotations

import io
import zipfile
import zlib
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import torch

from mvseg.findings.finding import Finding
from mvseg.masks import Masks
from mvseg.matching.result import Matching, MatchReport
from mvseg.pipeline.open_scene import Opened
from mvseg.pipeline.plant import Plant
from mvseg.reconstruction.surface.leaf_surface import LeafSurface
from mvseg.reconstruction.surface.surface_cache import ORIENTED, Approach
from mvseg.regions import Regions
from mvseg.results.result import Instances
from mvseg.verification.choose import RejectedCandidate

MOST_BYTES = 1 << 29  # limit: of the file, inflated: a stranger's file must not fill the memory
FIELDS = (
    "matching", "instances", "proposals", "matched", "image_size", "boxes", "rejected", "agreement", "keys",
    "disagreement",
)  # fmt: skip
# All that may be in the file: data without any code of its own, as a result may come from anybody.
CLASSES: list[Any] = [
    Approach, Finding, Instances, LeafSurface, RejectedCandidate, MatchReport, Masks, Matching, Regions
]  # fmt: skip


def pack_plant(plant: Plant, findings: Sequence[Finding]) -> bytes | None:
    """Pack a plant before edits, its surfaces, and the warnings on the way; None where it is too large to be read."""
    packed = io.BytesIO()
    opened = plant.opened
    torch.save(
        {
            "views": opened.names,
            "plant": {name: getattr(plant, name) for name in FIELDS},
            "cache": {name: each for name, each in opened.cache.items() if not name.startswith(ORIENTED)},
            "said": list(findings),
        },
        packed,
    )
    return zlib.compress(packed.getvalue(), 1) if packed.tell() <= MOST_BYTES else None


def unpack_plant(content: bytes, opened: Opened) -> tuple[Plant, list[Finding]] | None:
    """Unpack the content of `pack_plant`, on the CPU, for the opened scene, and the warnings. None: other views, or
    broken."""
    try:
        inflated = zlib.decompressobj().decompress(content, MOST_BYTES + 1)
        if len(inflated) > MOST_BYTES:
            return None
        with zipfile.ZipFile(io.BytesIO(inflated)) as inner:  # whose records torch never compresses
            if sum(each.file_size for each in inner.infolist()) > MOST_BYTES:
                return None
        with torch.serialization.safe_globals(CLASSES):
            packed = torch.load(io.BytesIO(inflated), map_location="cpu", weights_only=True)
        if packed["views"] != opened.names:
            return None
        return Plant(opened=replace(opened, cache=packed["cache"]), **packed["plant"]), packed["said"]
    except Exception:  # zlib and torch raise many kinds at broken files
        return None
