"""Compare the ids of a result with true labels, or two annotators with each other."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

from jsonargparse import ArgumentParser, Namespace

from mvseg.system.say import say


def add_options(parser: ArgumentParser) -> None:
    parser.add_argument("result", type=Path, help="result folder, the --out of mvseg match, or label PNGs")
    parser.add_argument("--truth", type=Path, required=True, help="folder of label PNGs with the true ids, or a result")


def run(args: Namespace) -> int:
    from mvseg.evaluation.id_metrics import matching_metrics
    from mvseg.evaluation.panoptic import compare_annotators, leaf_metrics
    from mvseg.evaluation.truth import true_instances
    from mvseg.regions import IGNORE_LABEL
    from mvseg.results.earlier import check_file
    from mvseg.results.read import find_result, read_instances
    from mvseg.system.atomic import write_text_whole

    result = find_result(args.result)
    if result != args.result:
        say(f"mvseg: {result}: the only result in {args.result}", to_stderr=True)
    check_file(result / "metrics.json", b'"s_match"')
    regions, truth = read_instances(result, args.truth)
    ids, true = regions.labels, true_instances(regions, truth)
    is_scored = (true != 0) & (true != IGNORE_LABEL)
    metrics: dict[str, Any] = dataclasses.asdict(matching_metrics(ids[is_scored], true[is_scored]))
    metrics |= {"no_instance": int((true == 0).sum()), "ignored": int((true == IGNORE_LABEL).sum())}
    metrics |= dataclasses.asdict(leaf_metrics(regions, ids, truth))
    agreement = compare_annotators(regions, ids, truth)
    metrics |= {"alone": agreement.alone, "missed": agreement.missed}
    metrics |= {f"iou_{leaf}_{other}": iou for leaf, other, iou in agreement.shared}
    if metrics["no_instance"]:
        message = f"{metrics['no_instance']} of {len(ids)} masks show no true leaf: left out of the scores of the ids"
        say(f"mvseg: warning: {message}", to_stderr=True)
    for name, value in metrics.items():
        shown = ",".join(map(str, value)) or "none" if isinstance(value, tuple) else value
        say(f"{name:18} {shown:.4f}" if isinstance(shown, float) else f"{name:18} {shown}")
    if (result / "instances.json").is_file():  # not labels of somebody
        write_text_whole(result / "metrics.json", json.dumps(metrics, indent=1) + "\n")
    return 0
