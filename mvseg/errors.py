"""Bad input: an exception that ends a run with one sentence, and a warning that does not."""

from __future__ import annotations

import inspect
import math
import sys
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import wraps
from types import UnionType
from typing import Literal, ParamSpec, TypeVar, Union, get_args, get_origin, get_type_hints

from mvseg.findings.finding import Finding, keep_causes

UNIONS = (Union, UnionType)
P = ParamSpec("P")
T = TypeVar("T")
# Classes that users mix up, with what makes one.
OWN = {
    "Cameras": "of a scene: scene.cameras",
    "Regions": "regions_from_masks and load_masks make them",
    "Masks": "Masks.of makes them of regions and ids",
    "Scene": "load_scene reads one",
    "Matching": "match_regions gives one",
    "Tensor": "torch.as_tensor makes one of an array",
    "RunConfig": "RunConfig(views=12)",
    "MatchConfig": "MatchConfig(method='nview')",
    "ReconstructConfig": "ReconstructConfig(shape='voxels')",
    "Path | str": "the place of a folder or a file",
}


class InputError(ValueError):
    """Wrong input from the user (a file, a camera, a mask, an option).

    The message is one sentence that names the file, the view or the index, and what was expected. The command line
    prints it and exits with code 2; from Python it is an ordinary `ValueError`.
    """


class InputWarning(UserWarning):
    """The input is odd but usable: the warning of a finding, and its sentence. Kept in a result's `run.json`."""

    @property
    def finding(self) -> Finding:
        """The finding, to be told by its code."""
        finding: Finding = self.args[0]
        return finding


def warn(finding: Finding | Warning) -> None:
    """Warn (InputWarning) as of the line outside of this package that led here; one that was caught is repeated."""
    frame, level = sys._getframe(1), 2
    while frame.f_back is not None and frame.f_globals.get("__name__", "").startswith("mvseg."):
        frame, level = frame.f_back, level + 1
    warnings.warn(InputWarning(finding) if isinstance(finding, Finding) else finding, stacklevel=level)


@contextmanager
def collect_warnings() -> Iterator[list[Finding]]:
    """Collect the findings of InputWarnings inside the block, each once, when it ends, also by an exception; they are
    not given. Other warnings are."""
    findings: list[Finding] = []
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", InputWarning)
        try:
            yield findings
        finally:
            for each in caught:
                if isinstance(each.message, InputWarning) and each.message.finding not in findings:
                    findings.append(each.message.finding)
    for other in (each for each in caught if not issubclass(each.category, InputWarning)):
        warnings.warn_explicit(other.message, other.category, other.filename, other.lineno)


@contextmanager
def note_warnings() -> Iterator[list[Finding]]:
    """As `collect_warnings`; those that no other one explains are given when the block ends, also by an exception."""
    findings: list[Finding] = []
    try:
        with collect_warnings() as findings:
            yield findings
    finally:
        for finding in keep_causes(findings):
            warn(finding)


def say_fault(error: OSError | MemoryError) -> str:
    """Reason why the system refuses, in words: a folder that cannot be made, a full disk, more memory."""
    if isinstance(error, MemoryError):
        return f"there is not enough memory ({str(error) or 'no more is known'})"
    return f"{error.filename}: {error.strerror}" if error.filename else str(error)


@contextmanager
def faults_of(where: object) -> Iterator[None]:
    """Put the place, as a file or a view, in front of the reason of any InputError that is raised inside."""
    try:
        yield
    except InputError as error:
        raise InputError(f"{where}: {error}") from None


def check_arguments(function: Callable[P, T]) -> Callable[P, T]:
    """Decorates a public function: an argument that should be one of `OWN`, by the signature, and is none, is refused
    with one sentence (InputError), in place of an AttributeError from somewhere inside."""
    signature = inspect.signature(function)
    named = {name: str(each.annotation) for name, each in signature.parameters.items() if str(each.annotation) in OWN}

    @wraps(function)
    def checked(*args: P.args, **kwargs: P.kwargs) -> T:
        given = signature.bind(*args, **kwargs).arguments
        for name in named.keys() & given.keys():
            classes = [each.__name__ for each in type(given[name]).__mro__]
            if not {*named[name].split(" | ")} & {*classes}:
                raise InputError(f"{name} is a {classes[0]}, expected {named[name]} ({OWN[named[name]]})")
        return function(*args, **kwargs)

    return checked


def check_ranges(config: object, place: str = "", /, **ranges: tuple[float, float]) -> None:
    """Refuse a number of a field of a config that is not finite or outside its range, ends included; `place` as in
    `check_choices`. Raises InputError: names the field, the value, and the range."""
    for name, (low, high) in ranges.items():
        value = getattr(config, name)
        if isinstance(value, int | float) and not (low <= value <= high and value != math.inf):
            expected = f"at least {low}" if high == math.inf else f"a number from {low} to {high}"
            raise InputError(f"{place}.{name} is {value:.12g}, expected {expected}".removeprefix("."))


def check_choices(config: object, place: str = "") -> None:
    """Refuse a value of a field of a frozen config that is none of its `Literal`, and none of the other types that the
    field may have; `place` is the name of its group of options, "" for those that have none. Raises InputError: names
    the field, the value, and the choices."""
    for name, hint in get_type_hints(type(config)).items():
        value, members = getattr(config, name), get_args(hint) if get_origin(hint) in UNIONS else (hint,)
        choices = [each for member in members if get_origin(member) is Literal for each in get_args(member)]
        if not choices or (isinstance(value, str) and value in choices):
            continue
        types = [member for member in members if isinstance(member, type)]
        is_number = int in types and type(value) is int
        is_other = any(get_origin(member) is not Literal and member is not int for member in members)
        if not is_number and (isinstance(value, str) or not is_other or (int in types and value is not None)):
            expected = ", ".join([*(["a number"] if int in types else []), *map(str, choices)])
            where = f"{place}.{name}" if place else name
            raise InputError(f"{where} is {value!r}, expected one of {expected}")
