"""`mvseg train`: fine-tune a Mask R-CNN."""

from __future__ import annotations

import logging
import os
from typing import Any

from jsonargparse import ArgumentParser, Namespace

from mvseg.cli.options import CheckedConfig, build_options
from mvseg.training.config import TrainConfig


def add(verbs: Any) -> None:
    """Add the verb to the parser's sub-commands."""
    parser = ArgumentParser(exit_on_error=False, description="Fine-tune a Mask R-CNN; see configs/train/.")
    help_config = "YAML file with any of these options; train/rosettes.yaml and train/finetune-coco.yaml ship"
    parser.add_argument("--config", action=CheckedConfig, help=help_config)
    parser.add_class_arguments(TrainConfig)
    verbs.add_subcommand("train", parser, help="fine-tune a Mask R-CNN")


def run(args: Namespace) -> int:
    """Run the verb; returns the exit code."""
    from mvseg.training.loop import train

    is_first = os.environ.get("RANK", "0") == "0"  # under torchrun only one process logs
    logging.basicConfig(level=logging.INFO if is_first else logging.WARNING, format="%(message)s")
    train(build_options(TrainConfig, args))
    return 0
