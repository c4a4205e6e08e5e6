"""What does a third more or less of each number of tracking change?

    python -m benchmarks.thirds_of_tracking [TABLE RESULTS ...]

TABLE and RESULTS are those of `benchmarks/tracking.py results`; beside them, simulated plants and two plants in one pot
are tracked. Numbers are those of `mvseg/tracking/numbers.py`; one at a time is divided and multiplied
by 1.33, whole numbers by 1 at least, and each number of several by itself. A line says of each series how many links
come or go, by how much short and long change, and how far the probabilities of links move.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch

import mvseg.tracking.numbers
from benchmarks.thirds import FACTOR, changed, list_numbers, scaled
from benchmarks.tracking import Labels, labels_of, measure, read_places, see_series, see_two_plants
from mvseg.simulation.series import draw_specs
from mvseg.tracking.dates import PlantOnDate
from mvseg.tracking.track import track_leaves

Series = dict[str, tuple[list[PlantOnDate], Labels]]
Links = dict[tuple[str, int, int, int], float]  # {(plant, date, leaf, the leaf before): probability}


def simulated_series() -> dict[str, Series]:
    """Five plants of seed 5, eight of seed 20, and four times two plants in one pot."""
    specs = draw_specs(4, seed=41)
    pairs = zip(specs, [*specs[1:], *specs[:1]], strict=True)
    return {
        "seed 5": {spec.name: see_series(spec) for spec in draw_specs(5, seed=5)},
        "seed 20": {spec.name: see_series(spec) for spec in draw_specs(8, seed=20)},
        "two": {one.name: see_two_plants(one, other, turn=60.0) for one, other in pairs},
    }


def track_series(series: Series) -> tuple[Links, np.ndarray]:
    """The links of all plants, and the means (2,) of short and long."""
    links: Links = {}
    measures = []
    for plant, (dates, truth) in series.items():
        tracks, before = track_leaves(dates), dict[int, int]()
        found = measure(truth, labels_of(tracks))
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


def list_changes(value: Any) -> Iterator[tuple[str, Any]]:
    """(what is done, the value after it)."""
    for factor in (1 / FACTOR, FACTOR):
        if isinstance(value, tuple):
            for place, each in enumerate(value):
                yield f"[{place}] x {factor:.2f}", (*value[:place], scaled(each, factor), *value[place + 1 :])
        else:
            yield f" x {factor:.2f}", scaled(value, factor)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("places", type=Path, nargs="*", help="TABLE RESULTS of real series")
    parser.add_argument("--numbers", nargs="+", help="only these")
    args = parser.parse_args()
    torch.set_num_threads(1)
    print_changes(read_places(args.places) | simulated_series(), args.numbers)


def print_changes(every: Mapping[str, Series], numbers: list[str] | None = None) -> None:
    before = {name: track_series(series) for name, series in every.items()}
    for key, group, name in list_numbers(mvseg.tracking.numbers):
        for what, value in list_changes(getattr(group, name)) if numbers is None or name in numbers else ():
            try:
                with changed(group, **{name: value}):
                    said = [f"{key}: {compare_links(before[key], track_series(own))}" for key, own in every.items()]
            except (ArithmeticError, LookupError, ValueError) as error:
                said = [f"cannot be: {error}"]
            print(f"{key}.{name}{what} | " + " | ".join(said), flush=True)


if __name__ == "__main__":
    main()
