"""cellpose's `_seg.npy`: a pickled dict, of which only the array `masks` is read, without executing anything.

Unpickling a file can execute any code. Here every name in the pickle becomes an inert record of its arguments; numpy
never sees them. The array is then built from its recorded shape, type and bytes, after they are checked.
"""

from __future__ import annotations

import pickle
from collections.abc import Callable
from io import BytesIO
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from mvseg.errors import InputError
from mvseg.formats.masks.label_image import labels_of_numbers

KINDS = ("u1", "u2", "u4", "u8", "i1", "i2", "i4", "i8")
ARRAY_NAMES = {(f"numpy.{core}.multiarray", "_reconstruct") for core in ("core", "_core")}
ADVICE = "in cellpose, save the masks as PNG or TIFF instead (File menu, or --save_png)"


class _Record:
    """What stands for every object in the pickle: the arguments it was made with, and the state it was given."""

    def __init__(self, *arguments: Any) -> None:
        self.arguments = arguments
        self.state: Any = None

    def __setstate__(self, state: Any) -> None:
        self.state = state


class _Array(_Record):
    pass


class _Dtype(_Record):
    pass


class _Reader(pickle._Unpickler):
    """The unpickler written in Python: the one in C allocates as much memory as a file claims. It supports what dicts
    of arrays need; keys are text, since the hash of deeply nested ones would overflow the stack."""

    stack: list[Any]
    pop_mark: Callable[[], list[Any]]
    dispatch: ClassVar[dict[int, Any]] = {
        code: load
        for code, load in pickle._Unpickler.dispatch.items()
        if bytes([code]) not in (pickle.BYTEARRAY8, pickle.DICT, pickle.ADDITEMS, pickle.FROZENSET)
    }

    def load_setitem(self) -> None:
        value, key = self.stack.pop(), self.stack.pop()
        self._set_items([key, value])

    def load_setitems(self) -> None:
        items = self.pop_mark()
        self._set_items(items)

    def _set_items(self, items: list[Any]) -> None:
        if not isinstance(self.stack[-1], dict) or any(type(key) is not str for key in items[::2]):
            raise pickle.UnpicklingError("a dict with other keys than text")
        self.stack[-1].update(zip(items[::2], items[1::2], strict=True))

    dispatch[pickle.SETITEM[0]] = load_setitem
    dispatch[pickle.SETITEMS[0]] = load_setitems

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) in ARRAY_NAMES:
            return _Array
        return _Dtype if (module, name) == ("numpy", "dtype") else _Record

    def persistent_load(self, pid: Any) -> Any:
        raise pickle.UnpicklingError("a reference to elsewhere")


def read_cellpose(path: Path, width: int, height: int) -> np.ndarray:
    """(height, width) uint16 labels: the array `masks` of a `_seg.npy`.

    Raises:
        InputError: the file is not as cellpose writes it, or of another size.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}): the mask file is missing") from None
    try:
        file = BytesIO(data)
        version = np.lib.format.read_magic(file)
        read_header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        if not read_header(file)[2].hasobject:
            raise ValueError("no pickle")
        content = _Reader(file).load()
        masks = _find_masks(content)
        shape, labels = _build(masks)
    except Exception:  # a broken or hostile pickle fails in any way
        raise InputError(f"{path}: is not as cellpose writes it; {ADVICE}") from None
    if shape != (height, width):
        size = " x ".join(map(str, shape[::-1]))
        raise InputError(f"{path}: the mask is {size}, its camera says {width} x {height}")
    return labels_of_numbers(path, labels)


def _find_masks(content: Any) -> _Array:
    """The dict is the only item of an array of objects, whose state ends on a list of items."""
    items = content.state[-1] if isinstance(content, _Array) else [content]
    (holder,) = items
    masks = holder["masks"]
    if not isinstance(holder, dict) or not isinstance(masks, _Array):
        raise ValueError("no masks")
    return masks


def _build(record: _Array) -> tuple[tuple[int, ...], np.ndarray]:
    """The shape and the numbers of a recorded array: its state is (version, shape, dtype, is Fortran order, bytes)."""
    _, shape, dtype, is_fortran, data = record.state
    kind, order = dtype.arguments[0], dtype.state[1]
    if kind not in KINDS or order not in ("<", ">", "|") or not isinstance(data, bytes):
        raise ValueError("no whole numbers")
    numbers = np.frombuffer(data, np.dtype(f"{order}{kind}"))
    shape = tuple(int(side) for side in shape)
    return shape, numbers.reshape(shape, order="F" if is_fortran else "C")
