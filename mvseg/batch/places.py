"""The layout of a batch: OUT/NAME holds the result of a scene, and three folders beside them belong to the batch."""

from __future__ import annotations

from pathlib import Path

STATE, TABLES, EXPORT = "_batch", "tables", "export"
RESERVED = {STATE, TABLES, EXPORT}
# of summary.csv, behind those of the scene
SUMMARY_COLUMNS = ("state", "instances", "masks", "views", "warnings", "seconds", "peak_mb", "warning_text", "sentence")


def scene_state(out: Path, name: str) -> Path:
    """The folder of a scene's status and its cached detections; locked while a process works on the scene."""
    return out / STATE / name


def scene_detections(out: Path, name: str) -> Path:
    return scene_state(out, name) / "detections"


def scene_result(out: Path, name: str) -> Path:
    return out / name


def tables_folder(out: Path) -> Path:
    return out / TABLES
