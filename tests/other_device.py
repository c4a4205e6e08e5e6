"""A second device for machines that have only one: its tensors say "meta", and are computed on the CPU all the same.

What a GPU refuses is refused here: operands on two devices, and NumPy views of what is not on the CPU. Modules are
moved as always, `module.to(device)`, and autocast does to convolutions and products what it does on a GPU.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any
from unittest import mock

import torch
import torchvision  # noqa: F401  # registers torch.ops.torchvision
from torch import Tensor
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode

autocast = torch.autocast  # torch's own
DEVICE = torch.device("meta")  # of those that torch knows everywhere; "cuda" looks for a driver
aten = torch.ops.aten
MOVES = {aten._to_copy.default, aten.copy_.default}
# GPUs take indices from the CPU, too
INDEXING = {aten.index.Tensor, aten.index_put.default, aten.index_put_.default, aten._unsafe_index.Tensor}
# what autocast computes in lower precision, and in float32, of what detectors use
LOWERED = {torch.conv2d, torch.conv_transpose2d, torch.nn.functional.linear}
SINGLE = {torch.ops.torchvision.roi_align, torch.ops.torchvision.nms}


class OtherTensor(Tensor):
    """A tensor of the other device; `inner` holds its values on the CPU."""

    inner: Tensor

    @staticmethod
    def __new__(cls, inner: Tensor) -> OtherTensor:
        made = Tensor._make_wrapper_subclass(cls, inner.shape, strides=inner.stride(), dtype=inner.dtype, device=DEVICE)
        made.inner = inner
        return made

    @classmethod
    def __torch_function__(cls, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        if func in (Tensor.numpy, Tensor.__array__):
            raise TypeError(f"can't convert a tensor on {DEVICE} to NumPy, expected .cpu() before")
        if func in (Tensor.tolist, Tensor.__repr__):
            return func(args[0].inner)
        if func in (Tensor.__getitem__, Tensor.__setitem__):  # torch would make tensors without data of lists
            index = args[1] if isinstance(args[1], tuple) else (args[1],)
            args = (args[0], tuple(map(_list_to_tensor, index)), *args[2:])
        with torch._C.DisableTorchFunctionSubclass():
            return func(*args, **(kwargs or {}))

    @classmethod
    def __torch_dispatch__(cls, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        with _Compute():
            return func(*args, **(kwargs or {}))


class _Compute(TorchDispatchMode):
    """Every operation is done on the CPU, and its results are where a GPU would leave them."""

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = kwargs or {}
        is_there = any(isinstance(each, OtherTensor) for each in _tensors((args, kwargs)))
        checked = (args[0], args[2:]) if func in INDEXING else (args, kwargs)
        strangers = (not isinstance(each, OtherTensor) and each.ndim for each in _tensors(checked))
        if is_there and func not in MOVES and any(strangers):
            raise RuntimeError(f"{func}: expected all tensors on the same device, found {DEVICE} and cpu")
        target = kwargs.get("device")
        plain_args, plain_kwargs = _map(_to_inner, args), _map(_to_inner, kwargs)
        if target is not None:
            plain_kwargs["device"] = torch.device("cpu")
        answer = func(*plain_args, **plain_kwargs)
        if func.__name__.split(".")[0].endswith("_"):  # in place
            return args[0]
        goes_there = is_there if target is None else torch.device(target) == DEVICE
        return _map(_to_other, answer) if goes_there else answer


class _Create(TorchFunctionMode):
    """`torch.tensor(data, device=...)` would make a tensor without data, and torch has no autocast for "meta"."""

    def __init__(self) -> None:
        super().__init__()
        self.lower: torch.dtype | None = None  # while autocast is on, what it casts to

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = dict(kwargs or {})
        if func in (torch.tensor, torch.as_tensor) and kwargs.get("device") is not None:
            return func(*args, **kwargs | {"device": None}).to(kwargs["device"])
        if self.lower is not None and func in LOWERED | SINGLE:
            cast = partial(_cast, dtype=self.lower if func in LOWERED else torch.float32)
            args, kwargs = _map(cast, args), _map(cast, kwargs)
        return func(*args, **kwargs)

    @contextmanager
    def autocast(
        self, device_type: str, dtype: torch.dtype | None = None, enabled: bool = True, **options: Any
    ) -> Iterator[None]:
        if device_type != DEVICE.type:
            with autocast(device_type, dtype, enabled, **options):
                yield
            return
        before, self.lower = self.lower, (dtype or torch.float16) if enabled else None
        try:
            yield
        finally:
            self.lower = before


@contextmanager
def other_device() -> Iterator[torch.device]:
    """While this lasts, tensors can be made on the other device and moved to it."""
    create = _Create()
    with mock.patch.object(torch, "autocast", create.autocast), create, _Compute():
        yield DEVICE


def _tensors(values: Any) -> Iterator[Tensor]:
    """All tensors in tuples, lists and dicts; torch's own walk over them takes longer than most operations."""
    for value in values.values() if isinstance(values, dict) else values:
        if isinstance(value, Tensor):
            yield value
        elif isinstance(value, tuple | list | dict):
            yield from _tensors(value)


def _map(function: Callable[[Any], Any], values: Any) -> Any:
    """The same tuples, lists and dicts of other values."""
    if isinstance(values, tuple | list):
        return type(values)([_map(function, each) for each in values])
    if isinstance(values, dict):
        return {name: _map(function, each) for name, each in values.items()}
    return function(values)


def _cast(value: Any, dtype: torch.dtype) -> Any:
    is_cast = isinstance(value, OtherTensor) and value.is_floating_point() and value.dtype != torch.float64
    return value.to(dtype) if is_cast else value


def _list_to_tensor(value: Any) -> Any:
    return torch.tensor(value) if isinstance(value, list) else value


def _to_inner(value: Any) -> Any:
    return value.inner if isinstance(value, OtherTensor) else value


def _to_other(value: Any) -> Any:
    return OtherTensor(value) if isinstance(value, Tensor) else value
