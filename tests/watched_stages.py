"""Which steps structure from motion takes."""

from __future__ import annotations

import pytest

from mvseg.poses import mapping


def watch_stages(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The steps that find_structure takes, in order."""
    steps: list[str] = []

    def watched(name: str):
        function = getattr(mapping, name)

        def call(*args, **options):
            steps.append(f"{name} {len(args[2])}" if name == "match_features" else name)
            return function(*args, **options)

        return call

    for name in ("find_features", "extract_features", "match_features", "_map"):
        monkeypatch.setattr(mapping, name, watched(name))
    return steps
