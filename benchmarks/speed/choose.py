"""How long the views take to choose leaves: `python -m benchmarks.speed.choose SCENE ... [--previous DIR]`

The scenes have photos and cameras. Each run is a process of its own with one thread, which detects and matches first
(detections are kept in a cache while the command runs); `choose_leaves` alone is timed, in CPU seconds. With --previous
another checkout of mvseg takes turns with this one. Also said: whether both chose the same masks with the same ids, and
the largest difference between their probabilities.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
import warnings
from pathlib import Path
from typing import Any

import numpy as np


def time_choice(folder: Path, cache: Path) -> dict[str, Any]:
    """CPU seconds, the ids of the chosen masks by view and box, and the probabilities of the leaves."""
    import torch

    from mvseg.detection.cached_detections import CachedDetections
    from mvseg.detection.detect_scene import detect_scene
    from mvseg.detection.numbers import DETECTION
    from mvseg.formats.photos import Photos
    from mvseg.formats.scene_folder import load_scene
    from mvseg.verification.choose import choose_leaves

    torch.set_num_threads(1)
    scene = load_scene(folder)
    look = detect_scene(Photos(scene), cache=CachedDetections(cache))
    more = look.match(scene.cameras, DETECTION.more_score).masks
    proposals, begun = look.proposals(scene.cameras), time.process_time()
    leaves = choose_leaves(look.sure.masks, proposals, cameras=scene.cameras, more=(more,))
    seconds, masks = time.process_time() - begun, leaves.masks
    rows = torch.cat((masks.view_index[:, None], masks.regions.boxes, masks.instance_ids[:, None]), 1)
    return {"seconds": seconds, "masks": rows.tolist(), "chances": list(leaves.probabilities.values())}


def run_choice(folder: Path, checkout: Path, cache: Path) -> dict[str, Any]:
    """`time_choice` with the mvseg of a checkout."""
    from benchmarks.speed.__main__ import make_environment

    command = [sys.executable, __file__, str(folder), "--once", str(cache)]
    environment = make_environment(checkout, threads=1)
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(f"{folder}: {done.stderr[-2000:]}")
    record: dict[str, Any] = json.loads(done.stdout)
    return record


def compare(first: dict[str, Any], second: dict[str, Any]) -> str:
    """What two versions chose, in words."""
    if first["masks"] != second["masks"]:
        return "other masks or ids"
    apart = np.abs(np.subtract(first["chances"], second["chances"])).max(initial=0)
    return f"the same masks and ids, probabilities within {apart:.1g}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", type=Path, nargs="+")
    parser.add_argument("--previous", type=Path, help="another checkout of mvseg, which takes turns with this one")
    parser.add_argument("--rounds", type=int, default=2, help="of all versions; the figures are medians")
    parser.add_argument("--once", type=Path, help=argparse.SUPPRESS)
    args = parser.parse_args()
    warnings.simplefilter("ignore")
    if args.once:
        print(json.dumps(time_choice(args.scenes[0], args.once)))
        return
    versions = {"now": Path(__file__).parents[2]} | ({"previous": args.previous.resolve()} if args.previous else {})
    for folder in args.scenes:
        with tempfile.TemporaryDirectory() as scratch:
            caches = {name: Path(scratch) / name for name in versions}  # a cache keeps what one version detected
            runs = [
                {name: run_choice(folder, checkout, caches[name]) for name, checkout in versions.items()}
                for _ in range(args.rounds)
            ]
        seconds = {name: float(np.median([run[name]["seconds"] for run in runs])) for name in versions}
        line = ", ".join(f"{name} {value:.1f} s" for name, value in seconds.items())
        if args.previous:
            ratio = seconds["previous"] / seconds["now"]
            line += f", {ratio:.2f} times as fast; {compare(runs[0]['now'], runs[0]['previous'])}"
        print(f"{folder.name}: {line}", flush=True)


if __name__ == "__main__":
    main()
