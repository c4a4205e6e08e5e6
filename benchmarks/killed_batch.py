"""Does a batch that is killed again and again end as one that was not? `python benchmarks/killed_batch.py --folder DIR`

24 simulated plants of 3 leaves in 5 photos of 240 x 240 pixels at three time points, 20 with given masks, 4 from their
pixels. One batch runs undisturbed; another is killed at random moments (kill -9 and SIGTERM in turn) and resumed each
time. After every kill each result must be absent or whole, after SIGTERM nothing half-written may be left, and no
process either. In the end all traits, as CSV and as Parquet, must be those of the first batch, byte by byte.
"""

from __future__ import annotations

import argparse
import csv
import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

from mvseg.results.run_record import load_run
from mvseg.simulation.dataset import Preset, list_scenes, write_dataset
from mvseg.system.file_hash import hash_files

ROOT = Path(__file__).parents[1]
NIGHT = Preset(plants=(("night", 24),), leaves=(3,), views=(5,), size=(240, 240))
FROM_PIXELS = 4
ENDED = {signal.SIGKILL: (-signal.SIGKILL,), signal.SIGTERM: (143, -signal.SIGTERM)}  # -SIGTERM: before mvseg began


def write_table(folder: Path) -> Path:
    """The plants, and the table of the batch."""
    write_dataset(NIGHT, folder / "plants")
    rows = []
    for number, spec in enumerate(list_scenes(NIGHT, 0)):
        masks = "" if number < FROM_PIXELS else "masks"
        rows.append((f"plants/{spec.folder}", spec.family, f"day {number // 8}", masks))
    with (folder / "night.csv").open("w", newline="", encoding="utf-8") as file:
        csv.writer(file).writerows([("scene", "plant", "time", "masks"), *rows])
    return folder / "night.csv"


def start(table: Path, out: Path, num_workers: int) -> subprocess.Popen[bytes]:
    words = [sys.executable, "-m", "mvseg.cli", "batch", str(table), "--out", str(out), "--resume", "true", "--quiet"]
    words += ["--num_workers", str(num_workers)]
    path = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
    return subprocess.Popen(words, env=os.environ | {"PYTHONPATH": path}, start_new_session=True)


def check(out: Path, *, was_killed: bool) -> int:
    """How many results are there, all whole."""
    results = [path.parent for path in out.glob("[!._]*/run.json")]
    for result in results:
        listed = load_run(result).files
        assert {name: hash_files(result / name) for name in listed} == listed, result
    whole = {path.name for path in results} | {"_batch"}
    others = [path.name for path in out.iterdir() if path.name not in whole]
    assert all(was_killed and name.endswith(".partial") for name in others), others
    return len(results)


def is_session_over(session: int) -> bool:
    """Whether no process is left of those that a batch started, at the latest ten seconds after its end."""
    for _ in range(100):
        try:
            os.killpg(session, 0)
        except ProcessLookupError:
            return True
        time.sleep(0.1)
    return False


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--folder", type=Path, required=True, help="for plants and results; plants are made once")
    parser.add_argument("--kills", type=int, default=10)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--seed", type=int, default=0, help="of the moments")
    args = parser.parse_args()
    args.folder.mkdir(parents=True, exist_ok=True)
    table, rng = write_table(args.folder), random.Random(args.seed)
    begun = time.monotonic()
    assert start(table, args.folder / "undisturbed", args.workers).wait() == 0
    seconds = time.monotonic() - begun
    print(f"undisturbed: {seconds:.0f} s", flush=True)
    out, num_killed = args.folder / "killed", 0
    for number in range(args.kills):
        kind, delay = (signal.SIGKILL, signal.SIGTERM)[number % 2], rng.uniform(0, 0.4 * seconds)
        batch = start(table, out, args.workers)
        time.sleep(delay)
        batch.send_signal(kind)
        code = batch.wait()
        assert code in (*ENDED[kind], 0), code
        num_killed += code != 0
        assert is_session_over(batch.pid)
        there = check(out, was_killed=kind == signal.SIGKILL) if out.is_dir() else 0
        print(f"{kind.name} after {delay:.1f} s: exit code {code}, {there} results", flush=True)
    assert start(table, out, args.workers).wait() == 0
    names = sorted(path.name for path in (args.folder / "undisturbed" / "tables").glob("traits*"))
    for name in names:
        first, second = (args.folder / batch / "tables" / name for batch in ("undisturbed", "killed"))
        assert first.read_bytes() == second.read_bytes(), name
    print(f"{num_killed} of {args.kills} kills came before the end; the same bytes in {', '.join(names)}")


if __name__ == "__main__":
    main()
