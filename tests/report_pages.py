"""Results for the tests of report.html, with names that try to break out of it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from mvseg.formats.photos import read_photo
from mvseg.results.report.page import write_report
from mvseg.results.report.pictures import Picture, draw_picture
from mvseg.results.result import Result

HOSTILE = '"\'></script><script>document.title = "owned"</script><img src=x onerror=alert(1)><!-- &amp; ${x}'
RUN = {
    "mvseg": "1.2.3",
    "findings": [{"level": "error", "topic": "photos", "sentence": f"found {HOSTILE}"}],
    "config": {"masks": HOSTILE, "limit": float("inf")},
    "inputs": {HOSTILE: "0" * 64},
    "seconds": {"match": 1.5},
    "files": {"never": "shown"},
}


def rename_hostile(result: Result) -> Result:
    """Hostile text in every place that a file or a user can name."""
    assert result.traits is not None
    views = tuple(replace(view, name=f"{index} {HOSTILE}") for index, view in enumerate(result.scene.views))
    scene = replace(result.scene, name=f"plant {HOSTILE}", unit=f"mm {HOSTILE}", views=views)
    leaves = tuple(replace(leaf, reasons={"test": f"doubt {HOSTILE}"}) for leaf in result.traits.leaves)
    traits = replace(result.traits, plant=scene.name, unit=scene.unit, leaves=leaves)
    return replace(result, scene=scene, instances=replace(result.instances, traits=traits), mask_kind=HOSTILE)


def draw_pictures(result: Result) -> list[Picture]:
    views = range(len(result.scene.views))
    return [draw_picture(read_photo(result.scene, view), result.masks, view=view) for view in views]


def write_page(path: Path, result: Result) -> Path:
    write_report(path, result, draw_pictures(result), run=RUN)
    return path
