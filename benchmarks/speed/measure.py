"""One run, measured: `python benchmarks/speed/measure.py SCENE`; it runs the mvseg that PYTHONPATH leads to.

Prints JSON: {stage: [CPU seconds, peak GB]}, wall seconds, and what was found, so that versions can be compared.
"""

from __future__ import annotations

import argparse
import json
import re
import sys
import time
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stdout
from pathlib import Path
from tempfile import TemporaryDirectory

from mvseg.system import running

STAGES: dict[str, list[float]] = {}
TIMED = running.timed


@contextmanager
def measured(stage: str) -> Iterator[None]:
    """`timed`, with CPU seconds and the peak memory of the stage (Linux)."""
    Path("/proc/self/clear_refs").write_text("5", encoding="ascii")  # forgets the peak so far
    begun = time.process_time()
    with TIMED(stage):
        yield
    seconds, peak = STAGES.get(stage, (0.0, 0.0))
    now = re.findall(r"VmHWM:\s+(\d+) kB", Path("/proc/self/status").read_text(encoding="ascii"))
    STAGES[stage] = [seconds + time.process_time() - begun, max(peak, int(now[0]) / 2**20)]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=Path)
    args = parser.parse_args()
    wall, begun = time.perf_counter(), time.process_time()
    running.timed = measured  # before the stages take it from there
    import mvseg.pipeline.learn  # noqa: F401
    from mvseg.cli import main as run

    STAGES["imports"] = [time.process_time() - begun, 0.0]
    with TemporaryDirectory() as place, warnings.catch_warnings(), redirect_stdout(sys.stderr):
        warnings.simplefilter("ignore")
        out = Path(place) / "result"
        run(["infer", str(args.scene), "--out", str(out), "--num_workers", "1"])
        found = json.loads((out / "instances.json").read_text(encoding="utf-8"))["annotations"]
    print(json.dumps({"stages": STAGES, "wall": time.perf_counter() - wall, "found": found}))


if __name__ == "__main__":
    main()
