"""What answers to the questions of `mvseg correct TRACKS` are worth, where a simulated person knows the truth.

    python -m benchmarks.track_answers TABLE RESULTS [TABLE RESULTS ...] [--answers 10]

TABLE and RESULTS as in `benchmarks.tracking results`. Each time, the person answers the first question. Measures as
there, means over the series, after so many answers; where no question is left, they stay.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from benchmarks.tracking import Labels, labels_of, measure, read_places
from mvseg.corrections.track_links import LeafLink
from mvseg.tracking.dates import PlantOnDate
from mvseg.tracking.questions import list_questions
from mvseg.tracking.track import track_leaves

MEASURES = ("short", "long", "idf1")


def answer_questions(dates: Sequence[PlantOnDate], truth: Labels, most: int) -> list[dict[str, float]]:
    """The measures before the first answer, and after each of the others up to `most`, or until nothing is asked."""
    ids = {(date.scene, leaf.leaf): true for date, labels in zip(dates, truth, strict=True)
           for leaf, true in zip(date.leaves, labels, strict=True)}  # fmt: skip
    links: list[LeafLink] = []
    measured: list[dict[str, float]] = []
    for _ in range(most + 1):
        tracks = track_leaves(dates, links=links)
        measured.append(measure(truth, labels_of(tracks, dates)))
        questions = list_questions(tracks, links)
        if not questions:
            break
        one, other = (ids[leaf] for leaf in questions[0].link(tracks, is_same=True).leaves)
        links.append(questions[0].link(tracks, is_same=one == other > 0))
    return measured


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("places", type=Path, nargs="+", metavar="TABLE RESULTS")
    parser.add_argument("--answers", type=int, default=10)
    args = parser.parse_args()
    for name, series in read_places(args.places).items():
        found = [answer_questions(*each, args.answers) for each in series.values()]
        print(f"\n{name}: {len(found)} series, {np.mean([len(each) - 1 for each in found]):.1f} answers on average")
        print("| answers | short | long | IDF1 |\n|---|---|---|---|")
        for count in range(args.answers + 1):
            rows = [each[min(count, len(each) - 1)] for each in found]
            means = " | ".join(f"{np.mean([row[measure] for row in rows]):.3f}" for measure in MEASURES)
            print(f"| {count} | {means} |", flush=True)


if __name__ == "__main__":
    main()
