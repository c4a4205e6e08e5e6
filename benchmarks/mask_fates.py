"""What cross-view verification does with detected masks, right or wrong by the truth: `python benchmarks/mask_fates.py
SCENE ...`

Scenes have photos and `truth/` label images: real ones, and those of `benchmarks/unruly_plants.py`. A mask is right
when its IoU with a true leaf of its photo is at least 0.5. `--keep DIR` keeps detections for the next call.
"""

from __future__ import annotations

import argparse
import sys
import warnings
from collections import Counter
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))

from mvseg.verification.other_views import ROUGH_VIEWS, revise_masks

from benchmarks.found_leaves import FOUND_IOU, tied_instances
from mvseg.detection.config import DetectConfig
from mvseg.detection.detect_scene import detect_scene
from mvseg.evaluation.panoptic import leaf_metrics
from mvseg.evaluation.truth import shown_instances
from mvseg.formats.label_png import read_label_png
from mvseg.formats.lens import undistort
from mvseg.formats.photos import Photos
from mvseg.formats.scene_folder import load_scene
from mvseg.masks import Masks, Origin
from mvseg.reconstruction.surface.fit_surfaces import fit_surfaces
from mvseg.regions import IGNORE_LABEL
from mvseg.scene import Scene
from mvseg.verification.checked_ids import move_masks

FATES = ("kept", "dropped: in no instance", "dropped: no credible surface", "dropped: found too rarely",
         "dropped: disagrees with its surface", "replaced: disagrees with its surface")  # fmt: skip
ADDED = "masks added or put in place"


def true_maps(folder: Path, scene: Scene) -> list:
    """V true label maps in the frames of the undistorted photos."""
    maps = []
    for view, size, K in zip(scene.views, scene.cameras.sizes.tolist(), scene.cameras.K, strict=True):
        maps.append(undistort(read_label_png(folder / "truth" / f"{view.name}.png", *size), view.lens, K.numpy()))
    return maps


def find_right(masks: Masks, truth: list) -> list[bool | None]:
    """Whether each mask is right; None for those that lie mostly where the truth ignores it, and count for nothing."""
    right = tied_instances(masks.regions, truth, min_iou=FOUND_IOU) > 0
    is_ignored = shown_instances(masks.regions, truth) == IGNORE_LABEL
    pairs = zip(right.tolist(), is_ignored.tolist(), strict=True)
    return [None if ignored and not found else found for found, ignored in pairs]


def count_fates(
    before: Masks, after: Masks, surfaces: dict, *, right: list[bool | None]
) -> Counter[tuple[str, bool | None]]:
    """(fate, right?) -> number of detected masks; `after` has the ids of `before`."""
    now = {}
    for view, instance, origin in zip(
        after.view_index.tolist(), after.instance_ids.tolist(), after.origin.tolist(), strict=True
    ):
        now[view, instance] = origin
    left = set(after.instance_ids.tolist())
    fates: Counter[tuple[str, bool | None]] = Counter()
    seen = {instance for instance, surface in surfaces.items() if surface.is_credible}
    for row, (view, instance) in enumerate(zip(before.view_index.tolist(), before.instance_ids.tolist(), strict=True)):
        origin = now.get((view, instance))
        if instance < 1:
            fate = 1
        elif origin is not None:
            fate = 0 if origin != Origin.OTHER_VIEWS else 5
        elif instance not in seen:
            fate = 2
        else:
            fate = 4 if instance in left else 3
        fates[FATES[fate], right[row]] += 1
    return fates


def judge(folder: Path, config: DetectConfig, keep: Path | None) -> Counter[tuple[str, bool | None]]:
    """Detect, match and verify the masks of a scene; prints its MV-PQ before and after."""
    scene = load_scene(folder)
    truth, photos = true_maps(folder, scene), Photos(scene)
    cache = None if keep is None else keep / folder.name
    before = detect_scene(photos, config, cache=cache)(scene.cameras).masks.to("cpu")
    surfaces = fit_surfaces(before.regions, before.instance_ids, scene.cameras, most_views=ROUGH_VIEWS)
    before, surfaces = move_masks(before, surfaces, cameras=scene.cameras)
    after = revise_masks(before, surfaces, cameras=scene.cameras, photos=photos)
    fates = count_fates(before, after, surfaces, right=find_right(before, truth))
    for origin, is_right in zip(after.origin.tolist(), find_right(after, truth), strict=True):
        fates[ADDED, is_right] += origin == Origin.OTHER_VIEWS
    for name, masks in (("detected", before), ("verified", after.close_gaps())):
        found = leaf_metrics(masks.regions, masks.instance_ids, truth)
        print(
            f"{folder.name}, {name}: precision {found.mask_precision:.2f}, recall {found.mask_recall:.2f}, "
            f"MV-PQ {found.mv_pq:.3f}, {found.num_right} leaves right, {found.num_false} false"
        )
    return fates


def show(name: str, fates: Counter[tuple[str, bool | None]]) -> None:
    """The table, and the two figures that thresholds are judged by."""
    print(f"{name}: right / wrong")
    for fate in (*FATES, ADDED):
        print(f"  {fate:38} {fates[fate, True]:4} / {fates[fate, False]}")
    lost = sum(fates[fate, True] for fate in FATES[1:])
    right = sum(fates[fate, True] for fate in FATES)
    added = fates[ADDED, True] + fates[ADDED, False]
    print(
        f"  right masks lost {lost / max(right, 1):.2f}, right of those added {fates[ADDED, True] / max(added, 1):.2f}"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", type=Path, nargs="+")
    parser.add_argument("--image_size", type=int)
    parser.add_argument("--keep", type=Path)
    args = parser.parse_args()
    config, total = DetectConfig(image_size=args.image_size), Counter()
    warnings.simplefilter("ignore")
    for folder in args.scenes:
        fates = judge(folder, config, args.keep)
        show(folder.name, fates)
        total += fates
    if len(args.scenes) > 1:
        show("all", total)


if __name__ == "__main__":
    main()
