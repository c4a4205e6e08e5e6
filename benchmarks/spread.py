"""How much do equal runs differ? `python -m benchmarks.spread SCENE... [--worlds 3] [--dates TABLE RESULTS]`

The same plant in worlds that are turned and moved: what differs is chance, and a gain below twice this spread is none
(CONTRIBUTING.md). By scene with photos and `truth/`, mean and standard deviation over the worlds: "ids", the ARI of
given `masks/`; "pixels", MV-PQ of detected leaves (`learn.py --table --worlds` has it where the detector learns);
"corrections", MV-PQ after one answer per leaf of a simulated person. With --dates, short- and long-term accuracy of
tracks, each pot turned at random; TABLE and RESULTS are those of `benchmarks.tracking results`.
"""

from __future__ import annotations

import argparse
import warnings
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from benchmarks.checked_ids import choose_given, read_given
from benchmarks.corrections import correct, detect_case
from benchmarks.tracking import labels_of, measure, read_series, turn_date
from mvseg.config import RunConfig
from mvseg.errors import InputWarning
from mvseg.evaluation.id_metrics import matching_metrics
from mvseg.evaluation.panoptic import leaf_metrics
from mvseg.formats.rig import write_rig
from mvseg.formats.scene_folder import load_scene
from mvseg.matching.match import match_regions
from mvseg.pipeline.run_scene import run_scene
from mvseg.tracking.track import track_leaves

REACH = 2.0  # of shifts, in distances of the cameras from their middle


def write_turned(folder: Path, out: Path, seed: int) -> None:
    """The scene in another world, with its own photos, masks and truth; seed 0 is the world as it is."""
    scene = load_scene(folder)
    cameras, rng = scene.cameras, np.random.default_rng(seed)
    if seed:
        turn = torch.from_numpy(Rotation.random(random_state=seed).as_matrix())
        size = float((cameras.centers - cameras.centers.mean(0)).norm(dim=1).max())
        shift = torch.from_numpy(rng.uniform(-REACH, REACH, 3)) * size
        R = cameras.R @ turn.T
        scene = replace(scene, cameras=replace(cameras, R=R, t=cameras.t - R @ shift), up=None)
    out.mkdir(parents=True)
    for name in {"truth", "masks", *(view.path.relative_to(folder).parts[0] for view in scene.views)}:
        if (folder / name).exists():
            (out / name).symlink_to((folder / name).resolve())
    write_rig(out / "cameras.json", scene, [str(view.path.relative_to(folder)) for view in scene.views])


def measure_world(folder: Path, config: RunConfig) -> dict[str, float]:
    """All figures of a scene in one world."""
    figures = dict[str, float]()
    if (folder / "masks").exists():
        given = read_given(folder)
        matched = match_regions(given.regions, given.cameras).masks
        figures["ids"] = matching_metrics(choose_given(matched, given.cameras).instance_ids, given.leaf).ari
    result = run_scene(folder, None, config)
    case = detect_case(folder, config)
    figures["pixels"] = leaf_metrics(result.masks.regions, result.masks.instance_ids, case.truth).mv_pq
    rounds, _ = correct(case)
    figures["corrections"] = [score for answers, score, _ in rounds if answers <= case.num_leaves][-1]
    return figures


def measure_dates(table: Path, results: Path, seed: int) -> dict[str, float]:
    """Accuracy of tracks, mean over plants, each pot turned at random."""
    figures = []
    for plant, (dates, truth) in read_series(table, results).items():
        angles = np.random.default_rng([seed, *plant.encode()]).uniform(0, 360, len(dates))
        turned = [turn_date(date, angle) for date, angle in zip(dates, angles, strict=True)]
        figures.append(measure(truth, labels_of(track_leaves(turned), turned)))
    return {f"dates, {name}": float(np.mean([each[name] for each in figures])) for name in ("short", "long")}


def print_rows(name: str, worlds: list[dict[str, float]]) -> None:
    for table in worlds[0]:
        values = [each[table] for each in worlds]
        print(f"| {name} | {table} | {np.mean(values):.3f} | {np.std(values, ddof=1):.3f} |", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", type=Path, nargs="*", help="folders with photos and truth/")
    parser.add_argument("--worlds", type=int, default=3, help="two or more")
    parser.add_argument("--dates", type=Path, nargs=2, metavar=("TABLE", "RESULTS"))
    args = parser.parse_args()
    torch.set_num_threads(1)
    warnings.simplefilter("ignore", InputWarning)
    config = RunConfig(learn="off")
    print(f"| plant | table | mean of {args.worlds} worlds | spread |\n|---|---|---|---|")
    for folder in args.scenes:
        worlds = []
        for seed in range(args.worlds):
            with TemporaryDirectory() as place:
                write_turned(folder.resolve(), Path(place) / folder.name, seed)
                worlds.append(measure_world(Path(place) / folder.name, config))
        print_rows(folder.name, worlds)
    if args.dates is not None:
        print_rows(
            args.dates[0].name, [measure_dates(args.dates[0], args.dates[1], seed) for seed in range(args.worlds)]
        )


if __name__ == "__main__":
    main()
