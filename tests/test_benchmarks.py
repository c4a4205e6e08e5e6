"""Every script of `benchmarks/` still finds what it imports from mvseg, and says what it does: nobody runs most of them
for weeks."""

from __future__ import annotations

import importlib
import inspect
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
SCRIPTS = sorted(
    ".".join(path.relative_to(ROOT).with_suffix("").parts)
    for path in (ROOT / "benchmarks").rglob("*.py")
    if path.stem not in ("__init__", "__main__")
)


def test_they_are_imported_and_print_their_help(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert len(SCRIPTS) > 40
    for name in SCRIPTS:
        script = importlib.import_module(name)
        assert script.__doc__, name
        main = getattr(script, "main", None)
        if main is None or inspect.signature(main).parameters or "ArgumentParser(" not in inspect.getsource(script):
            continue
        monkeypatch.setattr("sys.argv", [name, "--help"])
        with pytest.raises(SystemExit) as stopped:
            main()
        assert stopped.value.code == 0, name
        assert capsys.readouterr().out.startswith("usage:"), name
