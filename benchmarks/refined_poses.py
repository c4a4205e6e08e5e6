"""Do masks put poses right that are a few pixels off? `python benchmarks/refined_poses.py --cache ~/mvseg-cells`

The scenes are those of `label_maps`, with true and with degraded masks; the cameras have the faults of `camera_faults`.
Each is matched with the poses as given, and with refined poses. Printed for each fault, before and after:
ARI, e_k, and the error of the poses, in pixels: the median distance from where the true cameras see points of the
plant, after the similarity of the world that makes it smallest. `--area` adds the median error of the areas of the
surfaces fitted to the ids found, in percent, over leaves that match a true one.
"""

from __future__ import annotations

import argparse
import sys
import warnings
from collections import defaultdict
from functools import partial
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

sys.path.insert(0, str(Path(__file__).parents[1]))

from benchmarks.camera_faults import faulty_cameras
from benchmarks.label_maps import KINDS, add_scene_options, chosen_scenes, load_maps
from mvseg.errors import InputWarning
from mvseg.evaluation.id_metrics import matching_metrics
from mvseg.matching.match import match_regions
from mvseg.matching.result import Matching
from mvseg.poses.refine_poses import mean_score, refine_poses
from mvseg.reconstruction.surface.fit_surfaces import fit_surfaces
from mvseg.regions import Regions
from mvseg.scene import Cameras
from mvseg.simulation.dataset import SceneSpec
from mvseg.simulation.growth import Plant, grow_plant
from mvseg.system.worker_pool import run_all

POINTS = 600  # of the plant
MEASURES = ("ari", "e_k", "pose px", "score", "area %")
Row = tuple[str, str, bool, list[float], list[float]]


def pose_error(cameras: Cameras, true: Cameras, points: torch.Tensor) -> float:
    """Pixels; see the top of the file."""
    seen, middle = true.project(points)[0].numpy(), points.numpy().mean(0)
    around = points.numpy() - middle
    size = float(np.linalg.norm(around, axis=1).mean())

    def misses(moved: NDArray[np.float64]) -> NDArray[np.float64]:
        turned = np.exp(moved[6]) * around @ Rotation.from_rotvec(moved[:3]).as_matrix().T
        px = cameras.project(torch.from_numpy(turned + middle + size * moved[3:6]))[0].numpy() - seen
        return np.asarray(px.ravel())

    fit = least_squares(misses, np.zeros(7), x_scale=0.01)
    return float(np.median(np.linalg.norm(fit.fun.reshape(-1, 2), axis=1)))


def area_error(regions: Regions, truth: torch.Tensor, matching: Matching, *, cameras: Cameras, plant: Plant) -> float:
    """Percent; median over the instances with a credible surface, each against the leaf that most of its masks show."""
    surfaces, errors = fit_surfaces(regions, matching.instance_ids, cameras), []
    for instance, surface in surfaces.items():
        shown = truth[matching.instance_ids == instance]
        if surface.is_credible and (shown > 0).any():
            leaf = plant.leaves[int(shown[shown > 0].mode()[0]) - 1]
            corners = leaf.vertices[leaf.faces]
            normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
            errors.append(abs(surface.area / (np.linalg.norm(normals, axis=1).sum() / 2) - 1))
    return 100 * float(np.median(errors)) if errors else float("nan")


def run_scene(spec: SceneSpec, *, cache: Path, faults: list[str], kinds: list[str], area: bool) -> list[Row]:
    """One row per kind of masks and fault: whether the poses were refined, and the `MEASURES` before and after."""
    torch.set_num_threads(1)
    warnings.simplefilter("ignore", InputWarning)
    scene, plant, rows = load_maps(spec, cache), grow_plant(spec.family, spec.num_leaves, spec.seed), []
    vertices = np.concatenate([leaf.vertices for leaf in plant.leaves])
    points = torch.from_numpy(vertices[:: max(1, len(vertices) // POINTS)]).double()
    for kind in kinds:
        regions, truth = scene.masks(kind)
        for fault in faults:
            rng = np.random.default_rng([spec.seed, spec.num_views, *fault.encode()])
            given, measured, is_refined = faulty_cameras(scene.cameras, fault, rng), [], False
            for refine in (False, True):
                cameras = given
                if refine:
                    poses = refine_poses(given, partial(match_regions, regions))
                    cameras, is_refined = poses.cameras, poses.is_refined
                matching = match_regions(regions, cameras)
                metrics = matching_metrics(matching.instance_ids, truth)
                measures = [metrics.ari, metrics.e_k, pose_error(cameras, scene.cameras, points), mean_score(matching)]
                if area:
                    measures.append(area_error(regions, truth, matching, cameras=cameras, plant=plant))
                measured.append(measures)
            rows.append((kind, fault, is_refined, measured[0], measured[1]))
            said = "  ".join(f"{a:.3f} -> {b:.3f}" for a, b in zip(*measured, strict=True))
            print(spec.folder, kind, fault, is_refined, said, file=sys.stderr, flush=True)
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add_scene_options(parser)
    parser.add_argument("--masks", nargs="+", choices=KINDS, default=KINDS)
    parser.add_argument("--faults", nargs="+", default=["exact", "moved 3", "moved 5", "moved 10", "moved 20"])
    parser.add_argument("--area", action="store_true", help="fit surfaces, too")
    args = parser.parse_args()
    work = partial(run_scene, cache=args.cache, faults=args.faults, kinds=list(args.masks), area=args.area)
    groups: dict[tuple[str, str], list[Row]] = defaultdict(list)
    for rows in run_all(work, chosen_scenes(args), args.workers):
        for row in rows:
            groups[row[0], row[1]].append(row)
    names = MEASURES if args.area else MEASURES[:-1]
    print(f"{'masks':9} {'poses':12} {'scenes':>6} {'refined':>8}" + "".join(f"{name:>20}" for name in names))
    for (kind, fault), rows in groups.items():
        before, after = (np.nanmean(values, 0) for values in ([row[3] for row in rows], [row[4] for row in rows]))
        cells = "".join(f"{a:10.3f} -> {b:6.3f}" for a, b in zip(before, after, strict=True))
        print(f"{kind:9} {fault:12} {len(rows):6} {sum(row[2] for row in rows):8}{cells}")


if __name__ == "__main__":
    main()
