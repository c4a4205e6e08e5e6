"""`mvseg check`: what is wrong with a scene, before anything long runs."""

from __future__ import annotations

import json
import sys
import warnings
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from jsonargparse import ArgumentParser, Namespace

from mvseg.errors import InputError, InputWarning

if TYPE_CHECKING:
    from mvseg.checks.check_scene import Check
    from mvseg.checks.finding import Finding

WRONG = 1  # exit code
NOTHING_TO_SEE = "there are neither photos nor masks"


def add(verbs: Any) -> None:
    """Add the verb to the parser's sub-commands."""
    about = "Check the cameras, photos and masks of a scene, and the poses by the masks. Exit code 0: nothing would go "
    parser = ArgumentParser(exit_on_error=False, description=f"{about}wrong; 1: something would; 2: it cannot be read.")
    parser.add_argument("scene", type=Path, help="scene folder (photos, cameras of any kind in docs/formats.md)")
    parser.add_argument("--masks", type=Path | None, help="masks of any kind, in the scene folder or anywhere")
    help_out = "folder for check.json and for cameras.png, a plan of the cameras (default: nothing is written)"
    parser.add_argument("--out", type=Path | None, help=help_out)
    parser.add_argument("--categories", type=str | None, help="names of the categories of masks to take (default: all)")
    help_crowd = "whether COCO annotations with iscrowd are masks like all others, or left out"
    parser.add_argument("--coco_crowd", type=Literal["mask", "ignore"], default="mask", help=help_crowd)
    parser.add_argument("--quiet", action="store_true", help="no progress bars")
    verbs.add_subcommand("check", parser, help="what would go wrong with a scene")


def run(args: Namespace) -> int:
    """Run the verb; returns the exit code."""
    from mvseg.checks.check_scene import check_scene
    from mvseg.formats.scene_folder import load_masks, load_scene
    from mvseg.runs.one_scene import find_masks

    wanted = () if args.categories is None else [name.strip() for name in args.categories.split(",")]
    unread: InputError | None = None
    regions = None
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", InputWarning)
        scene = load_scene(args.scene)
        num_of_cameras = len(caught)
        if args.masks is not None:
            try:
                regions = load_masks(
                    scene, find_masks(args.scene, args.masks), crowd=args.coco_crowd, categories=wanted
                )
            except InputError as error:  # the findings about cameras and photos may explain it
                unread = error
    check = check_scene(scene, regions, progress=not args.quiet)
    places = ["cameras" if index < num_of_cameras else "masks" for index in range(len(caught))]
    said = [pair for pair in zip(caught, places, strict=True) if issubclass(pair[0].category, InputWarning)]
    found = [_reader_finding(warning, place) for warning, place in said]
    # without readable masks, missing photos are no fault of their own
    found += [each for each in check.findings if unread is None or not each.what.startswith(NOTHING_TO_SEE)]
    _print_table(check)
    for finding in sorted(found, key=lambda each: ("error", "warning", "note").index(each.level)):
        print(f"{finding.level:8} {finding.where:8} {finding.what}")
    if not found and unread is None:
        print("no problems found")
    if args.out is not None:
        _write(args.out, check, found)
    if unread is not None:
        raise unread
    return WRONG if any(finding.level == "error" for finding in found) else 0


def _reader_finding(warning: warnings.WarningMessage, where: str) -> Finding:
    from mvseg.checks.finding import Finding

    return Finding(where=where, what=str(warning.message), level="warning")


def _print_table(check: Check) -> None:
    from mvseg.checks.cameras import field_of_view

    scene, cameras = check.scene, check.scene.cameras
    print(f"{scene.source}: {len(cameras)} cameras, unit {scene.unit or 'unknown'}, up {_direction(scene.up)}")
    sees, photos = check.coverage.sees, sum(each.size is not None for each in check.photos)
    print(f"{int(sees.sum())} of {len(cameras)} look at one point; {photos} photos", end="")
    print("" if check.regions is None else f"; {len(check.regions)} masks", end="\n\n")
    width = max(4, *(len(view.name) for view in scene.views))
    line = f"{{:{width}}} {{:>11}} {{:>6}} {{:>6}} {{:>8}} {{:>6}} {{:>7}} {{:>5}} {{:>7}}"
    print(line.format("view", "size", "field", "next", "photo", "masks", "border", "fit", "miss"))
    for view, (row, angle) in enumerate(zip(_rows(check), field_of_view(cameras), strict=True)):
        size = "{} x {}".format(*cameras.sizes[view].tolist())
        masks, border = _number(row["masks"], "d"), _number(row["border"], "d")
        fit, miss = _number(row["fit"], ".0%"), _number(row["miss_px"], ".0f", " px")
        places = (f"{angle:.0f}°", _number(row["next_deg"], ".0f", "°"), row["photo"], masks, border, fit, miss)
        print(line.format(row["view"], size, *places))
    print()


def _rows(check: Check) -> list[dict[str, Any]]:
    """The rows of the table and of check.json, one per view; None where a value is unknown."""
    from mvseg.checks.poses import view_agreement
    from mvseg.matching.tangency import touches_border

    num, regions = len(check.scene.views), check.regions
    counts: list[Any] = [None] * num
    border: list[Any] = [None] * num
    fit, miss = np.full((2, num), np.nan)
    if regions is not None:
        counts = regions.num_per_view.tolist()
        at_border = touches_border(regions, check.scene.cameras)
        border = regions.view_index[at_border].bincount(minlength=num).tolist()
    if check.agreement is not None:
        agreement = view_agreement(check.agreement)
        fit, miss = agreement.fitting, agreement.offset_px
    return [
        {
            "view": view.name,
            "looks_at_point": bool(check.coverage.sees[index]),
            "next_deg": _known(check.coverage.angle[index]),
            "photo": "broken" if photo.problem else "missing" if photo.size is None else "yes",
            "masks": counts[index],
            "border": border[index],
            "fit": _known(fit[index]),
            "miss_px": _known(miss[index]),
        }
        for index, (view, photo) in enumerate(zip(check.scene.views, check.photos, strict=True))
    ]


def _known(value: float) -> float | None:
    return None if np.isnan(value) else float(value)


def _write(out: Path, check: Check, findings: list[Finding]) -> None:
    from mvseg.checks.camera_plan import draw_cameras
    from mvseg.formats.image_file import write_png
    from mvseg.system.atomic import write_text_whole, write_whole

    off = {view for each in findings if each.where == "poses" and each.level == "error" for view in each.views}
    content = {"scene": check.scene.name, "findings": [asdict(each) for each in findings], "views": _rows(check)}
    out.mkdir(parents=True, exist_ok=True)
    write_text_whole(out / "check.json", json.dumps(content, indent=1) + "\n")
    picture = draw_cameras(check.scene, check.coverage, tuple(sorted(off)))
    write_whole(out / "cameras.png", lambda partial: write_png(partial, picture))
    print(f"{out}: check.json, cameras.png", file=sys.stderr)


def _direction(up: tuple[float, float, float] | None) -> str:
    return "unknown" if up is None else " ".join(f"{number:.2f}" for number in up)


def _number(value: float | int | None, form: str, unit: str = "") -> str:
    return "-" if value is None else f"{value:{form}}{unit}"
