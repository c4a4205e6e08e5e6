"""Fine-tune a Mask R-CNN; see configs/train/."""

from __future__ import annotations

import logging
import os

from jsonargparse import ArgumentParser, Namespace

from mvseg.cli.options import CheckedConfig, build_options
from mvseg.training.config import TrainConfig


def add_options(parser: ArgumentParser) -> None:
    help_config = "YAML file with any of these options; train/rosettes.yaml and train/finetune-coco.yaml ship"
    parser.add_argument("--config", action=CheckedConfig, help=help_config)
    parser.add_class_arguments(TrainConfig)


def run(args: Namespace) -> int:
    from mvseg.training.loop import train

    is_first = os.environ.get("RANK", "0") == "0"  # under torchrun only one process logs
    logging.basicConfig(level=logging.INFO if is_first else logging.WARNING, format="%(message)s")
    train(build_options(TrainConfig, args))
    return 0
