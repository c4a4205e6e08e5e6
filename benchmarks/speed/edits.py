"""Seconds of opening a result in `mvseg correct`, and of each kind of edit: `python -m benchmarks.speed.edits RESULT`

Each edit is made alone, and undone; the leaves are two of the eight with the most masks, by a fixed seed. Printed: wall
seconds, the CPU seconds of this process and of those that fit surfaces, and the load of the machine.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing import active_children
from pathlib import Path

import cv2
import numpy as np

from mvseg.corrections.file import Confirm, Corrections, Edit, Link, Outline, Point, Reject, Split
from mvseg.masks import Masks
from mvseg.reconstruction.surface.fit_surfaces import fit_surfaces
from mvseg.server.open_result import OpenResult
from mvseg.system.running import running
from mvseg.system.worker_pool import default_workers, load_ahead

LOOKS = 15  # seconds until a person has looked at the page; processes load meanwhile
GROWN = 6  # pixels by which an outline is larger than the mask that it replaces


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("result", type=Path, help="of mvseg infer")
    result = parser.parse_args().result
    with running(num_workers=default_workers(), keep=True) as now:
        load_ahead(now.workers, default_workers(), fit_surfaces.__module__)
        time.sleep(LOOKS)
        with measured("open"):
            opened = OpenResult(result)
            opened.page(Corrections())
        update(opened, "first questions", ())
        masks = opened.saved_result().masks
        print(f"{opened.num_views} photos, {len(masks)} masks, {masks.num_instances} leaves")
        for kind, edits in choose_edits(masks, [view.name for view in opened.scene.views]).items():
            update(opened, kind, edits)
            update(opened, "  undone", ())


def choose_edits(masks: Masks, names: list[str]) -> dict[str, tuple[Edit, ...]]:
    """{kind: edits} of two leaves."""
    ids = masks.instance_ids
    ordered = sorted(ids[ids > 0].unique().tolist(), key=lambda leaf: -int((ids == leaf).sum()))
    first, second = (ordered[place] for place in np.random.default_rng(0).permutation(min(8, len(ordered)))[:2])
    rows, others = ((ids == leaf).nonzero()[:, 0].tolist() for leaf in (first, second))

    def name(row: int) -> str:
        return names[int(masks.view_index[row])]

    def inside(row: int) -> Point:
        """The pixel that is deepest in a mask."""
        crop = masks.regions.placed(row)
        depth = cv2.distanceTransform(np.pad(crop.pixels.numpy().astype(np.uint8), 1), cv2.DIST_L2, 3)[1:-1, 1:-1]
        y, x = np.unravel_index(depth.argmax(), depth.shape)
        return crop.box[0] + float(x) + 0.5, crop.box[1] + float(y) + 0.5

    def outline(row: int, leaf: str | None) -> Outline:
        crop = masks.regions.placed(row)
        grown = cv2.dilate(np.pad(crop.pixels.numpy().astype(np.uint8), GROWN), np.ones((2 * GROWN + 1,) * 2, np.uint8))
        lines, _ = cv2.findContours(grown, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
        points = max(lines, key=cv2.contourArea)[:, 0] + np.array(crop.box[:2]) - GROWN + 0.5
        return Outline(view=name(row), polygon=tuple((float(x), float(y)) for x, y in points), leaf=leaf)

    one, two = rows[:2]
    place, beside = (name(one), *inside(one)), (name(two), *inside(two))
    elsewhere = next((name(row), *inside(row)) for row in others if name(row) != name(one))
    left, top, right, bottom = masks.regions.boxes[two].tolist()
    line = ((left - 5.0, (top + bottom) / 2), (right + 5.0, (top + bottom) / 2))
    same, different = Link(op="same", at=(place, elsewhere)), Link(op="different", at=(place, beside))
    return {
        "no leaf": (Reject(view=name(one), at=inside(one)),),
        "no leaf, in all photos": (Reject(view=name(one), at=inside(one), everywhere=True),),
        "correct": (Confirm(view=name(one), at=inside(one)),),
        "correct, in all photos": (Confirm(view=name(one), at=inside(one), everywhere=True),),
        "moved to another leaf": (same, different),
        "different leaves": (different,),
        "the same leaf": (same,),
        "cut in two": (Split(view=name(two), at=inside(two), line=line),),
        "brush": (outline(one, None),),
        "outlined in two photos": (outline(one, "x"), outline(rows[len(rows) // 2], "x")),
    }


def update(opened: OpenResult, kind: str, edits: tuple[Edit, ...]) -> None:
    """Let the page follow edits."""
    updates = opened.updates(Corrections(edits), lambda: False)
    with measured(kind):
        found = next(updates)
    if any(found.outcomes):
        print(f"  {' '.join(found.outcomes)}")
    list(updates)


@contextmanager
def measured(kind: str) -> Iterator[None]:
    """Print the seconds of what is done."""
    wall, cpu = time.perf_counter(), cpu_seconds()
    yield
    wall, cpu = time.perf_counter() - wall, cpu_seconds() - cpu
    print(f"{kind:24} {wall:5.2f} s, {cpu:5.2f} CPU s, load {os.getloadavg()[0]:.1f}", flush=True)


def cpu_seconds() -> float:
    """Of this process, and of its workers."""
    total = time.process_time()
    for worker in active_children():
        fields = Path(f"/proc/{worker.pid}/stat").read_text().rpartition(")")[2].split()
        total += (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
    return total


if __name__ == "__main__":
    main()
