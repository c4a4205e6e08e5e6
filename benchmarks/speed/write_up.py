"""What the measurements say: slopes, tables for docs/performance.md, and its plot."""

from __future__ import annotations

import json
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

SHOWN = ("load", "affinity", "matching", "pictures")


def write_all(into: Path, records: list[dict[str, Any]], threads: list[dict[str, Any]]) -> None:
    """The JSON, the plot and the tables; without records of the growth, what is there of it stays."""
    report: dict[str, Any] = {"threads": threads}
    tables = {"threads": threads_lines(threads)}
    if records:
        versions = sorted({record["version"] for record in records})
        slopes = {name: fit_slopes([record for record in records if record["version"] == name]) for name in versions}
        report |= {"cells": records, "slopes": slopes}
        tables["growth"] = growth_lines(records, slopes)
        draw_plot(records, into / "performance.png")
    earlier = into / "performance.json"
    if earlier.is_file():
        report = json.loads(earlier.read_text(encoding="utf-8")) | report
    earlier.write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")
    page = into / "performance.md"
    text = page.read_text(encoding="utf-8") if page.is_file() else ""
    for name, lines in tables.items():
        print("\n".join([*lines, ""]))
        text = write_between(text, lines, name=name) if text else ""
    if text:
        page.write_text(text, encoding="utf-8")


def fit_slopes(records: list[dict[str, Any]]) -> dict[str, float]:
    """Exponent of the cost of each stage over all cells."""
    slopes = {}
    for stage in ("affinity", "matching", "pictures"):
        cost = [record["seconds"][stage][1] for record in records]
        pairs = [record["views"] * (record["views"] - 1) / 2 * record["labelled_px"] for record in records]
        size = pairs if stage == "affinity" else [record["masks"] * record["views"] for record in records]
        slopes[stage] = round(float(np.polyfit(np.log(size), np.log(cost), 1)[0]), 2)
    return slopes


def growth_lines(records: list[dict[str, Any]], slopes: dict[str, dict[str, float]]) -> list[str]:
    """Markdown: one row per cell, CPU seconds; the slopes. "a / b" is now / previous."""
    cells = list(dict.fromkeys(tuple(record["cell"]) for record in records))
    of = {(tuple(record["cell"]), record["version"]): record for record in records}
    lines = ["| views | leaves | Mpx | masks | " + " | ".join(SHOWN) + " | GB | ids |", "|---" * (6 + len(SHOWN)) + "|"]
    for cell in cells:
        now, previous = of[cell, "now"], of.get((cell, "previous"))
        figures = []
        for stage in SHOWN:
            both = [record["seconds"][stage][1] for record in (now, previous) if record]
            figures.append(" / ".join(f"{seconds:.2f}" for seconds in both))
        memory = " / ".join(f"{record['matching_GB']:.2f}" for record in (now, previous) if record)
        ids = "" if previous is None else "same" if now["ids"] == previous["ids"] else "differ"
        row = [*map(str, cell), str(now["masks"]), *figures, memory, ids]
        lines.append(f"| {' | '.join(row)} |")
    lines.append("")
    for version, exponents in sorted(slopes.items()):
        growth = ", ".join(f"{stage} {exponent:g}" for stage, exponent in exponents.items())
        lines.append(f"Slopes, {version}: {growth}.")
    return lines


def threads_lines(records: list[dict[str, Any]]) -> list[str]:
    """Markdown: one row per stage, with one and with two threads. "a / b" is now / previous."""
    of = {(record["version"], record["threads"]): record for record in records}
    views, leaves, megapixels = records[0]["cell"]
    base = f"{views} views, {leaves} leaves, {megapixels} Mpx"
    lines = [f"| {base} | CPU s, one thread | wall s, one thread | wall s, two threads |", "|---|---|---|---|"]
    one = [of[version, 1] for version in ("now", "previous") if (version, 1) in of]
    for stage, (two, _) in of["now", 2]["seconds"].items():
        wall, cpu = (" / ".join(f"{record['seconds'][stage][n]:.3g}" for record in one) for n in (0, 1))
        lines.append(f"| {stage} | {cpu} | {wall} | {two:.3g} |")
    return lines


def write_between(page: str, lines: list[str], *, name: str) -> str:
    """The page with these lines between its two marks of that name.

    Raises:
        ValueError: the page does not have each mark once.
    """
    begin, end = (f"<!-- {side}: benchmarks.speed, {name} -->" for side in ("begin", "end"))
    if page.count(begin) != 1 or page.count(end) != 1:
        raise ValueError(f"expected '{begin}' and '{end}' once each on the page")
    head, rest = page.split(begin)
    return "\n".join((head + begin, "", *lines, "", end)) + rest.split(end)[1]


def _base_cell(records: list[dict[str, Any]]) -> tuple[Any, ...]:
    """The cell that lies on all axes: it has the most common number of views, of leaves and of megapixels."""
    views, leaves, megapixels = (
        Counter(record["cell"][axis] for record in records).most_common(1)[0][0] for axis in range(3)
    )
    return views, leaves, megapixels


def draw_plot(records: list[dict[str, Any]], path: Path) -> None:
    """CPU seconds along each axis, on logarithmic scales; the version before is dashed."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    base = _base_cell(records)
    figure, axes = plt.subplots(1, 3, figsize=(11, 3.6), sharey=True)
    for axis, (panel, title) in enumerate(zip(axes, ("views", "leaves", "megapixels"), strict=True)):
        others = [n for n in range(3) if n != axis]
        for version, style in (("now", "-"), ("previous", "--")):
            on_axis = [
                record
                for record in records
                if record["version"] == version and all(record["cell"][n] == base[n] for n in others)
            ]
            on_axis.sort(key=lambda record: record["cell"][axis])
            for color, stage in enumerate(("load", "affinity", "matching", "pictures")):
                x = [record["cell"][axis] for record in on_axis]
                y = [record["seconds"][stage][1] for record in on_axis]
                label = stage if version == "now" else None
                panel.plot(x, y, style, color=f"C{color}", marker="o", markersize=3, label=label)
        panel.set(xscale="log", yscale="log", xlabel=title)
        ticks = sorted({record["cell"][axis] for record in records})
        panel.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
        panel.minorticks_off()
        panel.grid(alpha=0.3)
    axes[0].set_ylabel("CPU seconds, one thread")
    axes[2].legend(fontsize=8)
    figure.tight_layout()
    figure.savefig(path, dpi=110)
