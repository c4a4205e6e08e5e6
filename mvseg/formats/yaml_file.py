"""YAML files of options: what a parser may safely be given.

PyYAML itself follows brackets as deep as Python's stack, and a file of 300 bytes whose aliases name each other unfolds
into thousands of millions of values.
"""

from __future__ import annotations

from pathlib import Path

import yaml  # type: ignore[import-untyped]

from mvseg.errors import InputError

MAX_BYTES, MAX_DEPTH, MAX_DIGITS = 1 << 20, 32, 400


def check_yaml(path: Path) -> None:
    """Check a file of options before it is parsed.

    Raises:
        InputError: it cannot be read, is larger than 1 MB, no UTF-8 or no YAML, is nested more than 32 deep, uses
            aliases, or holds a number of more than 400 digits.
    """
    try:
        with path.open("rb") as file:
            data = file.read(MAX_BYTES + 1)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}), expected a YAML file of options") from None
    if len(data) > MAX_BYTES:
        raise InputError(f"{path}: is larger than {MAX_BYTES} bytes, expected a YAML file of options")
    try:
        text = data.decode()
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: byte {error.start} is no UTF-8, expected a YAML file of options") from None
    try:
        check_yaml_text(path, text)
    except yaml.YAMLError as error:
        raise InputError(f"{path}: is no YAML file ({' '.join(str(error).split())})") from None


def check_yaml_text(path: Path, text: str) -> None:
    """Check the text of a YAML file; messages name the path.

    Raises:
        InputError: it is nested more than 32 deep, uses aliases, or holds a number of more than 400 digits.
        yaml.YAMLError: it is no YAML.
    """
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
