"""Does a degenerate size win? `python -m benchmarks.sizes SCENE... [--cut]`

The detector looks at every size down to 32 px, and no search ends early. With --cut, once more at copies of the photos
of which a third is cut off on each side, so that the plant fills and leaves them. For each scene a table of its sizes,
with what decides (`order_ratings`) beside MV-PQ, edges as the detector drew them; at the end, how many pairs of sizes
whose MV-PQ differs by 0.02 the agreed area orders, and how much of the best MV-PQ is lost by the best size over the
whole range, and by that which `choose_size` stops at. Detections are kept in --cache.
"""

from __future__ import annotations

import argparse
import json
import time
import warnings
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import torch

from benchmarks.choice import true_maps
from mvseg.config import RunConfig
from mvseg.detection.cached_detections import CachedDetections
from mvseg.detection.numbers import DETECTION
from mvseg.detectors import MIN_IMAGE_SIZE
from mvseg.errors import InputWarning
from mvseg.evaluation.panoptic import leaf_metrics
from mvseg.pipeline.find_in_photos import choose_size, colors_to_judge_by, run_pass, select_judges
from mvseg.pipeline.open_scene import open_scene
from mvseg.pipeline.plant import Plant
from mvseg.verification.leaf_scores import order_ratings


def cut_photos(folder: Path, out: Path) -> Path:
    """A copy of a scene with a rig file: the middle third of each photo, and of its true labels."""
    rig = json.loads((folder / "cameras.json").read_text())
    for view in rig["views"]:
        name, x, y = f"{Path(view['file']).stem}.png", view["width"] // 3, view["height"] // 3
        for source, place in ((folder / view["file"], "images"), (folder / "truth" / name, "truth")):
            if source.is_file():
                (out / place).mkdir(parents=True, exist_ok=True)
                image = np.asarray(cv2.imread(str(source), cv2.IMREAD_UNCHANGED))
                cv2.imwrite(str(out / place / name), image[y : image.shape[0] - y, x : image.shape[1] - x])
        view |= {"file": f"images/{name}", "width": view["width"] - 2 * x, "height": view["height"] - 2 * y}
        view["K"][0][2] -= x
        view["K"][1][2] -= y
    (out / "cameras.json").write_text(json.dumps(rig))
    return out


def sweep(folder: Path, cache: Path) -> tuple[float, float]:
    """Print the table of a scene; the loss over the whole range, and by the search, NaN without a truth."""
    opened = open_scene(folder, None, RunConfig(reconstruct=None, learn="off"))
    few, views = select_judges(opened)
    truth = true_maps(folder, opened.scene) if (folder / "truth").is_dir() else None
    detections = CachedDetections(cache)
    first = run_pass(few, None, cache=detections)
    boxes, colors = first.boxes, colors_to_judge_by(first)
    scores: dict[int, float] = {}

    def show(result: Plant, begun: float) -> Plant:
        result, masks, size = replace(result, colors=colors), result.masks, result.image_size
        maps = None if truth is None else [truth[view] for view in views.tolist()]
        scores[size] = np.nan if maps is None else leaf_metrics(masks.regions, masks.instance_ids, maps).mv_pq
        area, seconds = result.rating.agreed_area / 1e6, time.process_time() - begun
        cells = f"{result.rating.num_leaves} | {result.agreement:.2f} | {area:.3f}"
        print(f"| {size} | {cells} | {result.rating.expected:.0f} | {scores[size]:.3f} | {seconds:.0f} |", flush=True)
        return result

    def see(size: int) -> Plant:
        begun = time.process_time()
        return show(run_pass(few, size, cache=detections, boxes=boxes), begun)

    print(f"\n**{folder.resolve().name}**, {len(views)} photos\n")
    print("| px | leaves | agreement | agreed area, Mpx | E | MV-PQ | CPU s |\n" + "|---" * 7 + "|")
    results = [show(first, time.process_time())]
    while (size := results[0].image_size * DETECTION.size_step ** len(results)) >= MIN_IMAGE_SIZE:
        results.append(see(round(size)))
    by_size = {round(results[0].image_size * DETECTION.size_step**n): each for n, each in enumerate(results)}
    best = results[order_ratings([each.rating for each in results])[0]]
    searched = choose_size(by_size.__getitem__, results[0])[0]
    areas, values = np.array([(each.rating.agreed_area, scores[each.image_size]) for each in results]).T
    one, other = np.triu_indices(len(results), 1)
    differs = abs(values[one] - values[other]) >= 0.02
    in_order = ((areas[one] - areas[other]) * (values[one] - values[other]) > 0)[differs].sum()
    losses = values.max() - scores[best.image_size], values.max() - scores[searched.image_size]
    lost = f"lost over the whole range {losses[0]:.3f}, by the search {losses[1]:.3f}"
    print(f"\n{in_order} of {differs.sum()} pairs in order; {lost}", flush=True)
    return losses


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", type=Path, nargs="+")
    parser.add_argument("--cut", action="store_true")
    parser.add_argument("--cache", type=Path, default=Path("results/sizes"))
    args = parser.parse_args()
    torch.set_num_threads(1)
    warnings.simplefilter("ignore", InputWarning)
    losses = []
    for folder in args.scenes:
        name = folder.resolve().name
        losses.append(sweep(folder, args.cache / name))
        if args.cut:
            losses.append(sweep(cut_photos(folder, args.cache / "cut" / name), args.cache / f"{name}-cut"))
    known = np.array([each for each in losses if not np.isnan(each[0])])
    print(f"\n{len(known)} with a truth: lost {known.mean(0).round(3)} on average, {known.max(0).round(3)} at most")


if __name__ == "__main__":
    main()
