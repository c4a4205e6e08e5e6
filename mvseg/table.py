"""One base of tables: a row for each thing, a column for each fact about it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, Self

import numpy as np
import torch
from torch import Tensor

from mvseg.errors import InputError


@dataclass(frozen=True, eq=False)
class Table:
    """N rows. Columns are the fields with tensors, arrays or tables; other fields are about all rows. The first field
    is a column of N rows; a table with columns of other lengths says how rows are picked from these (`_pick_rows`)."""

    def __len__(self) -> int:
        return len(getattr(self, fields(self)[0].name))

    @property
    def columns(self) -> dict[str, Any]:
        """{name: column}."""
        every = {each.name: getattr(self, each.name) for each in fields(self)}
        return {name: each for name, each in every.items() if isinstance(each, Tensor | np.ndarray | Table)}

    @property
    def device(self) -> torch.device:
        """Device of the first column."""
        return torch.device(getattr(self, fields(self)[0].name).device)

    def to(self, device: torch.device | str) -> Self:
        """Move all tensors to a device; a table that is there is returned as it is."""
        if {each.device for each in self.columns.values()} == {torch.device(device)}:
            return self
        return replace(self, **{name: each.to(device) for name, each in self.columns.items()})

    def select(self, index: Any) -> Self:
        """Select the rows at an integer index, or where a bool mask is true, in that order. Raises InputError: a mask
        of another length; IndexError: there is no such row."""
        if index.dtype in (bool, torch.bool):
            if len(index) != len(self):
                raise InputError(f"a bool index of {len(index)} for {len(self)} rows, expected one per row")
            index = index.nonzero()[:, 0] if isinstance(index, Tensor) else index.nonzero()[0]
        return replace(self, **self._pick_rows(index))

    def _pick_rows(self, index: Any) -> dict[str, Any]:
        """{name: column} of the rows at an integer index."""
        return {name: _pick(column, index) for name, column in self.columns.items()}

    @classmethod
    def concatenate(cls, parts: Sequence[Self]) -> Self:
        """The rows of one or more tables, one after another; what is about all rows is that of the first."""
        joined = {name: _join([getattr(each, name) for each in parts]) for name in parts[0].columns}
        return replace(parts[0], **joined)


def _pick(column: Any, index: Any) -> Any:
    if isinstance(column, Table):
        return column.select(index)
    return column.take(index, 0) if isinstance(column, np.ndarray) else column[index]


def _join(columns: Sequence[Any]) -> Any:
    if isinstance(columns[0], Table):
        return columns[0].concatenate(columns)
    return torch.cat(list(columns)) if isinstance(columns[0], Tensor) else np.concatenate(columns)
