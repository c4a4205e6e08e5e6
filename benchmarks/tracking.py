"""The same leaf over days: `mvseg track` against what the field has, on simulated and real plants.

    python -m benchmarks.tracking simulated --num_plants 12            leaves as seen: meshes with noise, no photos
    python -m benchmarks.tracking results TABLE RESULTS [...]          results of mvseg batch, or of `prepare`
    python -m benchmarks.tracking prepare TABLE RESULTS                surfaces from true masks with true ids
    python -m benchmarks.tracking prepare TABLE RESULTS --masks degraded    from degraded masks, matched by mvseg

TABLE has the columns scene, name, plant, time; RESULTS/NAME is the result of a scene, whose truth is scene/truth. Or it
is a pair.json of two dates six days apart whose true ids differ, see `read_pair`. The
baselines get the alignment of dates that mvseg finds, or find their own (cpd); pycpd is only needed for that one. In
the end it prints how often links of each probability are right.

Measures: short-term accuracy (of the true next sights of leaves, the share that is linked), long-term accuracy (leaves
that are one track for their whole life, and all of it), IDF1 (Ristani 2016), F1 of births and deaths (the right leaf on
the right date).
"""

from __future__ import annotations

import argparse
import csv
import itertools
import json
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch
from scipy.optimize import linear_sum_assignment
from scipy.spatial.transform import Rotation

from benchmarks.faults import Faults, degrade_labels
from mvseg.formats.label_png import read_labels
from mvseg.formats.scene_folder import load_masks, load_scene
from mvseg.masks import Masks
from mvseg.matching.match import match_regions
from mvseg.matching.result import Matching, MatchReport
from mvseg.reconstruction.config import ReconstructConfig
from mvseg.reconstruction.shapes import reconstruct_voxels
from mvseg.reconstruction.surface.fit_surfaces import fit_surfaces
from mvseg.regions import regions_from_label_maps
from mvseg.results.folder import save_result
from mvseg.results.read import read_instances
from mvseg.results.result import Instances, Result
from mvseg.simulation.blades import BLADE_COLUMNS
from mvseg.simulation.growth import SimulatedPlant
from mvseg.simulation.series import SeriesSpec, draw_specs, grow_series
from mvseg.tracking.dates import Number, PlantOnDate, SeenLeaf, read_date, see_surface
from mvseg.tracking.leaves import DateLeaves, leaves_of
from mvseg.tracking.numbers import OBSERVATIONS
from mvseg.tracking.track import Tracks, track_leaves
from mvseg.traits.measure import measure_plant

IGNORED = 65535  # in true labels
MISSED = 0.05  # share of the leaves of a simulated plant
Labels = list[list[int]]  # per date, one number per leaf: a track, or the true id


# --- what is seen of simulated plants, without photos


def see_plant(
    plant: SimulatedPlant, time: float, rng: np.random.Generator, *, scene: str
) -> tuple[PlantOnDate, list[int]]:
    """A date as surfaces would show it: ends of midribs off by 3 % of the length, one base in 30 at the wrong end (of
    those that are not sure of it, one in three), some leaves missed. And the true ids of its leaves."""
    seen: list[tuple[SeenLeaf, int]] = []
    for leaf in plant.leaves:
        if rng.random() < MISSED:
            continue
        off, sd = rng.normal(0, 0.03 * leaf.length, (2, 3)), 0.03 * leaf.length
        share = np.linspace(0, 1, OBSERVATIONS.stations)[:, None]
        clear = see_surface(0, leaf.vertices, BLADE_COLUMNS, {}, is_oriented=True)
        assert clear.midrib is not None
        assert clear.points is not None
        midrib = clear.midrib + (1 - share) * off[0] + share * off[1]
        midrib += np.sin(np.pi * share) * rng.normal(0, 0.02 * leaf.length, 3)
        is_oriented = bool(rng.random() < 0.8)
        if rng.random() < (0.03 if is_oriented else 0.3):
            midrib = midrib[::-1]
        numbers = {
            "length": Number(leaf.length + float(rng.normal(0, sd)), sd, "mm"),
            "area": Number(leaf.area * (1 + float(rng.normal(0, 0.05))), 0.05 * leaf.area, "mm^2"),
            "insertion_height": Number(float(midrib[0, 2]), sd, "mm"),
            "azimuth": Number(0.0, 3.0, "degree"),
        }
        points = clear.points + off.mean(0)
        noisy = replace(clear, midrib=midrib, points=points, is_oriented=is_oriented, numbers=numbers)
        seen.append((noisy, leaf.leaf_id))
    order = rng.permutation(len(seen)).tolist()
    leaves = tuple(replace(seen[place][0], leaf=number) for number, place in enumerate(order, start=1))
    date = PlantOnDate(scene, time, f"{time:g}", "mm", knows_up=True, leaves=leaves, whole={})
    return date, [seen[place][1] for place in order]


def see_series(spec: SeriesSpec) -> tuple[list[PlantOnDate], Labels]:
    """All dates of a simulated plant, and the true ids."""
    rng = np.random.default_rng([spec.seed, 9])
    plants = zip(grow_series(spec), spec.times, strict=True)
    seen = [see_plant(plant, time, rng, scene=f"{spec.name}_{time:g}") for plant, time in plants]
    return [date for date, _ in seen], [truth for _, truth in seen]


# --- measures


def labels_of(tracks: Tracks, dates: Sequence[PlantOnDate]) -> Labels:
    """The track of each leaf of each date; a leaf that the tracks leave out as a stem is a track of its own."""
    track = {(row.date, row.leaf): row.track for row in tracks.rows if row.leaf is not None}
    left_out = itertools.count(-1, -1)
    return [[track[index, leaf.leaf] if (index, leaf.leaf) in track else next(left_out) for leaf in date.leaves]
            for index, date in enumerate(dates)]  # fmt: skip


def measure(truth: Labels, found: Labels) -> dict[str, float]:
    """All measures; leaves whose true id is below 1 are left out."""
    sights: dict[int, list[tuple[int, int]]] = {}
    lengths: Counter[int] = Counter()
    for date, (true, own) in enumerate(zip(truth, found, strict=True)):
        for leaf, track in zip(true, own, strict=True):
            if leaf > 0:
                sights.setdefault(leaf, []).append((date, track))
                lengths[track] += 1
    steps = [before[1] == after[1] for seen in sights.values() for before, after in pairwise(seen)]
    whole = [len({t for _, t in seen}) == 1 and lengths[seen[0][1]] == len(seen) for seen in sights.values()]
    overlap = Counter((leaf, track) for leaf, seen in sights.items() for _, track in seen)
    leaves, tracks = sorted(sights), sorted(lengths)
    table = np.array([[overlap[leaf, track] for track in tracks] for leaf in leaves])
    rows, columns = linear_sum_assignment(-table)
    total = sum(lengths.values())
    last = len(truth) - 1
    ends = {}
    for name, side, edge in (("births", 0, 0), ("deaths", -1, last)):
        true_ends = {(leaf, seen[side][0]) for leaf, seen in sights.items() if seen[side][0] != edge}
        by_track: dict[int, list[tuple[int, int]]] = {}
        for leaf, seen in sights.items():
            for date, track in seen:
                by_track.setdefault(track, []).append((date, leaf))
        found_ends = {(s[1], s[0]) for s in (sorted(seen)[side] for seen in by_track.values()) if s[0] != edge}
        num_ends = len(true_ends) + len(found_ends)
        ends[name] = 2 * len(true_ends & found_ends) / num_ends if num_ends else 1.0
    return {
        "short": float(np.mean(steps)) if steps else 1.0,
        "long": float(np.mean(whole)),
        "idf1": 2 * float(table[rows, columns].sum()) / (2 * total),
        **ends,
    }


# --- baselines: links of the leaves with a shape of consecutive dates


def by_base(first: DateLeaves, second: DateLeaves) -> np.ndarray:
    """Distances of base points."""
    return np.linalg.norm(first.bases[:, None] - second.bases[None], axis=-1)


def by_shape(first: DateLeaves, second: DateLeaves) -> np.ndarray:
    """Distances of length, chord and height in units of their spread."""

    def features(leaves: DateLeaves) -> np.ndarray:
        chord = np.linalg.norm(leaves.midribs[:, -1] - leaves.midribs[:, 0], axis=1)
        return np.column_stack([leaves.lengths, chord, leaves.midribs[:, :, 2].mean(1), leaves.chords[:, 2]])

    one, other = features(first), features(second)
    spread = np.concatenate([one, other]).std(0) + 1e-9
    return np.linalg.norm((one[:, None] - other[None]) / spread, axis=-1)


def by_rank(first: DateLeaves, second: DateLeaves) -> np.ndarray:
    """Differences of the rank from the bottom, as PhenoTrack3D orders leaves (without its alignment of sequences)."""
    one, other = (np.argsort(np.argsort(leaves.bases[:, 2])) for leaves in (first, second))
    return np.abs(one[:, None] - other[None]).astype(float)


def by_cpd(first: DateLeaves, second: DateLeaves) -> np.ndarray:
    """Distances of leaves after rigid, then deformable coherent point drift of all their points."""
    from pycpd import DeformableRegistration, RigidRegistration

    source, target = first.points[:, ::4].reshape(-1, 3), second.points[:, ::4].reshape(-1, 3)
    scale = target.std()
    moved = source / scale
    best = None
    for turn in np.radians(np.arange(0, 360, 45)):
        R = np.array([[np.cos(turn), -np.sin(turn), 0], [np.sin(turn), np.cos(turn), 0], [0, 0, 1]])
        rigid = RigidRegistration(X=target / scale, Y=moved @ R.T, scale=False, max_iterations=40)
        placed, _ = rigid.register()
        if best is None or rigid.q < best[0]:
            best = rigid.q, placed
    assert best is not None
    bent, _ = DeformableRegistration(X=target / scale, Y=best[1], alpha=2, beta=2, max_iterations=40).register()
    bent, other = bent.reshape(len(first), -1, 3), (target / scale).reshape(len(second), -1, 3)
    return np.linalg.norm(bent[:, None, :, None] - other[None, :, None], axis=-1).min(3).mean(2)


BASELINES = {"nearest base": by_base, "shape": by_shape, "rank": by_rank, "cpd": by_cpd}


def track_by(name: str, dates: Sequence[PlantOnDate], poses: np.ndarray) -> Labels:
    """Tracks from links of consecutive dates by the least sum of a baseline's distances."""
    leaves = [leaves_of(date) for date in dates]
    found: Labels = [list(range(1, len(dates[0].leaves) + 1))]
    count = len(found[0])
    for index, (first, second) in enumerate(pairwise(leaves)):
        if name == "nearest base":
            first = first.moved(np.linalg.inv(poses[index + 1]) @ poses[index])
        rows, columns = (
            linear_sum_assignment(BASELINES[name](first, second)) if len(first) and len(second) else ([], [])
        )
        labels = [0] * len(dates[index + 1].leaves)
        for row, column in zip(rows, columns, strict=True):
            labels[second.index[column]] = found[-1][leaves[index].index[row]]
        for place, label in enumerate(labels):
            if not label:
                count += 1
                labels[place] = count
        found.append(labels)
    return found


# --- results on disk


def prepare(table: Path, results: Path, *, masks: str = "true") -> None:
    """Surfaces from the true masks with true ids, or from degraded ones with the ids that the matcher gives them, as
    results; those that are there already are kept."""
    for row in csv.DictReader(table.open(encoding="utf-8")):
        scene_folder, place = table.parent / row["scene"], results / row["name"]
        if place.exists():
            continue
        scene = load_scene(scene_folder)
        regions = load_masks(scene, scene_folder / "truth")
        if masks == "degraded":
            maps = [read_labels(scene_folder / "truth" / f"{view.name}.png") for view in scene.views]
            seeds = np.random.SeedSequence([*row["name"].encode()]).generate_state(len(maps))
            degraded = [degrade_labels(of_view, Faults(), seed=int(n)) for of_view, n in zip(maps, seeds, strict=True)]
            regions = regions_from_label_maps(degraded)
            matching = match_regions(regions, scene.cameras)
        else:
            number = {label: n for n, label in enumerate(sorted(set(regions.labels.tolist()) - {IGNORED}), start=1)}
            ids = torch.tensor([number.get(label, -1) for label in regions.labels.tolist()])
            matching = Matching(Masks.of(regions, ids, (ids > 0).float()), MatchReport(method="truth"))
        ids = matching.instance_ids
        surfaces = fit_surfaces(regions, ids, scene.cameras)
        voxels = reconstruct_voxels(regions, ids, scene.cameras, config=ReconstructConfig(), surfaces=surfaces)
        traits = measure_plant(scene, matching, surfaces=surfaces, voxels=voxels)
        instances = Instances(surfaces=surfaces, voxels=voxels, traits=traits)
        result = Result(scene=scene, matching=matching, instances=instances)
        save_result(result, place, {"scene": scene.name}, report=False)
        print(place, flush=True)


def true_ids(date: PlantOnDate, truth: Path) -> list[int]:
    """The true id of each leaf: that of most pixels of its masks; 0 where most are unknown or of no leaf, and for the
    smaller ones of several that show one leaf."""
    assert date.folder is not None
    regions, labels = read_instances(date.folder, truth)
    votes: dict[int, Counter[int]] = {}
    for index, leaf in enumerate(regions.labels.tolist()):
        view = int(regions.view_index[index])
        height, width = labels[view].shape
        under = labels[view][regions.mask(index, width, height).numpy()]
        votes.setdefault(leaf, Counter()).update(under.tolist())
    best: dict[int, tuple[int, int]] = {}  # {true id: (pixels, leaf)}
    for leaf in date.leaves:
        true, count = votes.get(leaf.leaf, Counter({0: 0})).most_common(1)[0]
        best[true] = max(best.get(true, (0, 0)), (count, leaf.leaf))
    of = {leaf: true % IGNORED for true, (_, leaf) in best.items()}
    return [of.get(leaf.leaf, 0) for leaf in date.leaves]


def read_series(table: Path, results: Path) -> dict[str, tuple[list[PlantOnDate], Labels]]:
    """{plant: (dates, true ids)} of the rows whose results are there."""
    if table.suffix == ".json":
        return {table.parent.name: read_pair(table, results)}
    series: dict[str, tuple[list[PlantOnDate], Labels]] = {}
    for row in csv.DictReader(table.open(encoding="utf-8")):
        if (results / row["name"] / "run.json").is_file():
            date = read_date(results / row["name"], row["time"])
            dates, truth = series.setdefault(row["plant"], ([], []))
            dates.append(date)
            truth.append(true_ids(date, table.parent / row["scene"] / "truth"))
    return series


def read_pair(pair: Path, results: Path) -> tuple[list[PlantOnDate], Labels]:
    """Two dates and their true ids, those of the first; its leaves that are no more on the second are in `gone`.

    The second is the scene beside it that the results have, too.
    """
    first, scenes = pair.parent.name, pair.parents[1]
    (second,) = (path.name for path in results.iterdir() if path.name != first and (scenes / path.name).is_dir())
    same = {new: int(old) for old, new in json.loads(pair.read_text(encoding="utf-8"))["same"].items()}
    dates = [read_date(results / name, time) for name, time in ((first, 0), (second, 6))]
    before, after = (true_ids(date, pair.parents[1] / date.scene / "truth") for date in dates)
    return dates, [before, [same.get(leaf, leaf and leaf + 1000) for leaf in after]]


def read_places(places: Sequence[Path]) -> dict[str, dict[str, tuple[list[PlantOnDate], Labels]]]:
    """{name: series} of TABLE RESULTS TABLE RESULTS ..., as the command line has them."""
    return {table.parent.name: read_series(table, results)
            for table, results in zip(places[::2], places[1::2], strict=True)}  # fmt: skip


# --- pots that are turned


def turn_date(date: PlantOnDate, degrees: float) -> PlantOnDate:
    """The same date, its pot turned about the vertical through the origin: surfaces do not depend on how the world
    stands, so its photos need not be matched again."""
    turn = Rotation.from_rotvec([0, 0, np.radians(degrees)]).as_matrix().T
    leaves = tuple(
        replace(leaf, midrib=leaf.midrib @ turn, normal=leaf.normal @ turn, points=leaf.points @ turn)
        if leaf.midrib is not None and leaf.normal is not None and leaf.points is not None
        else leaf
        for leaf in date.leaves
    )
    return replace(date, leaves=leaves)


# --- tables


def compare(series: dict[str, tuple[list[PlantOnDate], Labels]]) -> None:
    """Print one row per method, the mean over the plants, and one per plant of ours; then `calibrate`."""
    tracked = {plant: track_leaves(dates) for plant, (dates, _) in series.items()}
    print("| method | short | long | IDF1 | births F1 | deaths F1 |\n|---|---|---|---|---|---|")
    for method in ("mvseg track", *BASELINES):
        rows = []
        for plant, (dates, truth) in series.items():
            tracks = tracked[plant]
            found = labels_of(tracks, dates) if method == "mvseg track" else track_by(method, dates, tracks.poses)
            rows.append(measure(truth, found))
            if method == "mvseg track":
                print(
                    f"| ... {plant} | " + " | ".join(f"{value:.3f}" for value in rows[-1].values()) + " |", flush=True
                )
        means = {name: np.mean([row[name] for row in rows]) for name in rows[0]}
        print(f"| {method} | " + " | ".join(f"{value:.3f}" for value in means.values()) + " |", flush=True)
    calibrate(series, tracked)


def calibrate(series: dict[str, tuple[list[PlantOnDate], Labels]], tracked: dict[str, Tracks]) -> None:
    """Print how often links of each probability are right, and the expected calibration error."""
    chances, rights = [], []
    for plant, (dates, truth) in series.items():
        tracks = tracked[plant]
        true = {(n, leaf.leaf): truth[n][k] for n, date in enumerate(dates) for k, leaf in enumerate(date.leaves)}
        before: dict[int, int] = {}
        for row in tracks.rows:
            if row.leaf is None:
                continue
            leaf = true[row.date, row.leaf]
            if row.track in before and row.probability == row.probability:
                chances.append(row.probability)
                rights.append(leaf == before[row.track])
            before[row.track] = leaf
    chance, right = np.array(chances), np.array(rights, float)
    error, edges = 0.0, np.array([0, 0.5, 0.7, 0.8, 0.9, 0.95, 0.99, 1.0001])
    print("| probability | links | mean | right |\n|---|---|---|---|")
    for low, high in pairwise(edges):
        inside = (chance >= low) & (chance < high)
        if inside.any():
            error += abs(chance[inside].mean() - right[inside].mean()) * inside.mean()
            mean, share = chance[inside].mean(), right[inside].mean()
            print(f"| {low:g} to {min(high, 1):g} | {inside.sum()} | {mean:.3f} | {share:.3f} |")
    print(f"expected calibration error {error:.3f} of {len(chance)} links")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("simulated", "prepare", "results"))
    parser.add_argument("places", type=Path, nargs="*")
    parser.add_argument("--num_plants", type=int, default=12)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--masks", choices=("true", "degraded"), default="true", help="of prepare")
    args = parser.parse_args()
    torch.set_num_threads(1)
    if args.what == "prepare":
        prepare(*args.places, masks=args.masks)
    elif args.what == "results":
        for series in read_places(args.places).values():
            compare(series)
    else:
        specs = draw_specs(args.num_plants, seed=args.seed)
        compare({spec.name: see_series(spec) for spec in specs})


if __name__ == "__main__":
    main()
