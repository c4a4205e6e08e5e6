"""CPU seconds and memory of a run by stage: `make bench`, or `python -m benchmarks.speed [SCENE...] [--previous DIR]`

Each run is `mvseg infer` from photos, in a process of its own. Without scenes, plants are simulated: of a species that
the detector knows, in 12, 20 and 46 photos, and with --skins (a folder of leaves that were cut out) of one that it does
not know, seen from so near that it looks at several sizes, and learns. With --previous, another checkout of mvseg takes
turns with this one: "a / b" is this one and that one; and whether both found the same masks with the same ids is said.
The first scene runs with each number of --threads, all others with one. The tables are printed, and written between
their marks in the page --into.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from benchmarks.skins import list_skins
from benchmarks.unruly_plants import ZOOM, write_unruly

ROOT = Path(__file__).parents[2]
PHOTOS = (12, 20, 46)
SHOWN = ("imports", "load", "detect", "match", "choose", "learn", "surfaces", "check", "measure", "write")


def make_scenes(folder: Path, skins: Path | None) -> list[Path]:
    """Scenes of a known species, and with skins of an unknown one; those that lie in the folder stay."""
    scenes = []
    for kind, cut_out, zoom in (("known", (), 1.0), ("unknown", list_skins(skins), ZOOM)):
        for photos in PHOTOS if kind == "known" or cut_out else ():
            scenes.append(folder / f"{kind}-{photos}")
            if not (scenes[-1] / "cameras.json").is_file():
                write_unruly(scenes[-1], "ovate", 18, num_views=photos, seed=181, skins=cut_out, zoom=zoom)
    return scenes


def measure(scene: Path, checkout: Path, *, threads: int) -> dict[str, Any]:
    """One run with the mvseg of a checkout."""
    limits = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "OPENCV_FOR_THREADS_NUM"), str(threads))
    environment = os.environ | limits | {"PYTHONPATH": str(checkout), "OMP_WAIT_POLICY": "passive"}
    command = [sys.executable, "-P", str(Path(__file__).with_name("measure.py")), str(scene.resolve())]
    done = subprocess.run(command, env=environment, cwd=checkout, capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(f"{scene}: {done.stderr[-2000:]}")
    record: dict[str, Any] = json.loads(done.stdout)
    record["CPU"] = sum(seconds for seconds, _ in record["stages"].values())
    record["GB"] = max(peak for _, peak in record["stages"].values())
    print(f"{scene.name}, {checkout.name}, {threads} threads: {record['CPU']:.1f} s", file=sys.stderr, flush=True)
    return record


def stage_lines(runs: dict[str, list[dict[str, Any]]]) -> list[str]:
    """Markdown: of each scene CPU seconds by stage, and below them peak memory."""
    lines = [f"| | {' | '.join(SHOWN)} | all | same |", "|---" * (len(SHOWN) + 3) + "|"]
    for scene, versions in runs.items():
        same = "" if len(versions) < 2 else "yes" if versions[0]["found"] == versions[1]["found"] else "no"
        for unit, place, digits in (("CPU s", 0, 1), ("GB", 1, 2)):
            cells = [
                " / ".join(f"{each['stages'].get(stage, (0, 0))[place]:.{digits}f}" for each in versions)
                for stage in SHOWN
            ]
            whole = " / ".join(f"{each[unit.split()[0]]:.{digits}f}" for each in versions)
            lines.append(f"| {scene}, {unit} | {' | '.join(cells)} | {whole} | {same if place == 0 else ''} |")
    return lines


def thread_lines(runs: dict[int, list[dict[str, Any]]]) -> list[str]:
    """Markdown: CPU and wall seconds of a run with each number of threads."""
    lines = ["| threads | CPU s | wall s |", "|---|---|---|"]
    for threads, versions in runs.items():
        cpu, wall = (" / ".join(f"{each[name]:.1f}" for each in versions) for name in ("CPU", "wall"))
        lines.append(f"| {threads} | {cpu} | {wall} |")
    return lines


def write_between(page: str, lines: list[str], *, name: str) -> str:
    """The page with these lines between its two marks of that name.

    Raises:
        ValueError: the page does not have each mark once.
    """
    begin, end = (f"<!-- {side}: benchmarks.speed, {name} -->" for side in ("begin", "end"))
    if page.count(begin) != 1 or page.count(end) != 1:
        raise ValueError(f"expected '{begin}' and '{end}' once each on the page")
    head, rest = page.split(begin)
    return "\n".join((head + begin, "", *lines, "", end)) + rest.split(end)[1]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", type=Path, nargs="*", help="folders with photos and cameras")
    parser.add_argument("--previous", type=Path, help="another checkout of mvseg, which takes turns with this one")
    parser.add_argument("--skins", type=Path, help="folder of leaves that were cut out, for an unknown species")
    parser.add_argument("--cache", type=Path, help="folder for the simulated scenes")
    parser.add_argument("--threads", type=int, nargs="+", default=[1], help="of the first scene")
    parser.add_argument("--into", type=Path, help="page that the tables are written into")
    args = parser.parse_args()
    checkouts = [ROOT] + ([args.previous.resolve()] if args.previous else [])
    with tempfile.TemporaryDirectory() as scratch:
        scenes = args.scenes or make_scenes(args.cache or Path(scratch), args.skins)
        runs = {scene: [measure(scene, each, threads=1) for each in checkouts] for scene in scenes}
        threads = {
            number: runs[scenes[0]] if number == 1 else [measure(scenes[0], each, threads=number) for each in checkouts]
            for number in args.threads
        }
    tables = {"stages": stage_lines({scene.name: of_scene for scene, of_scene in runs.items()})}
    tables |= {"threads": thread_lines(threads)} if len(threads) > 1 else {}
    for name, lines in tables.items():
        print("\n".join([*lines, ""]))
        if args.into:
            page = write_between(args.into.read_text(encoding="utf-8"), lines, name=name)
            args.into.write_text(page, encoding="utf-8")


if __name__ == "__main__":
    main()
