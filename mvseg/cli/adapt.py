"""`mvseg adapt`: fine-tune a detector on photos of known cameras, without labels."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

from jsonargparse import ArgumentParser, Namespace

from mvseg.adaptation.config import AdaptConfig
from mvseg.cli.options import CheckedConfig, build_options
from mvseg.config import RunConfig
from mvseg.detection.config import DetectConfig
from mvseg.matching.config import MatchConfig


def add(verbs: Any) -> None:
    """Add the verb to the parser's sub-commands."""
    about = "Fine-tune a detector on the photos of scenes: masks that other views confirm are its labels."
    parser = ArgumentParser(exit_on_error=False, description=about)
    parser.add_argument("scenes", nargs="+", type=Path, help="scene folders with photos")
    parser.add_argument("--config", action=CheckedConfig, help="YAML file with any of these options")
    parser.add_argument("--out", type=Path, required=True, help="folder of the weights; a stopped run goes on")
    parser.add_argument("--quiet", action="store_true", help="no progress bars")
    parser.add_class_arguments(AdaptConfig, "adapt")
    parser.add_class_arguments(DetectConfig, "detect")
    parser.add_class_arguments(MatchConfig, "match")
    verbs.add_subcommand("adapt", parser, help="fine-tune a detector without labels")


def run(args: Namespace) -> int:
    """Run the verb; returns the exit code."""
    from mvseg.adaptation.adapt import adapt_detector

    logging.basicConfig(level=logging.INFO, format="%(message)s")
    config = RunConfig(
        detect=build_options(DetectConfig, args.detect, "detect."),
        match=build_options(MatchConfig, args.match, "match."),
    )
    adapt = build_options(AdaptConfig, args.adapt, "adapt.")
    before, after = adapt_detector(args.scenes, args.out, adapt, run=config, progress=not args.quiet)
    for when, agreement in (("before", before), ("after", after)):
        print(f"{when}: {agreement.num_found} masks found, {agreement.num_kept} left when the other views are heard")
    weights = args.out / "weights.safetensors"
    print(f"{weights}: for --detect.weights")
    return 0
