"""What the measurements say: slopes, tables for docs/performance.md, and its plot."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

BEGIN, END = "<!-- begin: benchmarks.speed -->", "<!-- end: benchmarks.speed -->"
SHOWN = ("load", "affinity", "matching", "pictures")


def fit_slopes(records: list[dict[str, Any]]) -> dict[str, float]:
    """Exponent of the cost of each stage over all cells."""
    slopes = {}
    for stage in ("affinity", "matching", "pictures"):
        cost = [record["seconds"][stage][1] for record in records]
        pairs = [record["views"] * (record["views"] - 1) / 2 * record["labelled_px"] for record in records]
        size = pairs if stage == "affinity" else [record["masks"] * record["views"] for record in records]
        slopes[stage] = round(float(np.polyfit(np.log(size), np.log(cost), 1)[0]), 2)
    return slopes


def table_lines(
    records: list[dict[str, Any]], rivals: dict[str, float], slopes: dict[str, dict[str, float]]
) -> list[str]:
    """Markdown: one row per cell, CPU seconds; the base scene in full, with the rivals; the slopes. "a / b" is now /
    previous."""
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
    cell = _base_cell(records)
    base = [of[cell, name] for name in ("now", "previous") if (cell, name) in of]
    lines += ["", f"| {cell[0]} views, {cell[1]} leaves, {cell[2]} Mpx | CPU s | wall s |", "|---|---|---|"]
    for stage in base[0]["seconds"]:
        wall, cpu = (" / ".join(f"{record['seconds'][stage][n]:.3g}" for record in base) for n in (0, 1))
        lines.append(f"| {stage} | {cpu} | {wall} |")
    lines += [f"| {name} | {seconds:.3g} | |" for name, seconds in rivals.items()]
    lines.append("")
    for version, exponents in sorted(slopes.items()):
        growth = ", ".join(f"{stage} {exponent:g}" for stage, exponent in exponents.items())
        lines.append(f"Slopes, {version}: {growth}.")
    return lines


def write_between(page: str, lines: list[str]) -> str:
    """The page with these lines between its two marks, BEGIN and END.

    Raises:
        ValueError: the page does not have each mark once.
    """
    if page.count(BEGIN) != 1 or page.count(END) != 1:
        raise ValueError(f"expected '{BEGIN}' and '{END}' once each on the page")
    head, rest = page.split(BEGIN)
    return "\n".join((head + BEGIN, "", *lines, "", END)) + rest.split(END)[1]


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
