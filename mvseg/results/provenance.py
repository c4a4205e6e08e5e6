"""Where a result comes from, for run.json."""

from __future__ import annotations

import platform
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch

from mvseg._version import made_by
from mvseg.config import RunConfig
from mvseg.results.result import Result
from mvseg.system.file_hash import hash_files


def describe_run(
    result: Result, masks: Path | None, config: RunConfig, *, messages: Sequence[str] = ()
) -> dict[str, Any]:
    """Version, inputs with their SHA-256, resolved options, warnings.

    Args:
        result: what the run produced.
        masks: the masks that were given; None where a detector found them: its weights are hashed instead.
        config: of the run; options of stages that did not run are left out.
        messages: the warnings of the run.
    """
    options = asdict(config)
    if masks is not None:
        del options["detect"]
    if config.reconstruct is None:
        for name in ("reconstruct", "traits", "scale", "unit", "up", "color_card"):
            del options[name]
    if masks is None:
        from mvseg.detectors.zoo import weights_path  # loads torchvision

    sources = [result.scene.source, masks or weights_path(config.detect.weights)]
    corrections = None if result.corrections is None else result.corrections.source
    if corrections is not None:
        sources.append(corrections)
        options["corrections"] = str(corrections)
    return {
        **made_by(),
        "torch": torch.__version__,
        "python": platform.python_version(),
        "scene": result.scene.name,
        "inputs": {str(path): hash_files(path) for path in sources if path is not None},
        "config": {"masks": masks and str(masks)} | options,
        "mask_kind": result.mask_kind or None,
        "warnings": list(messages),
    }
