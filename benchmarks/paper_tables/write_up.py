"""benchmarks.md, benchmarks.json and the plots, from the records."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

from benchmarks.paper_tables.cells import PRESETS, SEED, Record, list_cells, read_record
from benchmarks.paper_tables.experiments import Plan, read_records, real_record, slug
from benchmarks.paper_tables.number_of_leaves import RULES
from benchmarks.paper_tables.plots import plot_all
from benchmarks.paper_tables.shapes import SHAPES
from benchmarks.paper_tables.tables import (
    count_masks,
    read_matches,
    read_notes,
    read_shapes,
    table_1,
    table_2,
    table_3,
    table_error,
    table_numbers,
    table_rules,
)
from mvseg.system.atomic import write_text_whole

TEMPLATE = Path(__file__).with_name("benchmarks.template.md")
NOTES = Path(__file__).with_name("notes.md")


def write_up(plan: Plan, out: Path) -> str:
    """Write `benchmarks.md`, `benchmarks.json` and the plots into a folder; returns the content of `benchmarks.md`."""
    out.mkdir(parents=True, exist_ok=True)
    text = write_page(plan, {path.stem: path.name for path in plot_all(plan, out)})
    write_text_whole(out / "benchmarks.md", text)
    write_text_whole(out / "benchmarks.json", describe_records(plan))
    return text


def write_page(plan: Plan, plots: Mapping[str, str]) -> str:
    """The content of `benchmarks.md`, with these plots, {name: file}.

    The text between the tables is written by hand. The template holds for any run; the notes are about the records of
    the preset "paper", and only that preset gets them.
    """
    notes = read_notes(NOTES) if plan.preset == "paper" else {}
    base = f"python -m benchmarks.paper_tables --preset {plan.preset}"
    detector = f" --detector {plan.detector}" if plan.detector else ""
    parts = [TEMPLATE.read_text(encoding="utf-8").strip(), notes.get("summary", "")]
    for kind in plan.kinds:
        if read_matches(plan, kind):
            option = detector if kind.startswith("detected") else ""
            parts += [f"## Table 1: ids, masks {kind}", f"{count_masks(plan, kind)} `{base} --tables 1{option}`"]
            parts += [table_1(plan, kind), picture(plots, f"benchmarks-{kind.split()[0]}")]
            parts.append(notes.get(f"table 1 {kind.split()[0]}", ""))
    if any(real_record(plan, folder, method).is_file() for folder in plan.real for method in plan.methods):
        parts += ["## Table 2: real scenes, hand-made masks", f"`{base} --tables 2 --real FOLDER ...`", table_2(plan)]
        parts.append(notes.get("table 2", ""))
    if read_shapes(plan):
        parts += ["## Table 3: d(I, T) in mean leaf lengths", f"`{base} --tables 3`", table_3(plan)]
        parts += [picture(plots, "benchmarks-shapes"), notes.get("table 3", "")]
        parts += ["### What d is made of", notes.get("error before", ""), table_error(plan), notes.get("error", "")]
        parts += ["### Other thresholds, and parts that other leaves hide", notes.get("rules before", "")]
        parts += [table_rules(plan), notes.get("rules", "")]
    if read_records(plan.records / "numbers" / "true", list_cells(PRESETS[plan.preset])):
        parts += ["## The number of leaves: given, and found", f"`{base} --tables k`", table_numbers(plan)]
        parts.append(notes.get("numbers", ""))
    return "\n\n".join(part for part in parts if part) + "\n"


def picture(plots: Mapping[str, str], name: str) -> str:
    return f"![{name}]({plots[name]})" if name in plots else ""


def describe_records(plan: Plan) -> str:
    """All records as JSON, one line per scene, numbers to five digits; `unpack_records` reads it."""
    options = (f" --detector {plan.detector}" if plan.detector else "") + (" --real FOLDER ..." if plan.real else "")
    command = f"python -m benchmarks.paper_tables --preset {plan.preset}{options}"
    specs = list_cells(PRESETS[plan.preset])
    shapes = [read_shapes(plan, [shape]) for shape in SHAPES]  # one at a time: each with all scenes that it has
    groups = {f"table 3, {name}": records for of_shape in shapes for name, records in of_shape.items()}
    for kind in plan.kinds:
        groups |= {f"table 1, {kind}, {name}": records for name, records in read_matches(plan, kind).items()}
    for kind in ("true", "degraded"):
        groups[f"number of leaves, {kind}"] = read_records(plan.records / "numbers" / slug(kind), specs)
    for folder in plan.real:
        paths = {method: real_record(plan, folder, method) for method in plan.methods}
        records = [{"method": m} | read_record(path) for m, path in paths.items() if path.is_file()]
        groups[f"table 2, {folder.resolve().name}"] = records
    about = {"command": command, "preset": plan.preset, "seed": SEED, "rules for the number of leaves": RULES}
    parts = [json.dumps(about)[1:-1]]
    for name, records in groups.items():
        parts.append(f"{json.dumps(name)}: [\n" + ",\n".join(shorten(record) for record in records) + "\n]")
    return "{\n" + ",\n".join(parts) + "\n}\n"


def unpack_records(file: Path, plan: Plan) -> Plan:
    """Put the records of a `benchmarks.json` into the cache of a plan, which is empty; returns it with the real scenes
    of the file."""
    real: list[Path] = []
    for name, records in json.loads(file.read_text(encoding="utf-8")).items():
        table, _, of = name.partition(", ")
        kind, _, method = of.partition(", ")
        folders = {"table 1": plan.match_records(kind) / slug(method), "table 3": plan.records / "shapes" / slug(of)}
        folders["number of leaves"] = plan.records / "numbers" / slug(of)
        real += [Path(of)] if table == "table 2" else []
        for record in records if of else ():
            if table == "table 2":
                path = real_record(plan, Path(of), record["method"])
            else:
                path = folders[table] / f"{record['scene'].replace('/', '_')}.json"
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(json.dumps(record), encoding="utf-8")
    return replace(plan, real=tuple(real))


def shorten(record: Record) -> str:
    """One record as compact JSON without timings (they differ from run to run), numbers to five digits."""
    rounded = json.loads(json.dumps(record), parse_float=lambda text: float(f"{float(text):.5g}"))
    rounded.pop("seconds", None)
    return json.dumps(rounded, separators=(",", ":"))
