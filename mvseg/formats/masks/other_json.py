"""JSON of programs whose masks are not read: each is named, so that it is not taken for a kind that is."""

from __future__ import annotations

from pathlib import Path

from mvseg.errors import InputError

# What only their files hold, and what to do; most export COCO.
PROGRAMS: dict[str, tuple[tuple[bytes, ...], str]] = {
    # its versions 2 and 3, projects and JSON
    "VIA": (
        (b'"_via_', b'"shape_attributes"', b"__VIA_PROJECT_ID__"),
        "its COCO export (Annotation > Export Annotations (COCO format))",
    ),
    "Darwin (V7)": ((b'"slot_names"', b'"darwin_schema_v2'), "V7's COCO export"),
    "Segments.ai": ((b'"segmentation_bitmap"',), "its COCO export, or the bitmaps as label images"),
    "ISAT": ((b'"ISAT"',), "its COCO export (Tools > ISAT to COCO)"),
    "Supervisely": ((b'"geometryType"', b'"classTitle"'), "its COCO export"),
    "Label Studio": ((b'"from_name"',), "its COCO export"),
    "datumaro": ((b'"dm_format_version"', b'"media_type"'), "COCO (datum convert -f coco)"),
    "Labelbox": ((b'"data_row"',), "its COCO export"),
}


def refuse_other(path: Path, data: bytes) -> None:
    """Raises InputError: the content of a JSON file is that of a program which is known, and not read."""
    for program, (marks, expected) in PROGRAMS.items():
        if any(mark in data for mark in marks):
            raise InputError(f"{path}: is a project or the annotations of {program}, expected {expected}") from None
