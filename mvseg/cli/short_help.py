"""Help on one screen: the options that most people use; `--help_all` shows all of them."""

from __future__ import annotations

import argparse

from jsonargparse import ArgumentParser

# The verbs with more options than a screen has lines, and what `--help` shows of them.
MOST_USED = {
    "pose": ("photos", "out", "marker", "board", "distance", "positions", "unit", "up", "turntable"),
    "infer": ("scene", "masks", "out", "config", "scale", "unit", "up", "color_card", "detect.weights",
              "detect.image_size", "split_merged", "num_workers"),
    "batch": ("scenes", "masks", "out", "config", "resume", "num_workers", "scheduler", "scale", "unit", "up",
              "color_card", "detect.weights"),
    "match": ("scenes", "masks", "out", "config", "split_merged", "categories", "match.method", "refine_poses"),
    "train": ("photos", "labels", "output", "val_photos", "val_labels", "config", "arch", "weights", "image_size",
              "epochs", "resume"),
}  # fmt: skip


def shorten_help(verb: str, parser: ArgumentParser) -> None:
    """Let the help of a verb show its most used options only, without their types."""
    if verb not in MOST_USED:
        return
    places = []
    for action in parser._actions:
        if action.dest != "help" and action.dest not in MOST_USED[verb]:
            action.help = argparse.SUPPRESS
        elif not action.option_strings:
            places.append(f"[{action.dest}]" if action.nargs == "?" else action.dest)
        elif action.required:
            places.insert(0, f"--{action.dest} {action.dest.upper()}")
    parser.formatter_class = argparse.HelpFormatter
    parser.usage = f"mvseg {verb} [options] {' '.join(places)}"
    parser.epilog = f"mvseg {verb} --help_all shows all options."
