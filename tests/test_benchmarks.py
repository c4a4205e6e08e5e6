"""Every script of `benchmarks/` still finds what it imports from mvseg: nobody runs most of them for weeks."""

from __future__ import annotations

import importlib
from pathlib import Path

ROOT = Path(__file__).parents[1]
SCRIPTS = sorted(
    ".".join(path.relative_to(ROOT).with_suffix("").parts)
    for path in (ROOT / "benchmarks").rglob("*.py")
    if path.stem not in ("__init__", "__main__")
)


def test_they_are_imported() -> None:
    assert len(SCRIPTS) > 50
    assert [name for name in SCRIPTS if not importlib.import_module(name).__doc__] == []
