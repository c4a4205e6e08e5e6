"""Findings that a block warns of, told by their codes: sentences may change."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from mvseg.errors import collect_warnings
from mvseg.findings.finding import Finding


@contextmanager
def warns_of(*codes: str) -> Iterator[list[Finding]]:
    """Expect warnings of these codes, and perhaps others; the list holds all findings once the block has ended."""
    with collect_warnings() as findings:
        yield findings
    noticed = [each.code for each in findings]
    assert {*codes} <= {*noticed}, f"expected {codes}, got {noticed}"
