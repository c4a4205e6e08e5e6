"""What the views teach: `python -m benchmarks.learn SCENE... [--rounds 3]`

For each scene a table: as it is; after one, two, three rounds (each from the labels of the last, whatever the agreed
area says); and after one round in which a person has outlined six leaves in two photos each, the largest ones that are
not right; these outlines do not count in the figures. The agreed area (`rate_pass`, in percent of all pixels) stands
beside what the truth says, where the scene has a folder `truth`. `stays` marks what `mvseg infer --learn 3` would keep:
see `order_ratings`. With --table, one row for each scene, as `mvseg infer` finds it; of the false leaves it says how
many are stems (`stem_chances`), E is the expected number of correct masks, and the spread of MV-PQ is the standard
deviation over --worlds, that of the row and turned ones (`spread.py`). Weights and detections are kept in --cache.
"""

from __future__ import annotations

import argparse
import time
import warnings
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch

from benchmarks.choice import true_maps
from benchmarks.drawn_leaves import open_views
from benchmarks.simulated_person import Labels, Look
from benchmarks.spread import write_turned
from mvseg.config import RunConfig
from mvseg.corrections.file import Corrections
from mvseg.detection.cached_detections import CachedDetections
from mvseg.errors import InputWarning
from mvseg.evaluation.panoptic import leaf_metrics
from mvseg.evaluation.truth import true_instances
from mvseg.masks import Masks
from mvseg.pipeline.apply_edits import apply_edits
from mvseg.pipeline.find_in_photos import find_in_photos
from mvseg.pipeline.finish import shape_leaves
from mvseg.pipeline.learn import learn
from mvseg.pipeline.open_scene import open_scene
from mvseg.pipeline.plant import Plant
from mvseg.reconstruction.stem.slenderness import stem_chances
from mvseg.traits.filters import SURELY_STEM
from mvseg.verification.leaf_scores import order_ratings

DRAWN, PHOTOS = 6, 2  # leaves that the person outlines, and in how many photos each
TABLE = (
    "plant", "seen at", "rounds", "agreement", "agreed area", "E", "MV-PQ", "spread", "right", "false (stems)",
    "recall", "precision", "CPU s",
)  # fmt: skip
HEAD = ("", "agreed area", "stays", "MV-PQ", "right", "false", "recall", "precision", "leaves", "masks", "CPU s")


def judge(masks: Masks, truth: list[Labels] | None) -> dict[str, str]:
    found = {"leaves": str(masks.num_instances), "masks": str(int((masks.instance_ids > 0).sum()))}
    if truth is None:
        return found
    figures = leaf_metrics(masks.regions, masks.instance_ids, truth)
    return found | {
        "MV-PQ": f"{figures.mv_pq:.3f}",
        "right": f"{figures.num_right} of {figures.num_right + figures.num_missed}",
        "false": str(figures.num_false),
        "recall": f"{figures.mask_recall:.2f}",
        "precision": f"{figures.mask_precision:.2f}",
    }


def outline_some(plant: Plant, truth: list[Labels]) -> Corrections:
    """Six leaves, each in the two photos that show most of it: the largest that are not right, then the largest."""
    look = Look(shape_leaves(plant).masks.to("cpu"), truth, plant.scene, ())
    views_of = {leaf: open_views(look.visible[:, leaf]) for leaf in range(1, len(look.size))}
    seen = [leaf for leaf, views in views_of.items() if len(views) >= PHOTOS]
    chosen = sorted(seen, key=lambda leaf: (leaf in look.right, -float(look.size[leaf])))[:DRAWN]
    best = {leaf: sorted(views_of[leaf], key=lambda view: -float((truth[view] == leaf).sum())) for leaf in chosen}
    return Corrections(tuple(look.outline(leaf, view) for leaf in chosen for view in best[leaf][:PHOTOS]))


def show(name: str, plant: Plant, truth: list[Labels] | None, *, stays: str, begun: float) -> None:
    """Print a row."""
    area = 100 * plant.rating.agreed_area / int(plant.scene.cameras.sizes.prod(1).sum())
    row: dict[str, Any] = {"": name, "agreed area": f"{area:.2f}", "stays": stays}
    row |= judge(shape_leaves(plant).masks.to("cpu"), truth) | {"CPU s": f"{time.process_time() - begun:.0f}"}
    print("| " + " | ".join(str(row.get(column, "")) for column in HEAD) + " |", flush=True)


def print_as_it_comes(folder: Path, cache: CachedDetections, worlds: int) -> None:
    """A row of --table."""
    row, turned = measure_as_it_comes(folder, cache), list[str]()
    for seed in range(1, worlds):
        with TemporaryDirectory() as place:
            write_turned(folder.resolve(), Path(place) / folder.name, seed)
            turned.append(measure_as_it_comes(Path(place) / folder.name, cache)["MV-PQ"])
    spread = np.std([float(each) for each in (row["MV-PQ"], *turned)], ddof=1) if turned else np.nan
    print("| " + " | ".join((row | {"spread": f"{spread:.3f}"})[name] for name in TABLE) + " |", flush=True)


def measure_as_it_comes(folder: Path, cache: CachedDetections) -> dict[str, str]:
    """The cells of a row of --table, but for the spread."""
    begun = time.process_time()
    opened = open_scene(folder, None, RunConfig(reconstruct=None))
    plant = learn(find_in_photos(opened, cache=cache), cache=cache)
    masks, truth = shape_leaves(plant).masks.to("cpu"), true_maps(folder, opened.scene)
    area = 100 * plant.rating.agreed_area / int(opened.scene.cameras.sizes.prod(1).sum())
    chances = torch.tensor([0.0, *(plant.instances.probabilities[n] for n in range(1, masks.num_instances + 1))])
    expected = float((chances[masks.instance_ids.clamp(min=0)] * masks.match_scores).sum())
    of_mask = true_instances(masks.regions, truth, count_background=False)
    stems = [leaf for leaf, chance in stem_chances(plant.instances.starts).items() if chance > SURELY_STEM
             and not bool((of_mask[masks.instance_ids == leaf] > 0).any())]  # fmt: skip
    row = judge(masks, truth)
    return row | {
        "plant": folder.resolve().name, "seen at": f"{plant.image_size} px", "rounds": str(plant.learned.rounds),
        "agreement": f"{plant.agreement:.2f}", "agreed area": f"{area:.2f}", "E": f"{expected:.0f}",
        "false (stems)": f"{row['false']} ({len(stems)})", "CPU s": f"{time.process_time() - begun:.0f}",
    }  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", type=Path, nargs="+")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--table", action="store_true", help="a row for each scene, as it comes")
    parser.add_argument("--worlds", type=int, default=1, help="of --table; the spread needs two or more")
    parser.add_argument("--cache", type=Path, default=Path("results/learn"))
    args = parser.parse_args()
    torch.set_num_threads(1)
    warnings.simplefilter("ignore", InputWarning)
    if args.table:
        print("| " + " | ".join(TABLE) + " |\n|" + "---|" * len(TABLE))
        for folder in args.scenes:
            print_as_it_comes(folder, CachedDetections(args.cache / folder.resolve().name), args.worlds)
        return
    for folder in args.scenes:
        opened = open_scene(folder, None, RunConfig(reconstruct=None, learn="off"))
        begun = time.process_time()
        cache = CachedDetections(args.cache / folder.resolve().name)
        first = plant = find_in_photos(opened, cache=cache)
        truth = true_maps(folder, opened.scene) if (folder / "truth").is_dir() else None
        print(f"\n**{folder.resolve().name}**: {len(opened.scene.views)} photos, seen at {plant.image_size} px\n")
        print("| " + " | ".join(HEAD) + " |\n|" + "---|" * len(HEAD))
        show("as it is", plant, truth, stays="", begun=begun)
        stays = True
        for number in range(1, args.rounds + 1):
            begun, before = time.process_time(), plant
            plant = learn(plant, cache=cache, rounds=1)
            after = replace(plant, colors=before.leaf_colors).rating
            stays = stays and order_ratings([before.rating, after])[0] == 1
            name = f"round {number}, at {plant.image_size} px"
            show(name, plant, truth, stays="yes" if stays else "no", begun=begun)
        if truth is not None:
            begun, corrections = time.process_time(), outline_some(first, truth)
            plant = learn(first, cache=cache, corrections=corrections, rounds=1)
            show(f"{DRAWN} leaves of a person, learned", plant, truth, stays="", begun=begun)
            begun = time.process_time()
            corrected = apply_edits(plant, corrections)
            show("the same, and these outlines", corrected, truth, stays="", begun=begun)


if __name__ == "__main__":
    main()
