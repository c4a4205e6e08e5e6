"""The processes that train together: one alone, or those that torchrun started."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, TypeVar

import torch
import torch.distributed as dist
from torch import Tensor

from mvseg.errors import InputError

T = TypeVar("T")


@dataclass(frozen=True)
class Processes:
    """This process among those that train together. The first has `rank` 0 and writes the files."""

    rank: int
    count: int
    device: torch.device

    @property
    def is_first(self) -> bool:
        return self.rank == 0

    def ask_first(self, question: Callable[[], T]) -> T:
        """Ask in the first process only; every process gets the answer; likewise the InputError that it raises."""
        answer: list[Any] = [None]
        if self.is_first:
            try:
                answer = [question()]
            except InputError as error:
                answer = [error]
        if self.count > 1:
            dist.broadcast_object_list(answer)
        if isinstance(answer[0], InputError):
            raise answer[0]
        return answer[0]

    def gather(self, items: list[T]) -> list[T]:
        """The lists of all processes in one."""
        if self.count == 1:
            return items
        lists: list[Any] = [None] * self.count
        dist.all_gather_object(lists, items)
        return [item for part in lists for item in part]

    def add_up(self, values: dict[str, Tensor]) -> dict[str, float]:
        """The sums over all processes of scalars that every process has."""
        stacked = torch.stack(list(values.values()))
        if self.count > 1:
            dist.all_reduce(stacked)
        return dict(zip(values, stacked.tolist(), strict=True))


@contextmanager
def join_processes(device: str) -> Iterator[Processes]:
    """Join the other processes that torchrun started (gloo on CPUs, nccl on GPUs); alone without torchrun.

    `device` is "cpu", "cuda" or "auto" (a GPU when there is one); with GPUs, each process of a machine takes its own.
    Raises InputError: an unknown device, or one that this machine lacks; environment variables of torchrun are no
    numbers.
    """
    rank, count, local_rank = (_read_number(key) for key in ("RANK", "WORLD_SIZE", "LOCAL_RANK"))
    kind = ("cuda" if torch.cuda.is_available() else "cpu") if device == "auto" else device
    if kind not in ("cpu", "cuda") or (kind == "cuda" and local_rank >= torch.cuda.device_count()):
        raise InputError(f"device '{device}' (process {local_rank}) is not available, expected cpu, cuda or auto")
    chosen = torch.device("cpu") if kind == "cpu" else torch.device("cuda", local_rank)
    if kind == "cuda":
        torch.cuda.set_device(chosen)
    if count <= 1:
        yield Processes(0, 1, chosen)
        return
    dist.init_process_group("nccl" if kind == "cuda" else "gloo")
    yield Processes(rank, count, chosen)
    dist.destroy_process_group()  # not after an exception: it would wait for processes that wait for this one


def _read_number(key: str) -> int:
    value = os.environ.get(key, "0")
    if not (value.isascii() and value.isdigit() and len(value) < 10):
        raise InputError(f"the environment variable {key} is '{value[:20]}', expected a number as torchrun sets it")
    return int(value)
