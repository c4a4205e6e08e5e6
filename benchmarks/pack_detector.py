"""From a training run to a folder of the zoo: `python -m benchmarks.pack_detector RUN FOLDER [IMAGE_SIZE]`."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import shutil
import sys
from pathlib import Path

from mvseg.detectors.weights_file import encode_weights, read_weights
from mvseg.detectors.zoo import HASH, WEIGHTS
from mvseg.errors import InputError
from mvseg.system.atomic import write_text_whole, write_whole


def pack_detector(run: Path, folder: Path, image_size: int | None = None) -> None:
    """Make a zoo folder from a training run: half-precision weights, hash, recipe and metrics; the card is yours.

    Args:
        run: output folder of the run.
        folder: of the detector's name; made when missing. A card.md in it stays.
        image_size: longer side, in pixels, that photos are scaled to from now on; None for that of the training.

    Raises:
        InputError: the run has no weights, metrics or config yet, or the folder cannot be made.
    """
    if image_size is not None and image_size < 32:
        raise InputError(f"image_size is {image_size}, expected at least 32")
    for name in ("model.safetensors", "metrics.json", "config.yaml"):
        if not (run / name).is_file():
            raise InputError(f"{run / name}: is missing, expected the output of a training run")
    state, description = read_weights(run / "model.safetensors")
    if description is None:
        raise InputError(f"{run / 'model.safetensors'}: does not say what it holds, expected a training run's file")
    if image_size is not None:
        description = dataclasses.replace(description, image_size=image_size)
    halves = {key: value.half() if value.is_floating_point() else value for key, value in state.items()}
    content = encode_weights(halves, description)
    try:
        best = json.loads((run / "metrics.json").read_text(encoding="utf-8"))["best"]
    except (ValueError, KeyError) as error:
        raise InputError(f"{run / 'metrics.json'}: has no 'best', expected the file of a training run") from error
    try:
        (folder / "recipe").mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{folder}: cannot be made ({error.strerror}), expected a folder") from error
    write_whole(folder / WEIGHTS, lambda partial: partial.write_bytes(content))
    write_text_whole(folder / "metrics.json", json.dumps({"validation": best}, indent=1) + "\n")
    write_whole(folder / "recipe" / "train.yaml", lambda partial: shutil.copyfile(run / "config.yaml", partial))
    # last: without it the folder is no entry
    write_text_whole(folder / HASH, f"{hashlib.sha256(content).hexdigest()}  {WEIGHTS}\n")


if __name__ == "__main__":
    pack_detector(Path(sys.argv[1]), Path(sys.argv[2]), *(int(size) for size in sys.argv[3:]))
