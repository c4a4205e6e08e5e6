"""Accuracy and shape error against the number of cameras and of leaves, with the paper's values."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from benchmarks.paper_tables import printed
from benchmarks.paper_tables.averages import Average, average_columns, measure
from benchmarks.paper_tables.experiments import Plan
from benchmarks.paper_tables.methods import PRINTED
from benchmarks.paper_tables.shapes import DEFAULT_SHARE
from benchmarks.paper_tables.tables import axes, read_matches, read_shapes

COLORS = {"MVS-based": "tab:green", "Point-based": "tab:orange", "Sparse": "tab:purple", "MVIS (paper)": "tab:blue"}
COLORS |= {"MVIS (one-per-view)": "tab:cyan", "MVIS (nview)": "tab:red"}


def plot_all(plan: Plan, out: Path) -> list[Path]:
    """Write the plots; returns their paths. There are none without matplotlib, which is an extra ("benchmark")."""
    try:
        import matplotlib
    except ModuleNotFoundError:
        return []
    matplotlib.use("Agg")
    plots = [plot_matches(plan, kind, out) for kind in plan.kinds if read_matches(plan, kind)]
    return [*plots, plot_shapes(plan, out)] if read_shapes(plan) else plots


def plot_matches(plan: Plan, kind: str, out: Path) -> Path:
    """s_match and ARI against cameras and leaves, for one kind of masks."""
    from matplotlib import pyplot

    views, leaves = axes(plan)
    figure, panels = pyplot.subplots(2, 2, figsize=(9, 6.4), sharey="row", layout="constrained")
    for row, (key, name) in enumerate((("s_match", "s_match"), ("ari", "ARI"))):
        for method, records in read_matches(plan, kind).items():
            columns = average_columns(records, measure(key), views=views, leaves=leaves)
            style = {"color": COLORS[method], "marker": "o", "markersize": 4, "label": method}
            draw_line(panels[row, 0], views, columns[: len(views)], **style)
            draw_line(panels[row, 1], leaves, columns[len(views) : -1], **style)
        panels[row, 0].set_ylabel(name)
    for method, values in printed.TABLE_1["s_match"].items():
        color = next(COLORS[ours] for ours, paper in PRINTED.items() if paper == method)
        style = {"color": color, "marker": "s", "markersize": 5, "mfc": "none", "ls": ":", "label": f"paper: {method}"}
        panels[0, 0].plot(printed.VIEWS, values[:4], **style)
        panels[0, 1].plot(printed.LEAVES, values[4:8], **style)
    label_axis(panels[1, 0], views, "cameras")
    label_axis(panels[1, 1], leaves, "leaves")
    for panel in panels[0]:
        panel.set_xscale("log", base=2)
    panels[0, 0].set_xticks(views, views)
    panels[0, 1].set_xticks(leaves, leaves)
    figure.legend(*panels[0, 0].get_legend_handles_labels(), loc="outside lower center", ncol=4, fontsize=8)
    figure.suptitle(f"masks: {kind}", fontsize=10)
    return save_plot(figure, out / f"benchmarks-{kind.split()[0]}.png")


def plot_shapes(plan: Plan, out: Path) -> Path:
    """d(I, T) against cameras, and against leaves with 10 cameras."""
    from matplotlib import pyplot

    views, leaves = axes(plan)
    at = 10 if 10 in views else max(views)
    lines = {
        "MVS points": ("tab:green", "0.5"),
        "semantic segmentation, true masks": ("tab:gray", "0.5"),
        "MVIS (paper), true masks": ("tab:blue", "0.5"),
        "MVIS (nview), true masks": ("tab:red", "0.5"),
        "MVIS (nview), true masks, hidden parts": ("black", DEFAULT_SHARE),
    }
    shapes = read_shapes(plan, lines)
    figure, panels = pyplot.subplots(1, 2, figsize=(9, 3.9), sharey=True, layout="constrained")
    for name, (color, threshold) in lines.items():
        if name in shapes:
            columns = average_columns(shapes[name], measure(threshold, "d"), views=views, leaves=leaves, leaves_at=at)
            style = {"color": color, "marker": "o", "markersize": 4, "label": name}
            draw_line(panels[0], views, columns[: len(views)], **style)
            draw_line(panels[1], leaves, columns[len(views) : -1], **style)
    paper = zip(printed.TABLE_3.items(), ("tab:green", "tab:gray", "tab:blue"), strict=True)
    for (method, values), color in paper:
        style = {"color": color, "marker": "s", "markersize": 5, "mfc": "none", "ls": ":", "label": f"paper: {method}"}
        for panel, numbers, some in ((panels[0], printed.VIEWS, values[:4]), (panels[1], printed.LEAVES, values[4:8])):
            points = [(n, value) for n, value in zip(numbers, some, strict=True) if value is not None]
            panel.plot(*zip(*points, strict=True), **style)
    label_axis(panels[0], views, "cameras")
    label_axis(panels[1], leaves, f"leaves ({at} cameras)")
    panels[0].set_yscale("log")
    panels[0].set_ylabel("d(I, T) / mean leaf length")
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower center", ncol=3, fontsize=8)
    return save_plot(figure, out / "benchmarks-shapes.png")


def draw_line(panel: Any, numbers: Sequence[int], averages: Sequence[Average], **style: Any) -> None:
    """Draw averages against numbers, without those that have no value."""
    points = [(n, mean.value) for n, mean in zip(numbers, averages, strict=True) if mean.value is not None]
    if points:
        panel.plot(*zip(*points, strict=True), **style)


def label_axis(panel: Any, numbers: Sequence[int], label: str) -> None:
    """Give a panel a logarithmic x axis with ticks at the numbers."""
    panel.set_xscale("log", base=2)
    panel.set_xticks(numbers, numbers)
    panel.set_xlabel(label)


def save_plot(figure: Any, path: Path) -> Path:
    """Write a PNG that depends on the figure alone, not on the time or the version of matplotlib."""
    from matplotlib import pyplot

    figure.savefig(path, dpi=110, metadata={"Software": None})
    pyplot.close(figure)
    return path
