"""YAML files: checks that make them safe to parse.

PyYAML recurses as deep as Python's stack, and a file of 300 bytes with nested aliases expands into billions of values.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml  # type: ignore[import-untyped]

from mvseg.errors import InputError
from mvseg.formats.text_file import read_text

MAX_DEPTH, MAX_DIGITS = 32, 400


def check_yaml(path: Path) -> None:
    """Check a file of options before it is parsed.

    Raises:
        InputError: it cannot be read, is larger than 1 MB, not UTF-8 or not YAML, is nested more than 32 deep, uses
            aliases, or holds a number of more than 400 digits.
    """
    read_yaml(path, "a YAML file of options", loader=yaml.BaseLoader)


def read_yaml(path: Path, expected: str, *, loader: Any = yaml.SafeLoader) -> Any:
    """What a YAML file holds; a line of OpenCV, "%YAML:1.0", is left out.

    Raises:
        InputError: see `check_yaml`; names the path and what was expected.
    """
    lines = read_text(path, expected).split("\n")
    text = "\n".join("" if line.startswith("%YAML:") else line for line in lines)
    try:
        _check_events(path, text)
        return yaml.load(text, loader)
    except InputError:
        raise
    except Exception as error:  # yaml raises its own kinds, and those of what it builds
        raise InputError(f"{path}: is not a YAML file ({' '.join(str(error).split())}), expected {expected}") from None


def _check_events(path: Path, text: str) -> None:
    depth = 0
    for event in yaml.parse(text, Loader=yaml.SafeLoader):  # event by event: nothing is built
        line = event.start_mark.line + 1
        if isinstance(event, yaml.AliasEvent):
            raise InputError(f"{path}: line {line} has the alias *{event.anchor}, expected plain values")
        if isinstance(event, yaml.CollectionStartEvent):
            depth += 1
            if depth > MAX_DEPTH:
                raise InputError(f"{path}: line {line} is nested more than {MAX_DEPTH} deep, expected plain values")
        elif isinstance(event, yaml.CollectionEndEvent):
            depth -= 1
        elif isinstance(event, yaml.ScalarEvent) and len(event.value) > MAX_DIGITS and event.value[1:].isdigit():
            raise InputError(f"{path}: line {line} holds a number of {len(event.value)} digits")
