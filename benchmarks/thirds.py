"""What does a third more or less of each number of matching change? `python benchmarks/thirds.py --cache DIR`

Numbers are those at the head of the modules of matching, and the fields of `NViewConfig`; one at a time is divided and
multiplied by 1.33, whole numbers change by 1 at least. The scenes are development plants with degraded masks. A line
says of each scene how many ids of "nview" and of "one-per-view" change, by how much their pair F1, and how far match
scores move.
"""

from __future__ import annotations

import argparse
import ast
import importlib
import pkgutil
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import fields, replace
from pathlib import Path
from types import FunctionType, ModuleType
from typing import Any

import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).parents[1]))

import mvseg.matching
from benchmarks.label_maps import LabelledScene, load_maps
from mvseg.errors import InputWarning
from mvseg.evaluation.id_metrics import matching_metrics
from mvseg.matching.affinity import region_affinity
from mvseg.matching.nview.config import NViewConfig
from mvseg.matching.nview.match_nview import match_nview
from mvseg.matching.one_per_view import one_per_view_clusters
from mvseg.matching.view_graph import ViewGraph
from mvseg.simulation.dataset import PRESETS, list_scenes

FACTOR = 1.33
SCENES = ((3, 16), (5, 32), (10, 8), (20, 8))  # views and leaves


def scaled(value: Any, factor: float) -> Any:
    if isinstance(value, tuple):
        return tuple(scaled(each, factor) for each in value)
    if isinstance(value, int):
        return round(value * factor) if round(value * factor) != value else value + (1 if factor > 1 else -1)
    return value * factor


def list_numbers(package: ModuleType) -> Iterator[tuple[ModuleType, str]]:
    """The numbers at the head of the modules of a package."""
    for found in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
        module = importlib.import_module(found.name)
        for statement in ast.parse(Path(str(module.__file__)).read_text(encoding="utf-8")).body:
            for target in statement.targets if isinstance(statement, ast.Assign) else ():
                for name in target.elts if isinstance(target, ast.Tuple) else [target]:
                    if isinstance(name, ast.Name) and isinstance(getattr(module, name.id), int | float | tuple):
                        yield module, name.id


@contextmanager
def changed(module: ModuleType, name: str, value: Any) -> Iterator[None]:
    """A number with another value, wherever it was imported, or is a default."""
    before = getattr(module, name)
    holders = [each for key, each in sys.modules.items() if key.startswith("mvseg.") and vars(each).get(name) is before]
    functions = [each for each in vars(module).values() if isinstance(each, FunctionType)]
    defaults = [(each, each.__defaults__, each.__kwdefaults__) for each in functions]
    try:
        for holder in holders:
            setattr(holder, name, value)
        for function, positional, named in defaults:
            if name.lower() in function.__code__.co_varnames:
                function.__defaults__ = positional and tuple(value if each is before else each for each in positional)
                function.__kwdefaults__ = named and {k: value if v is before else v for k, v in named.items()}
        yield
    finally:
        for holder in holders:
            setattr(holder, name, before)
        for function, positional, named in defaults:
            function.__defaults__, function.__kwdefaults__ = positional, named


def match_all(scenes: list[LabelledScene], config: NViewConfig = NViewConfig()) -> list[tuple[np.ndarray, ...]]:
    """Per scene the ids of "nview", its scores, the ids of "one-per-view", and the pair F1 of both."""
    found: list[tuple[np.ndarray, ...]] = []
    for scene in scenes:
        regions, truth = scene.masks("degraded")
        graph = ViewGraph.of(region_affinity(regions, scene.cameras), regions)
        matching = match_nview(regions, scene.cameras, graph, config=config)
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


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cache", type=Path, required=True, help="folder for rendered label maps")
    parser.add_argument("--numbers", nargs="+", help="only these")
    args = parser.parse_args()
    torch.set_num_threads(1)
    warnings.simplefilter("ignore", InputWarning)
    specs = [spec for spec in list_scenes(PRESETS["paper-eval"], 0) if spec.split == "dev"]
    scenes = [
        load_maps(next(spec for spec in specs if (spec.num_views, spec.num_leaves) == cell), args.cache)
        for cell in SCENES
    ]
    before = match_all(scenes)
    for module, name in list_numbers(mvseg.matching):
        for factor in (1 / FACTOR, FACTOR) if args.numbers is None or name in args.numbers else ():
            try:
                with changed(module, name, scaled(getattr(module, name), factor)):
                    said = compare_matchings(before, match_all(scenes))
            except (ArithmeticError, LookupError, ValueError, RuntimeError) as error:
                said = f"cannot be: {error}"
            print(f"{module.__name__.rpartition('.')[2]} {name} x {factor:.2f}: {said}", flush=True)
    config = NViewConfig()
    for part in fields(config):
        group = getattr(config, part.name)
        for field in fields(group):
            for factor in (1 / FACTOR, FACTOR) if args.numbers is None or field.name in args.numbers else ():
                other = replace(group, **{field.name: factor * getattr(group, field.name)})
                said = compare_matchings(before, match_all(scenes, replace(config, **{part.name: other})))
                print(f"{part.name}.{field.name} x {factor:.2f}: {said}", flush=True)


if __name__ == "__main__":
    main()
