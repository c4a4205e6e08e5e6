"""The command `mvseg <verb>`. Every verb takes its options from the command line and from YAML (`--config FILE`)."""

from __future__ import annotations

import argparse
import dataclasses
import itertools
import json
import logging
import os
import sys
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal, TypeVar

from jsonargparse import ActionConfigFile, ArgumentParser, Namespace  # type: ignore[attr-defined]  # documented

from mvseg._version import __version__
from mvseg.config import RunConfig
from mvseg.demo import demo_scene
from mvseg.errors import InputError, InputWarning
from mvseg.formats.yaml_file import check_yaml
from mvseg.matching.config import MatchConfig
from mvseg.multiview.config import DetectConfig
from mvseg.reconstruction.config import ReconstructConfig
from mvseg.sigterm import Terminated, stopped_by_sigterm
from mvseg.training.config import TrainConfig
from mvseg.traits.config import TraitsConfig, Up

DEFAULT_OUT = Path("results")
Options = TypeVar("Options", MatchConfig, DetectConfig, ReconstructConfig, TraitsConfig, TrainConfig)
BAD_INPUT, INTERRUPTED, TERMINATED = 2, 130, 143
ABOUT = "The same instance, with the same id, in every calibrated view and in 3D."


def main(argv: Sequence[str] | None = None) -> int:
    """Run one verb.

    Args:
        argv: arguments after the program's name; None for those of the process.

    Returns:
        The exit code: 0, or 2 after one sentence on stderr that says what was wrong with the input; 130 after Ctrl-C,
        143 after SIGTERM.
    """
    # Let idle threads sleep: on a shared machine, spinning ones slow small tensor operations tenfold. Must be set
    # before torch is loaded, which the verbs do when they start.
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    os.environ.setdefault("OPENCV_LOG_LEVEL", "SILENT")  # mvseg reports a broken image itself, once
    verbs = {"infer": _infer, "match": _match, "eval": _eval, "train": _train, "simulate": _simulate,
             "models": _models}  # fmt: skip
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("always", InputWarning)
            args = _parse(_join_up(sys.argv[1:] if argv is None else argv))
            with stopped_by_sigterm():
                return verbs[args.verb](args[args.verb])
    except (InputError, argparse.ArgumentError) as error:
        return _complain(error)
    except BrokenPipeError:  # `mvseg eval ... | head`: the reader has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except OSError as error:  # a full disk, a folder that cannot be made
        return _complain(error)
    except MemoryError as error:
        return _complain(InputError(f"there is not enough memory ({error or 'no more is known'})"))
    except KeyboardInterrupt:
        print("mvseg: interrupted", file=sys.stderr)
        return INTERRUPTED
    except Terminated:
        print("mvseg: stopped by SIGTERM", file=sys.stderr)
        return TERMINATED


def _parse(arguments: Sequence[str]) -> Namespace:
    try:
        args = build_parser().parse_args(list(arguments))
        for name in ("quiet", "split_merged", "coco_crowd"):
            if args.verb and name in args[args.verb] and args[args.verb][name] is None:
                raise InputError(f"{name} is null, expected a value")
        return args
    except (UnicodeDecodeError, RecursionError) as error:  # of a file that an option names
        raise InputError(f"the options cannot be read ({error})") from None
    except ValueError as error:
        if isinstance(error, InputError) or "integer string conversion" not in str(error):
            raise
        raise InputError("an option is a number of thousands of digits") from None


def _build(kind: type[Options], args: Namespace | None, prefix: str = "") -> Options:
    """The options of one stage. "epochs:" without a value is null in YAML, which jsonargparse lets pass everywhere."""
    fields = dataclasses.fields(kind)
    if args is None:
        raise InputError(f"{prefix.rstrip('.')} is null, expected options")
    for field in fields:
        if args[field.name] is None and "None" not in str(field.type):
            raise InputError(f"{prefix}{field.name} is null, expected a value")
    return kind(**{field.name: args[field.name] for field in fields})


class _CheckedConfig(ActionConfigFile):
    """The option --config FILE, whose file is checked before jsonargparse reads it."""

    def __call__(self, parser: Any, cfg: Any, values: Any, option_string: str | None = None) -> None:
        check_yaml(Path(values))
        super().__call__(parser, cfg, values, option_string)


def build_parser() -> ArgumentParser:
    """The parser of all verbs; its errors are raised, not printed."""
    parser = ArgumentParser(prog="mvseg", description=ABOUT, exit_on_error=False, version=__version__)
    verbs = parser.add_subcommands(dest="verb")

    infer = ArgumentParser(exit_on_error=False, description="Ids in every view, shapes in 3D and traits, of one scene.")
    help_scene = "scene folder (photos, cameras of any kind in docs/formats.md); without it, the plant that ships"
    infer.add_argument("scene", nargs="?", type=Path | None, help=help_scene)
    _add_options(infer, masks=None)
    infer.add_class_arguments(DetectConfig, "detect")
    infer.add_class_arguments(ReconstructConfig, "reconstruct")
    infer.add_class_arguments(TraitsConfig, "traits")
    infer.add_argument("--scale", type=float | None, help="multiplies the world's lengths, for cameras without a scale")
    infer.add_argument("--unit", type=str | None, help="name of the world's unit, after --scale (default: the scene's)")
    help_up = "which way is up: X Y Z, 'rig' (level cameras) or 'board' (flat ArUco markers); default: the scene's own"
    infer.add_argument("--up", type=str | list[float] | None, help=help_up)
    help_rims = "draw the rims of the surfaces, as the cameras see them, into overlay/"
    infer.add_argument("--draw_rims", type=bool, default=True, help=help_rims)
    verbs.add_subcommand("infer", infer, help="ids and 3D shapes of one scene")

    match = ArgumentParser(exit_on_error=False, description="Ids only, of any number of scenes.")
    match.add_argument("scenes", nargs="+", type=Path, help="scene folders")
    _add_options(match, masks=Path("masks"))
    help_reconstruct = "has no effect; it lets infer and match share their YAML files"
    match.add_argument("--reconstruct", type=ReconstructConfig | None, help=help_reconstruct)
    verbs.add_subcommand("match", match, help="ids only, of any number of scenes")

    evaluate = ArgumentParser(exit_on_error=False, description="Compare the ids of a result with true labels.")
    evaluate.add_argument("result", type=Path, help="result folder, or the --out of mvseg match")
    evaluate.add_argument("--truth", type=Path, required=True, help="folder of label PNGs with the true ids")
    verbs.add_subcommand("eval", evaluate, help="compare a result with true labels")

    train = ArgumentParser(exit_on_error=False, description="Fine-tune a Mask R-CNN; see configs/train/.")
    train.add_argument("--config", action=_CheckedConfig, help="YAML file with any of these options")
    train.add_class_arguments(TrainConfig)
    verbs.add_subcommand("train", train, help="fine-tune a Mask R-CNN")

    simulate = ArgumentParser(exit_on_error=False, description="Render plants with known answers.")
    simulate.add_argument("preset", help="paper-eval (144 scenes of 3 to 20 photos) or train (888 of 9 photos)")
    simulate.add_argument("--out", type=Path, required=True, help="folder for the scenes; finished ones are kept")
    simulate.add_argument("--seed", type=int, default=0, help="for everything that is random")
    simulate.add_argument("--num_workers", type=int, default=1, help="scenes rendered at once")
    verbs.add_subcommand("simulate", simulate, help="render plants with known answers")

    models = ArgumentParser(exit_on_error=False, description="List the shipped detectors, or pack one of your own.")
    models.add_argument("--pack", type=Path | None, help="output folder of a finished training run")
    models.add_argument("--into", type=Path | None, help="folder for the packed detector, with --pack")
    models.add_argument("--image_size", type=int | None, help="longer side that photos are scaled to, with --pack")
    verbs.add_subcommand("models", models, help="the detectors that ship with mvseg")
    return parser


def _add_options(parser: ArgumentParser, masks: Path | None) -> None:
    parser.add_argument("--config", action=_CheckedConfig, help="YAML file with any of these options")
    parser.add_argument(
        "--masks",
        type=Path | None,
        default=masks,
        help="masks (label images, COCO, labelme, YOLO, SAM, NumPy, cellpose; docs/formats.md), in the scene folder or "
        "anywhere; without it, infer detects leaves",
    )
    parser.add_argument("--out", type=Path | None, help="result folder, or folder of results (default: under results/)")
    parser.add_argument("--quiet", action="store_true", help="no progress bars")
    parser.add_argument("--split_merged", type=bool, default=False, help="cut masks that cover two instances in two")
    parser.add_argument(
        "--coco_crowd",
        type=Literal["mask", "ignore"],
        default="mask",
        help="whether COCO annotations with iscrowd are masks like all others, or left out",
    )
    parser.add_argument(
        "--categories", type=str | None, help="names of the categories of masks to take, as leaf,petiole (default: all)"
    )
    parser.add_class_arguments(MatchConfig, "match")


def _infer(args: Namespace) -> int:
    if args.scene is None:
        print("mvseg: no SCENE given: this is the plant that ships with mvseg", file=sys.stderr)
    scene = args.scene or demo_scene()
    out = args.out or DEFAULT_OUT / scene.resolve().name
    config = RunConfig(
        detect=_build(DetectConfig, args.detect, "detect."),
        match=_build(MatchConfig, args.match, "match."),
        reconstruct=_build(ReconstructConfig, args.reconstruct, "reconstruct."),
        traits=_build(TraitsConfig, args.traits, "traits."),
        scale=args.scale,
        unit=args.unit,
        up=_read_up(args.up),
        split_merged=args.split_merged,
        draw_rims=args.draw_rims,
        coco_crowd=args.coco_crowd,
        categories=args.categories,
    )
    _run(scene, args.masks, out, config=config, quiet=args.quiet)
    return 0


def _join_up(argv: Sequence[str]) -> list[str]:
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


def _read_up(up: str | list[float] | None) -> Up | None:
    if up is None:
        return None
    if up == "rig":
        return "rig"
    if up == "board":
        return "board"
    words = up.replace(",", " ").split() if isinstance(up, str) else [str(number) for number in up]
    if len(words) != 3 or not all(_is_number(word) for word in words):
        raise InputError(f"up is '{' '.join(words)}', expected three numbers, as in 0 0 1, rig or board")
    x, y, z = (float(word) for word in words)
    return x, y, z


def _match(args: Namespace) -> int:
    names = [scene.resolve().name for scene in args.scenes]
    for name in names:
        if names.count(name) > 1:
            raise InputError(f"two scenes are called '{name}', expected different names: each names a folder in --out")
    if args.masks is None:
        raise InputError("masks is null, expected the masks to match; use mvseg infer to detect them in the photos")
    code, out = 0, args.out or DEFAULT_OUT
    config = RunConfig(
        match=_build(MatchConfig, args.match, "match."),
        reconstruct=None,
        split_merged=args.split_merged,
        coco_crowd=args.coco_crowd,
        categories=args.categories,
    )
    for scene, name in zip(args.scenes, names, strict=True):
        try:
            _run(scene, args.masks, out / name, config=config, quiet=args.quiet)
        except InputError as error:  # the other scenes still get their results
            code = _complain(error)
    return code


def _run(scene: Path, masks: Path | None, out: Path, *, config: RunConfig, quiet: bool) -> None:
    """One scene from its folder to its result folder; InputWarnings go to stderr and to run.json."""
    from mvseg.formats.atomic import sweep_abandoned
    from mvseg.multiview.kept_detections import delete_kept
    from mvseg.pipeline import run_scene  # keeps --help and wrong options quick
    from mvseg.results.earlier import check_out
    from mvseg.results.folder import save_result
    from mvseg.results.provenance import describe_run

    sweep_abandoned(out)
    check_out(out)
    replaces = " (in place of an earlier result)" if out.is_dir() and any(out.iterdir()) else ""
    masks = None if masks is None else _find_masks(scene, masks)
    keep = out.resolve().with_name(f"{out.resolve().name}.detections")
    if masks is None and keep.is_dir():
        print(f"mvseg: going on from the detections that a run left in {keep}", file=sys.stderr)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", InputWarning)
        if masks is not None and config.detect != DetectConfig():
            warnings.warn("the detect options have no effect: masks are given", InputWarning, stacklevel=1)
        result = run_scene(scene, masks, config, keep=keep, progress=not quiet)
    # each matching of a detector's loop may repeat a warning
    messages = list(dict.fromkeys(str(each.message) for each in caught if issubclass(each.category, InputWarning)))
    for other in (each for each in caught if not issubclass(each.category, InputWarning)):
        warnings.warn_explicit(other.message, other.category, other.filename, other.lineno)
    for message in messages:
        print(f"mvseg: warning: {message}", file=sys.stderr)
    run = describe_run(result, masks, config, messages=messages)
    run["config"] = {"scene": str(scene), "out": str(out)} | run["config"]
    save_result(result, out, run, progress=not quiet, draw_rims=config.draw_rims)
    delete_kept(keep)
    num_masks, num_views = len(result.regions), len(result.scene.views)
    masks_of_kind = f"{num_masks} masks ({result.mask_kind})" if result.mask_kind else f"{num_masks} masks"
    print(f"{out}: {result.matching.num_instances} instances from {masks_of_kind} in {num_views} views{replaces}")


def _find_masks(scene: Path, masks: Path) -> Path:
    """A relative path may start at the scene folder or at the current one, as long as only one of the two exists."""
    inside = scene / masks
    if inside.exists() and masks.exists() and not inside.samefile(masks):
        raise InputError(f"both {inside} and {masks.resolve()} exist, expected --masks with the full path of one")
    return inside if inside.exists() else masks


def _eval(args: Namespace) -> int:
    from mvseg.evaluation.id_metrics import matching_metrics
    from mvseg.evaluation.panoptic import leaf_metrics
    from mvseg.evaluation.truth import shown_instances
    from mvseg.formats.atomic import write_text_whole
    from mvseg.regions import IGNORE_LABEL
    from mvseg.results.read import find_result, read_instances

    result = find_result(args.result)
    if result != args.result:
        print(f"mvseg: {result}: the only result in {args.result}", file=sys.stderr)
    regions, truth = read_instances(result, args.truth)
    ids, true = regions.labels, shown_instances(regions, truth)
    is_scored = (true != 0) & (true != IGNORE_LABEL)
    metrics: dict[str, Any] = dataclasses.asdict(matching_metrics(ids[is_scored], true[is_scored]))
    metrics |= {"no_instance": int((true == 0).sum()), "ignored": int((true == IGNORE_LABEL).sum())}
    metrics |= dataclasses.asdict(leaf_metrics(regions, ids, truth))
    if metrics["no_instance"]:
        message = f"{metrics['no_instance']} of {len(ids)} masks show no true leaf: no part of the scores of the ids"
        print(f"mvseg: warning: {message}", file=sys.stderr)
    for name, value in metrics.items():
        print(f"{name:18} {value:.4f}" if isinstance(value, float) else f"{name:18} {value}")
    try:
        write_text_whole(result / "metrics.json", json.dumps(metrics, indent=1) + "\n")
    except OSError as error:
        raise InputError(f"{result}: cannot write metrics.json ({error.strerror})") from None
    return 0


def _train(args: Namespace) -> int:
    from mvseg.training.loop import train

    is_first = os.environ.get("RANK", "0") == "0"  # under torchrun only one process logs
    logging.basicConfig(level=logging.INFO if is_first else logging.WARNING, format="%(message)s")
    train(_build(TrainConfig, args))
    return 0


def _models(args: Namespace) -> int:
    from mvseg.detectors.zoo import list_detectors
    from mvseg.training.pack import pack_detector

    if (args.pack is None) != (args.into is None):
        raise InputError("--pack and --into belong together, expected both or neither")
    if args.pack is not None:
        pack_detector(args.pack, args.into, args.image_size)
        return 0
    for entry in list_detectors():
        scores = entry.metrics.get("test") or entry.metrics.get("validation") or {}
        measured = [scores[name] for name in ("mask_AP", "mask_AP50") if scores.get(name) is not None]
        shown = "mask AP {:.3f}, AP50 {:.3f}".format(*measured) if len(measured) == 2 else "not measured"
        size = f"{entry.weights.stat().st_size / 1e6:.0f} MB" if entry.weights.is_file() else "weights missing"
        print(f"{entry.name:15} {size}, {shown}; {entry.weights.parent / 'card.md'}")
    return 0


def _simulate(args: Namespace) -> int:
    try:
        from mvseg.simulation.dataset import write_dataset
    except ModuleNotFoundError as error:
        raise InputError(f"simulate needs {error.name}: pip install 'mvseg[simulate]'") from error
    write_dataset(args.preset, args.out, seed=args.seed, num_workers=args.num_workers)
    return 0


def _complain(error: Exception) -> int:
    if isinstance(error, OSError) and error.filename:
        error = InputError(f"{error.filename}: {error.strerror}")
    print(f"mvseg: error: {' '.join(str(error).split())}", file=sys.stderr)
    return BAD_INPUT


if __name__ == "__main__":
    sys.exit(main())
