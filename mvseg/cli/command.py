"""Every verb takes its options from the command line and from YAML (`--config FILE`)."""

from __future__ import annotations

import argparse
import os
import sys
import warnings
from collections.abc import Sequence
from importlib.util import find_spec
from types import ModuleType
from typing import Any

from jsonargparse import ArgumentParser, DefaultHelpFormatter, Namespace, set_parsing_settings

from mvseg._version import __version__
from mvseg.cli import batch, check, correct, infer, match, models, pose, simulate, target, track, train
from mvseg.cli import eval as evaluate
from mvseg.cli.complain import complain
from mvseg.cli.options import join_up
from mvseg.errors import InputError, InputWarning, say_fault
from mvseg.system.running import running
from mvseg.system.say import say
from mvseg.system.sigterm import Terminated, stopped_by_sigterm

TERMINATED = 143  # definition: exit code after SIGTERM, as shells have it
ABOUT = "The same instance, with the same id, in every calibrated view and in 3D."
# Each with a few words; `--help` of a verb begins with its docstring.
VERBS: dict[str, tuple[ModuleType, str]] = {
    "pose": (pose, "a scene folder from photos alone"),
    "check": (check, "what would go wrong with a scene"),
    "target": (target, "a page to print, that checks the whole chain"),
    "infer": (infer, "ids and 3D shapes of one scene"),
    "correct": (correct, "correct a result in the browser"),
    "batch": (batch, "many scenes, one table of traits"),
    "track": (track, "the same leaf over days"),
    "match": (match, "ids only, of any number of scenes"),
    "eval": (evaluate, "compare a result with true labels"),
    "train": (train, "fine-tune a Mask R-CNN"),
    "simulate": (simulate, "render plants with ground truth"),
    "models": (models, "the detectors that ship with mvseg"),
}
# The verbs with more options than a screen has lines, and what `--help` shows of them.
MOST_USED = {
    "pose": ("photos", "out", "marker", "board", "distance", "positions", "unit", "up", "turntable"),
    "infer": ("scene", "again", "masks", "out", "config", "scale", "unit", "up", "views", "learn", "detect.weights",
              "num_workers", "corrections"),
    "batch": ("scenes", "masks", "out", "config", "resume", "num_workers", "part", "scale", "unit", "up",
              "detect.weights"),
    "match": ("scenes", "masks", "out", "config", "categories", "match.method"),
    "train": ("photos", "labels", "output", "val_photos", "val_labels", "config", "arch", "weights", "image_size",
              "epochs", "resume"),
}  # fmt: skip


def main(argv: Sequence[str] | None = None) -> int:
    """Run one verb with the arguments after the program's name (None: those of the process).

    Returns the exit code: 0, or 2 after one sentence on stderr that says what was wrong with the input; 1 where `check`
    found an error; 3 when scenes of a batch have failed; 143 after SIGTERM. Raises KeyboardInterrupt after Ctrl-C;
    `mvseg.cli.main` makes 130 of it.
    """
    # Let idle threads sleep: on a shared machine, spinning ones slow small tensor operations tenfold. Must be set
    # before torch is loaded, which the verbs do when they start.
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")
    os.environ.setdefault("OPENCV_LOG_LEVEL", "SILENT")  # mvseg reports a broken image itself, once
    words = sys.argv[1:] if argv is None else argv
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("always", InputWarning)
            warnings.showwarning = _show_warning
            if not words:
                build_parser(short=True).print_help()
                return 0
            args = _parse(join_up(words))
            options = args[args.verb]
            with stopped_by_sigterm(), running(progress=not options.get("quiet", True)):
                return VERBS[args.verb][0].run(options)
    except (InputError, argparse.ArgumentError) as error:
        return complain(error, words, options=_list_names(words) if isinstance(error, argparse.ArgumentError) else ())
    except BrokenPipeError:  # `mvseg eval ... | head`: the reader has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except (OSError, MemoryError) as error:
        return complain(InputError(say_fault(error)))
    except Terminated:
        say("mvseg: stopped by SIGTERM", to_stderr=True)
        return TERMINATED


def _show_warning(message: Warning | str, category: type[Warning], *place: Any, **_: Any) -> None:
    text = f"mvseg: warning: {message}\n"
    if not issubclass(category, InputWarning):
        text = warnings.formatwarning(message, category, *place[:2])
    say(text, end="", to_stderr=True)


def _parse(arguments: Sequence[str]) -> Namespace:
    try:
        if "--print_completion" in arguments:
            if find_spec("shtab") is None:
                raise InputError("--print_completion needs shtab: pip install shtab")
            set_parsing_settings(add_print_completion_argument=True)
        short = not {"--help_all", "--print_completion"} & {*arguments}
        args = build_parser(short=short).parse_args(["--help" if word == "--help_all" else word for word in arguments])
        for name, value in args[args.verb].items() if args.verb else ():
            if value is None and name in ("quiet", "report", "coco_crowd", "overwrite"):
                raise InputError(f"{name} is null, expected a value")
            if "\0" in str(value):  # a YAML file can hold one
                raise InputError(f"{name} is {str(value)!r}, expected text without null characters")
        return args
    except InputError:
        raise
    except (ValueError, RecursionError) as error:  # no UTF-8, a number of thousands of digits
        raise InputError(f"the options cannot be read ({error})") from None


def build_parser(*, short: bool = False) -> ArgumentParser:
    """The parser of all verbs; its errors are raised, not printed. With `short`, `--help` shows some options only."""
    parser = ArgumentParser(prog="mvseg", description=ABOUT, exit_on_error=False, version=__version__)
    parser.formatter_class = _Help
    verbs = parser.add_subcommands(dest="verb")
    for name, (verb, about) in VERBS.items():
        of_verb = ArgumentParser(exit_on_error=False, description=verb.__doc__)
        verb.add_options(of_verb)
        verbs.add_subcommand(name, of_verb, help=about)
        if short and name in MOST_USED:
            _shorten_help(name, of_verb)
    return parser


def _list_names(words: Sequence[str]) -> list[str]:
    verb = next((word for word in words if not word.startswith("-")), "")
    if verb not in VERBS:
        return [*VERBS, "--help", "--version"]
    parser = ArgumentParser(exit_on_error=False)
    VERBS[verb][0].add_options(parser)
    return [name for action in parser._actions for name in action.option_strings if name.startswith("--")]


class _Help(DefaultHelpFormatter):
    def _get_type_str(self, action: argparse.Action) -> str | None:
        text = super()._get_type_str(action)
        return None if text is None else text.replace("<class 'Path'>", "Path")


def _shorten_help(verb: str, parser: ArgumentParser) -> None:
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
