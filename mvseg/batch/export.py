"""The traits of a batch in the forms that databases and journals require."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

from mvseg._version import __version__
from mvseg.batch.brapi import brapi_observations
from mvseg.batch.miappe import describe_batch
from mvseg.batch.observations import read_observations
from mvseg.errors import InputError
from mvseg.results.earlier import RUN_FILE, check_out, keep_user_files, list_files
from mvseg.system.atomic import folder_whole
from mvseg.traits.table import write_csv

BRAPI_FILE = "brapi_observations.json"


def export_batch(batch: Path, out: Path, *, miappe: bool, brapi: bool, factors: Sequence[str] = ()) -> int:
    """Write the folder of an export, whole or not at all; an earlier one is replaced, the user's files there stay.

    Args:
        batch: the --out of `mvseg batch`.
        out: the folder.
        miappe, brapi: which forms, see `describe_batch` and `brapi_observations`.
        factors: columns of the batch's table that are experimental factors in MIAPPE.

    Returns:
        How many observations there are.

    Raises:
        InputError: neither form is requested, the batch cannot be read, or its table lacks required columns.
        OSError: the folder cannot be written.
    """
    if not miappe and not brapi:
        raise InputError("neither --miappe nor --brapi is given, expected one or both")
    check_out(out)
    observations = read_observations(batch)
    tables = describe_batch(observations, factors) if miappe else {}
    with folder_whole(out) as partial:
        for name, table in tables.items():
            write_csv(partial / f"{name}.csv", list(table[0]), [list(row.values()) for row in table])
        if brapi:
            text = json.dumps(brapi_observations(observations), indent=1, ensure_ascii=False)
            (partial / BRAPI_FILE).write_text(text + "\n", encoding="utf-8")
        about = {"mvseg": __version__, "batch": str(batch), "observations": len(observations)}
        text = json.dumps(about | {"files": list_files(partial)}, indent=1)
        (partial / RUN_FILE).write_text(text + "\n", encoding="utf-8")
        keep_user_files(out, partial)
    return len(observations)
