"""JSON files that people write: read, and checked against a pydantic model; each fault is one sentence."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any, TypeVar

from pydantic import BaseModel, FailFast, Field, FiniteFloat, ValidationError

from mvseg.errors import InputError
from mvseg.formats.image_file import MAX_SIDE

Vector3 = tuple[FiniteFloat, FiniteFloat, FiniteFloat]
Matrix3 = tuple[Vector3, Vector3, Vector3]
Pixels = Annotated[int, Field(ge=1, le=MAX_SIDE)]
Int64 = Annotated[int, Field(ge=-(2**63), lt=2**63)]
Item = TypeVar("Item")


class _FirstFault(FailFast):
    """Stops at the first invalid item; pydantic would otherwise describe all of five million."""

    __hash__ = object.__hash__  # unions need one


Items = Annotated[list[Item], _FirstFault()]
Model = TypeVar("Model", bound=BaseModel)


def read_json(path: Path, model: type[Model]) -> Model:
    """Read a JSON file as `model`. Raises InputError, which names the file and the key, if it is missing, is not JSON,
    or does not fit the model."""
    return check_content(path, load_json(path), model)


def load_json(path: Path, *, most: int | None = None) -> Any:
    """Content of a JSON file, unchecked. Raises InputError if it is missing, exceeds `most` bytes, or is no JSON."""
    try:
        if most is not None and path.stat().st_size > most:
            raise InputError(f"{path}: has {path.stat().st_size} bytes, expected at most {most}")
        return json.loads(path.read_text(encoding="utf-8-sig"))  # Windows editors write a byte order mark
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from None
    except InputError:
        raise
    except (ValueError, RecursionError) as error:  # bad UTF-8, bad JSON, numbers of thousands of digits
        raise InputError(f"{path}: not a whole JSON file ({error})") from None


def check_content(path: Path, content: Any, model: type[Model], *, expected: str = "") -> Model:
    """Content of a file, as `model`. Raises InputError, with file, key and what was expected, if it does not fit."""
    try:
        return model.model_validate(content)
    except ValidationError as error:
        first = error.errors()[0]
        key = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in first["loc"]).lstrip(".")
        message = first["msg"].partition(" or instance of ")[0]  # of a class that users never see
        end = f", expected {expected}" if expected else ""
        raise InputError(f"{path}: {key + ': ' if key else ''}{message}{end}") from None
