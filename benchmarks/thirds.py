"""What does a third more or less of a room's numbers change? `python -m benchmarks.thirds --cache DIR [--room NAME]`

Numbers are those of a room's `numbers.py`; one at a time is divided and multiplied by 1.33, whole numbers change by 1
at least, and of several each by itself. The scenes are development plants.

Of matching, with degraded masks: a line says of each scene how many ids of "nview" and of "one-per-view" change, by how
much their pair F1, and how far match scores move. Of verification: how many masks change their instance or their
pixels, and by how much pair F1 and MV-PQ change, where surfaces check the ids of the masks of `--given`, of degraded
masks and of straps in pieces, and masks are cut; where the views choose what the shipped detector found, also in the
folders of `--scenes`; and where up to `MOST_DRAWN` of these leaves were missed, and a person drew them in two photos,
or in three (half of their other masks are still there, matched to nothing). Of reconstruction, with the masks of
`--masks`: of all leaves together, how far area and its standard deviation move (median and largest change in percent),
of how many it changes whether they are credible, doubted or oriented; ids are
true but for one scene, where they are those of "nview". Of tracking, for each series: how many links come or go, by how
much short and long change, and how far the probabilities of links move; the series are simulated plants, two plants in
one pot, and those of `--series`, TABLE RESULTS as `benchmarks/tracking.py results` takes them.
"""

from __future__ import annotations

import argparse
import sys
import warnings
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, fields, is_dataclass, replace
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import torch
from scipy.optimize import linear_sum_assignment

import mvseg.matching.numbers
import mvseg.reconstruction.numbers
import mvseg.tracking.numbers
import mvseg.verification.numbers
from benchmarks.checked_ids import choose_given
from benchmarks.choice import true_maps
from benchmarks.corrections import Case, detect_case, render
from benchmarks.drawn_leaves import draw_from, open_views
from benchmarks.label_maps import KINDS, LabelledScene, load_maps, plant_index
from benchmarks.simulated_person import Look
from benchmarks.straps import FIRST_SEED, draw_straps, list_masks
from benchmarks.tracking import Labels, labels_of, measure, read_places, see_series
from mvseg.config import RunConfig
from mvseg.demo import demo_scene
from mvseg.errors import InputWarning
from mvseg.evaluation.id_metrics import matching_metrics
from mvseg.evaluation.panoptic import LeafMetrics, leaf_metrics
from mvseg.formats.scene_folder import load_masks, load_scene
from mvseg.masks import Masks, Origin
from mvseg.matching.affinity import region_affinity
from mvseg.matching.match import match_masks
from mvseg.matching.nview.match_nview import match_nview
from mvseg.matching.one_per_view import one_per_view_clusters
from mvseg.matching.view_graph import ViewGraph
from mvseg.pipeline.plant import Plant
from mvseg.reconstruction.surface.fit_surfaces import fit_surfaces
from mvseg.regions import Regions, name_regions, regions_from_label_maps
from mvseg.scene import Cameras
from mvseg.simulation.dataset import PRESETS, SceneSpec, list_specs
from mvseg.simulation.series import draw_specs
from mvseg.tracking.dates import PlantOnDate
from mvseg.tracking.track import track_leaves
from mvseg.verification.choose import Judges, choose_leaves
from mvseg.verification.drawn_leaves import follow_drawn
from mvseg.verification.numbers import CHOICE, COLORS, DRAWN, EVIDENCE, SNAP
from mvseg.verification.snap_edges import snap_masks

FACTOR = 1.33
SCENES = ((3, 16), (5, 32), (10, 8), (20, 8))  # views and leaves
CHECKED = ((3, 16, 0), (5, 32, 1), (10, 16, 0), (10, 32, 2))  # views, leaves and plant, where surfaces check ids
STRAPS = 12  # leaves of either plant of straps in pieces
MOST_DRAWN = 4  # leaves of a scene
FOUND = ((10, 16, 0), (10, 32, 1))  # where a detector finds leaves, beside the plant that ships


def scaled(value: float, factor: float) -> float:
    if isinstance(value, int):
        return round(value * factor) if round(value * factor) != value else value + (1 if factor > 1 else -1)
    return value * factor


def is_number(value: Any) -> bool:
    """Whether it is a number, or several."""
    return all(map(is_number, value)) if isinstance(value, tuple) else isinstance(value, int | float)


def list_changes(value: Any) -> Iterator[tuple[str, Any]]:
    """(what is done, the value after it)."""
    for factor in (1 / FACTOR, FACTOR):
        if isinstance(value, tuple):
            for place, each in enumerate(value):
                yield f"[{place}] x {factor:.2f}", (*value[:place], scaled(each, factor), *value[place + 1 :])
        else:
            yield f" x {factor:.2f}", scaled(value, factor)


def list_numbers(numbers: ModuleType) -> Iterator[tuple[str, Any, str]]:
    """(name of a group, group, name of a number) of a room's `numbers.py`."""
    for key, group in vars(numbers).items():
        if is_dataclass(group) and not isinstance(group, type):
            yield from ((key, group, field.name) for field in fields(group))


@contextmanager
def changed(group: Any, **values: Any) -> Iterator[None]:
    """Numbers of a room's `numbers.py` with other values, wherever they are read."""
    before = {name: getattr(group, name) for name in values}
    try:
        for name, value in values.items():
            object.__setattr__(group, name, value)  # frozen for everybody else
        forget()
        yield
    finally:
        for name, value in before.items():
            object.__setattr__(group, name, value)
        forget()


def forget() -> None:
    """What functions remember was made with the numbers as they were."""
    modules = [module for name, module in sys.modules.items() if name.startswith("mvseg.")]
    for each in [each for module in modules for each in vars(module).values()]:
        if hasattr(each, "cache_clear"):
            each.cache_clear()


def match_all(scenes: list[LabelledScene]) -> list[tuple[np.ndarray, ...]]:
    """Per scene the ids of "nview", its scores, the ids of "one-per-view", and the pair F1 of both."""
    found: list[tuple[np.ndarray, ...]] = []
    for scene in scenes:
        regions, truth = scene.masks("degraded")
        graph = ViewGraph.of(region_affinity(regions, scene.cameras), regions)
        matching = match_nview(regions, scene.cameras, graph)
        pairwise = one_per_view_clusters(graph).drop_singletons().instance_ids()
        f1 = [matching_metrics(ids, truth).pair_f1 for ids in (matching.instance_ids, pairwise)]
        found.append((matching.instance_ids.numpy(), matching.match_scores.numpy(), pairwise.numpy(), np.array(f1)))
    return found


def compare_matchings(before: list[tuple[np.ndarray, ...]], after: list[tuple[np.ndarray, ...]]) -> str:
    parts = []
    for (ids, scores, pairs, f1), (new_ids, new_scores, new_pairs, new_f1) in zip(before, after, strict=True):
        moved = int((ids != new_ids).sum()), int((pairs != new_pairs).sum())
        change, score = new_f1 - f1, float(np.abs(scores - new_scores).max())
        parts.append(f"{moved[0]:3} ids {change[0]:+.3f}, scores {score:.2f}, {moved[1]:3} in pairs {change[1]:+.3f}")
    return " | ".join(parts)


def spec_of(num_views: int, num_leaves: int, plant: int = 0) -> SceneSpec:
    specs = (spec for spec in list_specs(PRESETS["paper-eval"], 0) if spec.split == "dev")
    wanted = num_views, num_leaves, plant
    return next(spec for spec in specs if (spec.num_views, spec.num_leaves, plant_index(spec)) == wanted)


def try_numbers(numbers: ModuleType, only: list[str] | None, compare: Callable[[Any], str]) -> None:
    """Print what each number of a `numbers.py` changes, by what `compare` says of its group while it is another."""
    for key, group, name in list_numbers(numbers):
        is_tried = is_number(getattr(group, name)) and (only is None or name in only)
        for what, value in list_changes(getattr(group, name)) if is_tried else ():
            try:
                with changed(group, **{name: value}):
                    said = compare(group)
            except (ArithmeticError, LookupError, ValueError, RuntimeError) as error:
                said = f"cannot be: {error}"
            print(f"{key}.{name}{what}: {said}", flush=True)


def thirds_of_matching(args: argparse.Namespace) -> None:
    scenes = [load_maps(spec_of(*cell), args.cache) for cell in SCENES]
    before = match_all(scenes)
    try_numbers(mvseg.matching.numbers, args.numbers, lambda _: compare_matchings(before, match_all(scenes)))


# --- verification


@dataclass(frozen=True, eq=False)
class Trial:
    """One way through verification on one scene.

    Attributes:
        name: what is done, and to which scene.
        groups: of numbers, that count there.
        run: gives the masks.
        truth: V label maps.
    """

    name: str
    groups: tuple[Any, ...]
    run: Callable[[], Masks]
    truth: Any


CHECKING = (EVIDENCE,)
CHOOSING = (EVIDENCE, CHOICE, SNAP)
DRAWING = (DRAWN, COLORS)


def check_given(args: argparse.Namespace) -> Iterator[Trial]:
    for folder in args.given:
        scene = load_scene(folder)
        yield check_trial(folder.name, load_masks(scene, folder / "masks"), scene.cameras, true_maps(folder, scene))


def check_simulated(args: argparse.Namespace) -> Iterator[Trial]:
    for cell in CHECKED:
        maps = load_maps(spec_of(*cell), args.cache)
        name, regions = f"{cell[1]} leaves in {cell[0]} views", maps.masks("degraded")[0]
        yield check_trial(name, regions, maps.cameras, maps.true)
    for number in (0, 1):
        true, cameras = draw_straps(STRAPS, FIRST_SEED + number)
        yield check_trial(f"pieces of straps {number}", list_masks(true)["pieces"][0], cameras, true)


def choose_found(args: argparse.Namespace) -> Iterator[Trial]:
    for folder in (demo_scene(), *(render(spec_of(*cell), args.cache) for cell in FOUND), *args.scenes):
        config = RunConfig(reconstruct=None)
        case = detect_case(folder, config, cache=args.cache / "kept" / folder.name)
        first = choose_anew(case.plant).to("cpu")
        yield Trial(f"choose {folder.name}", CHOOSING, partial(choose_anew, case.plant), case.truth)
        for number in (2, 3):
            drawn = draw(case, first, number)
            yield Trial(f"draw {number} {folder.name}", DRAWING, partial(follow_anew, case.plant, drawn), case.truth)


def check_trial(name: str, regions: Regions, cameras: Cameras, truth: Iterable[np.ndarray]) -> Trial:
    """Surfaces check the ids of given masks."""
    masks = match_masks(Masks.of(regions), cameras).masks
    return Trial(f"check {name}", CHECKING, partial(choose_given, masks, cameras), list(truth))


def choose_anew(plant: Plant) -> Masks:
    leaves = choose_leaves(plant.proposals, plant.matched, Judges(plant.scene.cameras))
    return snap_masks(leaves.masks, plant.opened.photos)


def follow_anew(plant: Plant, masks: Masks) -> Masks:
    return follow_drawn(masks, cameras=plant.scene.cameras, photos=plant.opened.photos)


def draw(case: Case, first: Masks, number: int) -> Masks:
    """Every third leaf that enough photos show, up to `MOST_DRAWN`, was missed, and is drawn in so many of them."""
    look, ids = Look(first, case.truth, case.plant.scene, ()), first.instance_ids.clone()
    views = [(leaf, open_views(look.visible[:, leaf])) for leaf in range(1, len(look.size))]
    chosen = [(leaf, shown) for leaf, shown in views if len(shown) > number][number - 2 :: 3][:MOST_DRAWN]
    maps = [np.zeros_like(labels) for labels in case.truth]
    for leaf, shown in chosen:
        ids[torch.from_numpy(look.leaf == leaf)] = -1
        for view in draw_from(case, shown, number):
            maps[view][case.truth[view] == leaf] = leaf
    outlines = regions_from_label_maps(maps)
    drawn = Masks.of(outlines, outlines.labels, torch.ones(len(outlines)), origin=Origin.CORRECTED)
    left = replace(first, instance_ids=ids).select((ids > 0) | (first.view_index % 2 == 0))
    return Masks.concatenate((left, drawn))


def count_changed(before: Masks, after: Masks) -> int:
    """The masks of one that the other has not, with the same pixels and in the same instance."""
    one, other = (
        dict(zip(name_regions(each.regions), each.instance_ids.tolist(), strict=True)) for each in (before, after)
    )
    both = one.keys() & other.keys()
    votes = np.zeros((before.num_instances + 1, after.num_instances + 1))
    for name in both:
        votes[max(one[name], 0), max(other[name], 0)] += 1
    twins = set(zip(*(side.tolist() for side in linear_sum_assignment(votes, maximize=True)), strict=True))
    same = sum((max(one[name], 0), max(other[name], 0)) in twins for name in both)
    return max(len(before), len(after)) - same


def thirds_of_verification(args: argparse.Namespace) -> None:
    trials = [*check_given(args), *check_simulated(args), *choose_found(args)]
    before = [(masks := trial.run().to("cpu"), judge(masks, trial)) for trial in trials]
    for trial, (masks, metrics) in zip(trials, before, strict=True):
        scores = f"pair F1 {metrics.all_pair_f1:.3f}, MV-PQ {metrics.mv_pq:.3f}"
        print(f"{trial.name}: {len(masks)} masks, {scores}", flush=True)

    def compare(group: Any) -> str:
        said = []
        for trial, (masks, metrics) in zip(trials, before, strict=True):
            if not any(group is each for each in trial.groups):
                continue
            now = trial.run().to("cpu")
            if count := count_changed(masks, now):
                new = judge(now, trial)
                change = new.all_pair_f1 - metrics.all_pair_f1, new.mv_pq - metrics.mv_pq
                said.append(f"{trial.name} {count} masks, F1 {change[0]:+.3f}, PQ {change[1]:+.3f}")
        return " | ".join(said) or "nothing"

    try_numbers(mvseg.verification.numbers, args.numbers, compare)


def judge(masks: Masks, trial: Trial) -> LeafMetrics:
    matched = masks.select(masks.instance_ids > 0)
    return leaf_metrics(matched.regions, matched.instance_ids, trial.truth)


# --- reconstruction


# Views, leaves and family: level leaves, long ones, few views, many; and the scene whose ids are found.
SHAPES = ((5, 8, "rosette"), (5, 8, "strap"), (3, 8, "lanceolate"), (20, 4, "ovate"))
MATCHED = (5, 16, None)


def thirds_of_reconstruction(args: argparse.Namespace) -> None:
    specs = [spec for spec in list_specs(PRESETS["paper-eval"], 0) if spec.split == "dev"]
    scenes = []
    for num_views, num_leaves, family in (*SHAPES, MATCHED):
        fits = (each for each in specs if (each.num_views, each.num_leaves) == (num_views, num_leaves))
        scenes.append(load_maps(next(each for each in fits if family in (None, each.family)), args.cache))
    before = fit_all(scenes, args.masks)
    again = partial(fit_all, scenes, args.masks)
    try_numbers(mvseg.reconstruction.numbers, args.numbers, lambda _: compare_leaves(before, again()))


def fit_all(scenes: list[LabelledScene], kind: str) -> np.ndarray:
    """(N, 5) of all leaves that have two masks: area, its standard deviation, credible, reasons, oriented."""
    rows = []
    for index, scene in enumerate(scenes):
        regions, ids = scene.masks(kind)
        ids = torch.where(ids > 0, ids, -1)
        if index == len(SHAPES):
            graph = ViewGraph.of(region_affinity(regions, scene.cameras), regions)
            ids = match_nview(regions, scene.cameras, graph).instance_ids
        for leaf in fit_surfaces(regions, ids, scene.cameras).values():
            about = leaf.is_credible, len(leaf.reasons), leaf.is_oriented
            rows.append((leaf.area, leaf.deviations[0], *about) if leaf.exists else (np.nan, np.nan, 0, 1, 0))
    return np.array(rows)


def compare_leaves(before: np.ndarray, after: np.ndarray) -> str:
    if np.array_equal(before, after, equal_nan=True):
        return "nothing"
    area, sd = (100 * np.abs(np.log(after[:, column] / before[:, column])) for column in (0, 1))
    parts = [f"{name} {np.nanmedian(each):.1f} / {np.nanmax(each):.1f}" for name, each in (("area", area), ("sd", sd))]
    turned = zip((before[:, 2:5] != after[:, 2:5]).sum(0), ("credible", "doubted", "oriented"), strict=True)
    return ", ".join([*parts, *(f"{count} {name}" for count, name in turned if count)])


# --- tracking


Series = dict[str, tuple[list[PlantOnDate], Labels]]
Links = dict[tuple[str, int, int, int], float]  # {(plant, date, leaf, the leaf before): probability}


def simulated_series() -> dict[str, Series]:
    """Five plants of seed 5, and eight of seed 20."""
    return {
        "seed 5": {spec.name: see_series(spec) for spec in draw_specs(5, seed=5)},
        "seed 20": {spec.name: see_series(spec) for spec in draw_specs(8, seed=20)},
    }


def track_series(series: Series) -> tuple[Links, np.ndarray]:
    """The links of all plants, and the means (2,) of short and long."""
    links: Links = {}
    measures = []
    for plant, (dates, truth) in series.items():
        tracks, before = track_leaves(dates), dict[int, int]()
        found = measure(truth, labels_of(tracks, dates))
        measures.append((found["short"], found["long"]))
        for row in tracks.rows:
            if row.leaf is not None:
                links[plant, row.date, row.leaf, before.get(row.track, 0)] = row.probability
                before[row.track] = row.leaf
    return links, np.mean(measures, axis=0)


def compare_links(before: tuple[Links, np.ndarray], after: tuple[Links, np.ndarray]) -> str:
    moved = before[0].keys() ^ after[0].keys()
    steps = [abs(after[0][link] - chance) for link, chance in before[0].items() if link in after[0]]
    short, long = after[1] - before[1]
    return f"{len(moved):3} links {short:+.3f} {long:+.3f} p {np.nanmax([0.0, *steps]):.2f}"


def thirds_of_tracking(args: argparse.Namespace) -> None:
    every = read_places(args.series) | simulated_series()
    before = {name: track_series(series) for name, series in every.items()}

    def compare(_: Any) -> str:
        return " | ".join(f"{key}: {compare_links(before[key], track_series(own))}" for key, own in every.items())

    try_numbers(mvseg.tracking.numbers, args.numbers, compare)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cache", type=Path, default=Path("results/thirds"), help="folder for rendered scenes")
    parser.add_argument("--room", choices=ROOMS, default="matching")
    parser.add_argument("--numbers", nargs="+", help="only these")
    parser.add_argument("--masks", choices=KINDS, default="degraded", help="that leaves are reconstructed from")
    parser.add_argument("--given", type=Path, nargs="*", default=[], help="plants to check, with masks/ and truth/")
    parser.add_argument("--scenes", type=Path, nargs="*", default=[], help="more to verify, with photos and truth/")
    parser.add_argument("--series", type=Path, nargs="*", default=[], help="TABLE RESULTS of real series to track")
    args = parser.parse_args()
    torch.set_num_threads(1)
    warnings.simplefilter("ignore", InputWarning)
    ROOMS[args.room](args)


ROOMS = {
    "matching": thirds_of_matching,
    "verification": thirds_of_verification,
    "reconstruction": thirds_of_reconstruction,
    "tracking": thirds_of_tracking,
}

if __name__ == "__main__":
    main()
