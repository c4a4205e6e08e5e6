"""Options that several verbs share, and how they become the configs of the stages."""

from __future__ import annotations

import dataclasses
import itertools
import json
from collections.abc import Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any, Literal, TypeVar

from jsonargparse import ActionConfigFile, ArgumentParser, Namespace  # type: ignore[attr-defined]  # documented

from mvseg.config import RunConfig
from mvseg.detection.config import DetectConfig
from mvseg.errors import InputError
from mvseg.formats.text_file import read_yaml
from mvseg.matching.config import MatchConfig
from mvseg.poses.config import PoseConfig
from mvseg.reconstruction.config import ReconstructConfig
from mvseg.training.config import TrainConfig
from mvseg.traits.config import TraitsConfig, Up

DEFAULT_OUT = Path("results")
CAN_BE_OFF = ("stems", "crop", "learn")  # options with that word
# an installed mvseg carries configs/ inside the package, a checkout has it beside the package
CONFIG_HOMES = (Path(str(files("mvseg") / "configs")), Path(str(files("mvseg"))).parent / "configs")
STAGES = {"detect": DetectConfig, "match": MatchConfig, "reconstruct": ReconstructConfig, "traits": TraitsConfig}
Options = TypeVar("Options", MatchConfig, DetectConfig, ReconstructConfig, TraitsConfig, TrainConfig, PoseConfig)


def build_options(kind: type[Options], args: Namespace | None, prefix: str = "") -> Options:
    """The options of one stage. "epochs:" without a value is null in YAML, which jsonargparse lets pass everywhere."""
    fields = dataclasses.fields(kind)
    if args is None:
        raise InputError(f"{prefix.rstrip('.')} is null, expected options")
    for field in fields:
        if args[field.name] is None and "None" not in str(field.type):
            raise InputError(f"{prefix}{field.name} is null, expected a value")
    return kind(**{field.name: args[field.name] for field in fields})


class CheckedConfig(ActionConfigFile):
    """The option --config FILE, whose file is checked before jsonargparse reads it."""

    def __call__(self, parser: Any, cfg: Any, values: Any, option_string: str | None = None) -> None:
        path = find_config(str(values))
        content = read_yaml(path, "a YAML file of options")
        words = _with_words(content)
        super().__call__(parser, cfg, str(path) if words == content else json.dumps(words), option_string)


def _with_words(options: Any) -> Any:
    """The same options with "off" in place of false, which YAML makes of off, where that is a choice."""
    if not isinstance(options, dict):
        return options
    return {name: "off" if own is False and name in CAN_BE_OFF else _with_words(own) for name, own in options.items()}


def find_config(name: str) -> Path:
    """The YAML file that --config names: a path, or else a file that ships, as paper.yaml or train/rosettes.yaml.
    Raises InputError, which lists those that ship, if there is neither."""
    if Path(name).exists():
        return Path(name)
    for home in CONFIG_HOMES:
        if (home / name).is_file() and not Path(name).is_absolute() and ".." not in Path(name).parts:
            return home / name
    shipped = sorted({path.relative_to(home).as_posix() for home in CONFIG_HOMES for path in home.rglob("*.yaml")})
    raise InputError(f"{name}: no such file, expected a YAML file of options, or one that ships: {', '.join(shipped)}")


# Options that several verbs have: type (None: a flag), default, help.
SHARED: dict[str, tuple[Any, Any, str]] = {
    "masks": (Path | None, None, "masks (label images, COCO, labelme, YOLO, SAM, NumPy; docs/formats.md), in the scene "
              "folder or anywhere; infer without it detects leaves"),
    "coco_crowd": (Literal["mask", "ignore"], "mask",
                   "whether COCO annotations with iscrowd are masks like all others, or left out"),
    "categories": (str | None, None, "names of the categories of masks to take, as leaf,petiole (default: all)"),
    "up": (str | list[float] | None, None,
           "which way is up: X Y Z, 'rig' (level cameras) or 'board' (flat ArUco markers); default: the cameras'"),
    "corrections": (Path | None, None, "file of the user's corrections, in the scene folder or anywhere; "
                    "docs/corrections.md"),
    "force_corrections": (bool, False, "apply --corrections even if they were made for other photos"),
    "overwrite": (bool, False, "replace what mvseg wrote to --out even if it is another scene's, or no result"),
    "num_workers": (int | None, None, "processes that fit surfaces (default: one per core, but at most 4)"),
    "quiet": (None, False, "no progress line"),
}  # fmt: skip


OF_REQUEST = ("corrections", "force_corrections", "overwrite")  # fields of a `RunRequest` that are options, too


def add_shared(parser: ArgumentParser, *names: str) -> None:
    for name in names:
        kind, default, about = SHARED[name]
        form = {"action": "store_true"} if kind is None else {"type": kind, "default": default}
        parser.add_argument(f"--{name}", help=about, **form)


def add_matching_options(parser: ArgumentParser, masks: Path | None = None) -> None:
    """The options of every verb that matches; `masks` is the default of --masks."""
    parser.add_argument("--config", action=CheckedConfig, help="YAML file with any of these options; paper.yaml ships")
    add_shared(parser, "masks", "coco_crowd", "categories", "quiet")
    parser.set_defaults(masks=masks)
    parser.add_argument("--out", type=Path | None, help="result folder, or folder of results (default: under results/)")
    parser.add_argument("--report", type=bool, default=True, help="write report.html, the result as one page")
    parser.add_class_arguments(MatchConfig, "match")


def add_run_options(parser: ArgumentParser) -> None:
    """The options of a whole run, from photos or masks to traits; `build_run` reads them."""
    add_matching_options(parser)
    help_views = "take so many views, evenly spread around the plant, or 'all' (default: all with --masks, or else 20)"
    parser.add_argument("--views", type=int | Literal["all"] | None, help=help_views)
    help_learn = "rounds in which the views teach the detector; auto: where it does not know the species"
    parser.add_argument("--learn", type=int | bool | Literal["auto", "off"], default="auto", help=help_learn)
    help_stem = "category of the masks of stems, beside --categories of leaves: they count as no leaves"
    parser.add_argument("--stem_category", type=str | None, help=help_stem)
    for name in ("detect", "reconstruct", "traits"):
        parser.add_class_arguments(STAGES[name], name)
    help_scale = "multiplies the world's lengths; cameras that say their unit need --unit with it"
    parser.add_argument("--scale", type=float | None, help=help_scale)
    help_unit = "name of the world's unit, after --scale (default: the scene's)"
    parser.add_argument("--unit", type=str | None, help=help_unit)
    add_shared(parser, "up")


def build_run(args: Namespace) -> RunConfig:
    """The options that `add_run_options` added."""
    plain = ("views", "scale", "unit", "report", "coco_crowd", "categories", "stem_category")
    stages: dict[str, Any] = {name: build_options(kind, args[name], f"{name}.") for name, kind in STAGES.items()}
    learn: Any = "off" if args.learn is False else args.learn  # YAML takes off for false
    return RunConfig(**stages, learn=learn, up=read_up(args.up), **{name: args[name] for name in plain})


def join_up(argv: Sequence[str]) -> list[str]:
    """The three numbers after --up as one argument: a list would swallow the scene folder that may follow."""
    if "--up" not in argv:
        return list(argv)
    start = argv.index("--up") + 1
    numbers = list(itertools.takewhile(_is_number, argv[start : start + 3]))
    return [*argv[:start], " ".join(numbers), *argv[start + len(numbers) :]] if numbers else list(argv)


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def read_up(up: Any) -> Up | None:
    """Read --up: three numbers, "rig", "board", or nothing. Raises InputError for anything else."""
    if up in (None, "rig", "board"):
        return up
    words = up.replace(",", " ").split() if isinstance(up, str) else [str(number) for number in up]
    if len(words) != 3 or not all(_is_number(word) for word in words):
        raise InputError(f"up is '{' '.join(words)}', expected three numbers, as in 0 0 1, rig or board")
    x, y, z = (float(word) for word in words)
    return x, y, z
