"""The numbers of a batch with the facts of its table about each plant, as data standards require."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

from mvseg.batch.tables import read_table
from mvseg.errors import InputError

OWN_COLUMNS = ("leaf", "trait", "value", "sd", "unit", "method", "ontology")


@dataclass(frozen=True)
class Observation:
    """One number.

    Attributes:
        facts: {column: cell} of the batch's table: `scene`, `plant`, `time` and all others.
        leaf: number of the leaf, "" for the whole plant.
        trait, value, sd, unit, method, ontology: as in traits.csv.
    """

    facts: Mapping[str, str]
    leaf: str
    trait: str
    value: str
    sd: str
    unit: str
    method: str
    ontology: str

    @property
    def variable(self) -> str:
        """Name of the variable: what is observed, by which method, in which scale: leaf_area_mvseg_mm2."""
        scale = re.sub(r"\W", "", self.unit)
        return f"{'leaf_' if self.leaf else ''}{self.trait}_mvseg_{scale}"

    @property
    def title(self) -> str:
        """The trait in words: leaf area."""
        return f"{'leaf ' if self.leaf else ''}{self.trait.replace('_', ' ')}"

    @property
    def time_stamp(self) -> str:
        """Time of the observation in ISO 8601 with a time zone (UTC if `time` names none); "" if `time` is not a
        date."""
        try:
            time = datetime.fromisoformat(self.facts["time"])
        except ValueError:
            return ""
        return time.isoformat() + ("" if time.tzinfo else "Z")


def read_observations(batch: Path) -> list[Observation]:
    """All numbers of a batch that exist, in the order of its tables.

    Raises:
        InputError: see `read_table`; or there are no numbers.
    """
    rows = read_table(batch, "traits.csv", ("scene", "plant", "time", *OWN_COLUMNS))
    found = [
        Observation({name: cell for name, cell in row.items() if name not in OWN_COLUMNS},
                    **{name: row[name] for name in OWN_COLUMNS})
        for row in rows if row["value"]
    ]  # fmt: skip
    if not found:
        raise InputError(f"{batch}: holds no numbers, expected the traits of one plant or more")
    return found
