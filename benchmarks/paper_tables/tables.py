"""The tables of the paper from the records, in Markdown, with the paper's printed rows beside ours."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from benchmarks.paper_tables import printed
from benchmarks.paper_tables.cells import PRESETS, Record, list_cells, read_record
from benchmarks.paper_tables.experiments import Plan, read_records, real_record, slug
from benchmarks.paper_tables.methods import METHODS
from benchmarks.paper_tables.number_of_leaves import RULES
from benchmarks.paper_tables.shapes import DEFAULT_SHARE, SHAPES, THRESHOLDS

MEASURES = {"s_match": ("s_match", 3), "e_k": ("e_k", 2), "ARI": ("ari", 3)}
HALVES = ("d", "excess", "gaps")
Pick = Callable[[Record], float | None]


def print_tables(plan: Plan) -> None:
    """Print the tables of all records so far, as Markdown."""
    for kind in plan.kinds:
        if read_matches(plan, kind):
            print(f"Table 1, {kind} masks: {count_masks(plan, kind)}\n\n{table_1(plan, kind)}\n")
    if any(real_record(plan, folder, method).is_file() for folder in plan.real for method in METHODS):
        print(f"Table 2, real scenes\n\n{table_2(plan)}\n")
    if read_shapes(plan):
        print(f"Table 3, d(I, T) in mean leaf lengths: {table_3(plan)}\n")
        print(f"Thresholds, and parts that other leaves hide: {table_rules(plan)}\n")
    if read_records(plan.records / "numbers" / "true", list_cells(PRESETS[plan.preset])):
        print(f"The number of leaves: {table_numbers(plan)}")


def axes(plan: Plan) -> tuple[list[int], list[int]]:
    """The numbers of cameras and of leaves, the largest first, in the order of the paper's columns."""
    preset = PRESETS[plan.preset]
    return sorted(preset.views, reverse=True), sorted(preset.leaves, reverse=True)


def printed_cells(values: Sequence[float | None], plan: Plan, decimals: int) -> list[str]:
    """Printed values of the columns that the preset has; the average over all columns only if it has them all."""
    views, leaves = axes(plan)
    cells = ["N/A" if value is None else f"{value:.{decimals}f}" for value in values]
    by_views = dict(zip(printed.VIEWS, cells[:4], strict=True))
    by_leaves = dict(zip(printed.LEAVES, cells[4:8], strict=True))
    is_whole = by_views.keys() == set(views) and by_leaves.keys() == set(leaves)
    shown = [by_views.get(n, "-") for n in views] + [by_leaves.get(n, "-") for n in leaves]
    return shown + [cell if is_whole else "-" for cell in cells[8:]]


def read_matches(plan: Plan, kind: str) -> dict[str, list[Record]]:
    """{method: records} of table 1, for one kind of masks."""
    specs = list_cells(PRESETS[plan.preset])
    by_method = {method: read_records(plan.match_records(kind) / slug(method), specs) for method in METHODS}
    return {method: records for method, records in by_method.items() if records}


def read_shapes(plan: Plan) -> dict[str, list[Record]]:
    """{shape: records} of table 3."""
    specs = list_cells(PRESETS[plan.preset])
    by_shape = {name: read_records(plan.records / "shapes" / slug(name), specs) for name in SHAPES}
    return {name: records for name, records in by_shape.items() if records}


def row_name(method: str, records: Sequence[Record]) -> str:
    """The method, with the backend that was used where there is a choice."""
    by = sorted({record["by"] for record in records if "by" in record})
    details = [name[name.index("(") + 1 : -1] for name in by if "(" in name]
    return f"{method} ({', '.join(details)})" if details else method


def table_1(plan: Plan, kind: str) -> str:
    """Every measure of every method, per number of cameras and leaves; the paper's rows, in italics, once: in the
    table of true masks."""
    views, leaves = axes(plan)
    rows = []
    for name, (key, decimals) in MEASURES.items():
        for method, records in read_matches(plan, kind).items():
            columns = average_columns(records, measure(key), views=views, leaves=leaves)
            rows.append([name, row_name(method, records), *(column.text(decimals) for column in columns)])
        for method, values in (printed.TABLE_1.get(name, {}) if kind == "true" else {}).items():
            digits = 3 if name == "s_match" else 2
            rows.append([name, f"*paper: {method}*", *printed_cells(values, plan, digits)])
    header = ["measure", "method", *(f"{n} cams" for n in views), *(f"{n} leaves" for n in leaves), "average"]
    return markdown_table(header, rows)


def count_masks(plan: Plan, kind: str) -> str:
    """One sentence: how many scenes and masks; for detections also how many show no leaf, and how many are missing."""
    by_method = read_matches(plan, kind).values()
    records = next((records for records in by_method if not any("na" in record for record in records)), [])
    total, without, missed = (sum(r.get(key, 0) for r in records) for key in ("masks", "no_leaf", "missed"))
    text = f"{len(records)} of {len(list_cells(PRESETS[plan.preset]))} scenes, {total} masks"
    if without or missed:
        text += f", of which {without} show no leaf (matched, not scored); {missed} true masks have no detection"
    return text + "."


def table_2(plan: Plan) -> str:
    """Every method on every real scene; the paper's own plant for orientation."""
    rows = []
    for folder in plan.real:
        for method in METHODS:
            path = real_record(plan, folder, method)
            if path.is_file():
                record = read_record(path)
                values = [measure(key)(record) for key, _ in MEASURES.values()]
                texts = ["N/A" if value is None else f"{value:.3f}" for value in values]
                rows.append([folder.resolve().name, row_name(method, [record]), *texts])
    for method, (s_match, e_k) in printed.TABLE_2.items():
        rows.append(["*paper: real plant*", f"*{method}*", f"{s_match:.3f}", f"{e_k}", "-"])
    return markdown_table(["scene", "method", *MEASURES], rows)


def table_3(plan: Plan) -> str:
    """d(I, T) per number of cameras, and per number of leaves with 10 cameras; the paper's rows in italics."""
    views, leaves = axes(plan)
    at = 10 if 10 in views else max(views)
    wanted = [
        ("MVS points", "MVS points", "0.5"),
        ("MVS points", "MVS points on leaves", "0.5"),
        ("Semantic segmentation", "semantic segmentation, true masks", "0.5"),
        ("Semantic segmentation", "semantic segmentation, degraded masks", "0.5"),
        ("MVIS", "MVIS (paper), true masks", "0.5"),
        ("MVIS", "MVIS (paper), degraded masks", "0.5"),
        ("MVIS", "MVIS (nview), true masks", "0.5"),
        ("MVIS", "MVIS (nview), degraded masks", "0.5"),
        ("MVIS", "MVIS (nview), true masks, hidden parts", DEFAULT_SHARE),
        ("MVIS", "MVIS (nview), degraded masks, hidden parts", DEFAULT_SHARE),
    ]
    shapes, last = read_shapes(plan), None
    rows = []
    for paper, name, threshold in wanted:
        if paper != last:
            cells = printed_cells(printed.TABLE_3[paper], plan, 3)
            rows.append([f"*paper: {paper}*", *(cells if at == 10 else [*cells[: len(views)], *["-"] * len(leaves)])])
            last = paper
        if name in shapes:
            columns = average_columns(shapes[name], measure(threshold, "d"), views=views, leaves=leaves, leaves_at=at)
            label = name + (f" {threshold}" if "hidden" in name else "")
            rows.append([row_name(label, shapes[name]), *(column.text(3) for column in columns[:-1])])
    header = ["method", *(f"{n} cams" for n in views), *(f"{n} leaves, {at} cams" for n in leaves)]
    return f"{len(next(iter(shapes.values())))} scenes.\n\n{markdown_table(header, rows)}"


def table_rules(plan: Plan) -> str:
    """d and its halves, over all scenes, for every threshold of both rules."""
    wanted = [
        ("share of the masks", "true", "MVIS (nview), true masks"),
        ("hidden parts", "true", "MVIS (nview), true masks, hidden parts"),
        ("share of the masks", "degraded", "MVIS (nview), degraded masks"),
        ("hidden parts", "degraded", "MVIS (nview), degraded masks, hidden parts"),
    ]
    shapes, rows = read_shapes(plan), []
    for rule, kind, name in wanted:
        if name in shapes:
            for threshold in THRESHOLDS:
                text = f"{threshold:g}"
                cells = [average(shapes[name], measure(text, key)).text(3) for key in HALVES]
                rows.append([kind, rule, f"> {text}", *cells])
    table = markdown_table(["masks", "rule", "threshold", *HALVES], rows)
    return f"{len(next(iter(shapes.values())))} scenes.\n\n{table}"


def table_numbers(plan: Plan) -> str:
    """SymNMF with the number of leaves given, and found in ranges: averages over all cells."""
    specs = list_cells(PRESETS[plan.preset])
    kinds = ("true", "degraded")
    records = {kind: read_records(plan.records / "numbers" / slug(kind), specs) for kind in kinds}
    rows = []
    for rule in RULES:
        cells = [average(records[kind], measure(rule, key)).text(n) for kind in kinds for key, n in MEASURES.values()]
        rows.append([rule, *cells])
    table = markdown_table(["k", *(f"{kind}: {name}" for kind in kinds for name in MEASURES)], rows)
    return f"{len(records['true'])} of {len(specs)} scenes.\n\n{table}"


# --- averages


@dataclass(frozen=True)
class Average:
    """Mean of a measure over cells; a cell is a number of leaves and a number of cameras, and counts once.

    Attributes:
        value: mean over the cells of the mean over their plants; None when no scene has a value.
        answered: number of scenes with a value.
        asked: number of scenes.
    """

    value: float | None
    answered: int
    asked: int

    def text(self, decimals: int) -> str:
        """The value, with the number of scenes behind it when some have none; "N/A" when all have none; "-" without
        scenes."""
        if self.value is None:
            return "N/A" if self.asked else "-"
        part = "" if self.answered == self.asked else f" ({self.answered} of {self.asked})"
        return f"{self.value:.{decimals}f}{part}"


def average(records: Iterable[Record], pick: Pick) -> Average:
    """The average of the values that `pick` takes from the records; None = no value."""
    cells = defaultdict(list)
    asked = 0
    for record in records:
        asked += 1
        value = pick(record)
        if value is not None:
            cells[record["leaves"], record["views"]].append(value)
    answered = sum(len(values) for values in cells.values())
    means = [float(np.mean(values)) for values in cells.values()]
    return Average(float(np.mean(means)) if means else None, answered, asked)


def average_columns(
    records: Sequence[Record], pick: Pick, *, views: Sequence[int], leaves: Sequence[int], leaves_at: int | None = None
) -> list[Average]:
    """One average per number of cameras, then one per number of leaves (with `leaves_at` cameras only), then all."""
    for_leaves = [record for record in records if leaves_at in (None, record["views"])]
    columns = [average([r for r in records if r["views"] == number], pick) for number in views]
    columns += [average([r for r in for_leaves if r["leaves"] == number], pick) for number in leaves]
    return [*columns, average(records, pick)]


def measure(*keys: str) -> Pick:
    """Picks `record[key][key]...`; None where the record, or the part of it that is asked for, is not applicable."""

    def pick(record: Record) -> float | None:
        value: Record | float = record
        for key in keys:
            if not isinstance(value, dict) or "na" in value:
                return None
            value = value[key]
        return None if isinstance(value, dict) else value

    return pick


def markdown_table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    lines = ["| " + " | ".join(cells) + " |" for cells in [header, ["---"] * len(header), *rows]]
    return "\n".join(lines)
