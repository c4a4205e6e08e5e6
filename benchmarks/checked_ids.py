"""What surfaces correct in the ids: `python -m benchmarks.checked_ids --cache DIR [--real FOLDER ...] [--fit]`

For each scene: ARI and e_k of the ids found and of those that the surfaces correct
(`mvseg.verification.checked_ids`), how many masks are moved, how many of the moved were right before and are right
afterwards, and CPU seconds of matching, of surfaces and of the check. "degraded" and "true" are the masks of the
evaluation scenes, "pieces" those of `straps.py`, whose numbers of leaves do not depend on --leaves; "real" are those of
the folders with `masks/` and `truth/`.

With --fit, the numbers of `mvseg/verification/shown_leaves.py` are fitted on these scenes by maximum likelihood (a
small ridge): q on masks and the instances that show a true leaf, the price on the leaves that were found later, of
which those are right that give more masks a right id than they take it from. The last columns are ARI and right ids
lost and won with numbers that were fitted without this plant: real plants whose names begin with the same word count
as one, and so do simulated ones of one seed. Later candidates depend on the numbers: fit twice.
"""

from __future__ import annotations

import argparse
import sys
import time
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

sys.path.insert(0, str(Path(__file__).parents[1]))

from benchmarks.choice import main_leaf, regress
from benchmarks.confidence import has_right_id
from benchmarks.label_maps import KINDS, add_scene_options, chosen_scenes, load_maps, visible_ids
from benchmarks.straps import FIRST_SEED, cut_pieces, strap_cameras
from mvseg.errors import InputWarning
from mvseg.evaluation.id_metrics import matching_metrics
from mvseg.evaluation.truth import shown_instances
from mvseg.formats.label_png import read_label_png
from mvseg.formats.scene_folder import load_masks, load_scene
from mvseg.masks import Masks
from mvseg.matching.config import MatchConfig
from mvseg.matching.match import match_regions
from mvseg.reconstruction.surface.fit_surfaces import fit_surfaces
from mvseg.reconstruction.surface.leaf_surface import LeafSurface
from mvseg.regions import Regions, regions_from_label_maps
from mvseg.scene import Cameras
from mvseg.simulation.growth import grow_plant
from mvseg.verification.checked_ids import check_ids
from mvseg.verification.evidence import see
from mvseg.verification.shown_leaves import (
    GIVEN,
    GivenScores,
    MaskQuestion,
    ask,
    assign,
    gained,
    given_features,
    settle_masks,
    show_odds,
)

KINDS_HERE = (*KINDS, "pieces")
STRAPS = 8, 12  # leaves
NEAR = 0.02  # `Evidence.claimed` from which it is worth asking whether a mask shows a surface


@dataclass(frozen=True, eq=False)
class Given:
    """Masks of one scene: D regions and (D,) the leaf that each shows."""

    name: str
    plant: str
    regions: Regions
    leaf: Tensor
    cameras: Cameras


def list_masks(args: argparse.Namespace) -> Iterator[Given]:
    for folder in args.real:
        scene = load_scene(folder)
        regions = load_masks(scene, folder / "masks")
        sizes = scene.cameras.sizes.tolist()
        maps = [
            read_label_png(folder / "truth" / f"{view.name}.png", *size)
            for view, size in zip(scene.views, sizes, strict=True)
        ]
        word = folder.parent.name if folder.parent.name.endswith("-series") else folder.name
        yield Given(folder.name, word.split("-")[0], regions, shown_instances(regions, maps), scene.cameras)
    for kind in args.masks:
        if kind != "pieces":
            for spec in chosen_scenes(args):
                maps_of = load_maps(spec, args.cache)
                regions, leaf = maps_of.masks(kind)
                name = f"{kind} {spec.num_leaves}x{spec.num_views} {spec.family}"
                yield Given(name, str(spec.seed), regions, leaf, maps_of.cameras)
            continue
        for num_leaves in STRAPS:
            for number in range(args.plants):
                plant = grow_plant("strap", num_leaves, FIRST_SEED + number)
                cameras = strap_cameras(plant)
                true = visible_ids(plant, cameras)
                regions = regions_from_label_maps([cut_pieces(labels) for labels in true])
                leaf = shown_instances(regions, list(true), count_background=False)
                name = f"pieces {num_leaves}x{len(cameras)} {number}"
                yield Given(name, name, regions, leaf, cameras)


@dataclass(frozen=True, eq=False)
class Study:
    """A scene as the question was asked there.

    Attributes:
        given: the masks.
        before: (D,) ids of the matcher.
        question: which leaf each mask shows.
        of_candidate: (K,) the leaf that most masks of each candidate show.
    """

    given: Given
    before: Tensor
    question: MaskQuestion
    of_candidate: np.ndarray

    @staticmethod
    def of(given: Given, matched: Masks, surfaces: dict[int, LeafSurface]) -> Study:
        nothing = np.zeros(len(matched), bool)
        question = ask(matched, surfaces, cameras=given.cameras, config=MatchConfig(), is_held=nothing)
        members = ~np.isnan(question.candidates.matched)
        own = question.leaf[:, None] == np.arange(members.shape[1])
        members = np.where(question.is_known, own, members)  # not those that joined later
        of_candidate = np.array([main_leaf(given.leaf.numpy()[rows]) for rows in members.T])
        return Study(given, matched.instance_ids, question, of_candidate)

    @property
    def is_right(self) -> np.ndarray:
        """(D, K)"""
        right: np.ndarray = (self.given.leaf.numpy()[:, None] == self.of_candidate) & (self.of_candidate > 0)
        return right

    def right_ids(self, leaf: np.ndarray) -> np.ndarray:
        """(D,) whether the id is right."""
        return has_right_id(np.where(leaf >= 0, leaf + 1, -1), self.given.leaf.numpy())


def fit(studies: Sequence[Study]) -> GivenScores:
    """The numbers of greatest likelihood."""
    features, is_right = (np.concatenate(each) for each in zip(*map(mask_samples, studies), strict=True))
    fitted = GivenScores(shows=regress(GIVEN.shows, features, is_right), price=GIVEN.price)
    gains = np.array([sample for each in studies for sample in leaf_samples(each, fitted)]).reshape(-1, 2)
    if not 0 < gains[:, 1].sum() < len(gains):
        return fitted
    weights = regress(("always", "gain"), np.column_stack((np.ones(len(gains)), gains[:, 0])), gains[:, 1])
    return replace(fitted, price=round(-weights["always"] / weights["gain"], 1))


def mask_samples(each: Study) -> tuple[np.ndarray, np.ndarray]:
    """Features of masks and the first candidates, and whether they are right."""
    question, candidates = each.question, each.question.candidates
    evidence = see(question.drawn, len(question.leaf), question.is_known & candidates.is_credible)
    is_asked = question.is_known & (each.of_candidate > 0) & ~np.asarray(candidates.certain.any(1))[:, None]
    is_near = candidates.is_credible & (evidence.claimed > NEAR)
    rows = np.asarray(is_asked & (is_near | ~np.isnan(candidates.matched)))
    return given_features(candidates, evidence)[rows], each.is_right[rows]


def leaf_samples(each: Study, fitted: GivenScores) -> Iterator[tuple[float, bool]]:
    """Of each later candidate, what masks gain by it, and whether more of them become right than wrong."""
    question, odds = each.question, show_odds(each.question, fitted)
    first = assign(question, odds, question.is_known)
    for leaf in np.flatnonzero(~question.is_known).tolist():
        found = assign(question, odds, question.is_known | (np.arange(len(question.is_known)) == leaf))
        won = int(each.right_ids(found[0]).sum()) - int(each.right_ids(first[0]).sum())
        if (gain := gained(question, first, found, leaf)) and won:
            yield gain, won > 0


def judge(each: Study, fitted: GivenScores) -> str:
    """ARI with these numbers, and how many ids become wrong and right."""
    found, _ = settle_masks(each.question, fitted)
    ids = torch.from_numpy(np.where(found >= 0, found + 1, -1))
    before = has_right_id(each.before.numpy(), each.given.leaf.numpy())
    after = each.right_ids(found)
    lost, won = int((before & ~after).sum()), int((after & ~before).sum())
    return f"{matching_metrics(ids, each.given.leaf).ari:9.3f}{lost:9}{won:9}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add_scene_options(parser)
    parser.add_argument("--masks", nargs="*", choices=KINDS_HERE, default=KINDS_HERE)
    parser.add_argument("--real", type=Path, nargs="*", default=[], help="folders of real plants")
    parser.add_argument("--fit", action="store_true")
    args = parser.parse_args()
    torch.set_num_threads(1)
    warnings.simplefilter("ignore", InputWarning)
    header = ("ARI", "then", "e_k", "then", "moved", "right", "then", "match s", "fit s", "check s")
    print(f"{'masks':26}" + "".join(f"{name:>9}" for name in header))
    studies = []
    for given in list_masks(args):
        times = [time.process_time()]
        matched = match_regions(given.regions, given.cameras).masks
        times.append(time.process_time())
        surfaces = fit_surfaces(given.regions, matched.instance_ids, given.cameras)
        times.append(time.process_time())
        checked = check_ids(matched, surfaces, cameras=given.cameras)
        times.append(time.process_time())
        is_moved = (matched.instance_ids != checked.instance_ids).numpy()
        both = matched.instance_ids, checked.instance_ids
        before, after = (matching_metrics(ids, given.leaf) for ids in both)
        right = [int(has_right_id(ids.numpy(), given.leaf.numpy())[is_moved].sum()) for ids in both]
        cells = f"{before.ari:9.3f}{after.ari:9.3f}{before.e_k:9.0f}{after.e_k:9.0f}{int(is_moved.sum()):9}"
        cells += "".join(f"{count:9}" for count in right)
        cells += "".join(f"{end - start:9.1f}" for start, end in pairwise(times))
        print(f"{given.name:26}{cells}", flush=True)
        if args.fit:
            studies.append(Study.of(given, matched, surfaces))
    if studies:
        print(f"{'by numbers of others':26}{'ARI':>9}{'lost':>9}{'won':>9}")
        for each in studies:
            if others := [other for other in studies if other.given.plant != each.given.plant]:
                print(f"{each.given.name:26}{judge(each, fit(others))}", flush=True)
        print("fitted on all of them:", fit(studies))


if __name__ == "__main__":
    main()
