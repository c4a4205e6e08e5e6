"""List the shipped detectors."""

from __future__ import annotations

from jsonargparse import ArgumentParser, Namespace

from mvseg.system.say import say


def add_options(parser: ArgumentParser) -> None:
    """The verb has none."""


def run(args: Namespace) -> int:
    from mvseg.detectors.zoo import list_detectors

    for entry in list_detectors():
        scores = entry.metrics.get("test") or entry.metrics.get("validation") or {}
        measured = [scores[name] for name in ("mask_AP", "mask_AP50") if scores.get(name) is not None]
        shown = "mask AP {:.3f}, AP50 {:.3f}".format(*measured) if len(measured) == 2 else "not measured"
        size = f"{entry.weights.stat().st_size / 1e6:.0f} MB" if entry.weights.is_file() else "weights missing"
        say(f"{entry.name:15} {size}, {shown}; {entry.weights.parent / 'card.md'}")
    return 0
