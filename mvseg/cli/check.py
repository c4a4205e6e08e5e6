"""Check the cameras, photos and masks of a scene, and the poses by the masks; or, with --target, areas by photos of the
page of `mvseg target`. Exit code 0: nothing would go wrong; 1: something would; 2: it cannot be read.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jsonargparse import ArgumentParser, Namespace

from mvseg.cli.options import add_shared
from mvseg.errors import InputError, collect_warnings
from mvseg.findings.finding import Finding, keep_causes
from mvseg.system.say import say

if TYPE_CHECKING:
    from mvseg.checks.check_scene import Check

WRONG = 1  # definition: exit code
CHECK_FILE, TARGET_FILE = "check.json", "target.json"


def add_options(parser: ArgumentParser) -> None:
    help_scene = "scene folder (photos, cameras of any kind in docs/formats.md), or a result of mvseg infer"
    parser.add_argument("scene", type=Path, help=help_scene)
    help_out = "folder for check.json (target.json), and for walk.svg, a plan (default: nothing is written)"
    parser.add_argument("--out", type=Path | None, help=help_out)
    add_shared(parser, "masks", "categories", "coco_crowd", "quiet")
    help_target = "the photos show the page of mvseg target: how right are the areas of its shapes?"
    parser.add_argument("--target", action="store_true", help=help_target)
    parser.add_argument("--bar", type=float | None, help="length of the page's scale bar by a ruler, mm (default: 100)")


def run(args: Namespace) -> int:
    if args.target:
        return _run_target(args)
    if args.bar is not None:
        raise InputError("--bar is of the page of mvseg target, expected --target with it")
    from mvseg.checks.camera_plan import WALK_FILE
    from mvseg.results.earlier import RUN_FILE, check_file

    if args.out is not None:
        check_file(args.out / CHECK_FILE, b'"findings"')
        if not (args.out / CHECK_FILE).exists():  # an earlier check wrote both
            check_file(args.out / WALK_FILE, None)
    if (args.scene / RUN_FILE).is_file():
        if args.masks is not None:
            raise InputError(f"--masks has no effect: {args.scene} is a result, which has its masks")
        check, findings, unread = *_check_result(args.scene), None
    else:
        check, findings, unread = _check_folder(args)
    _print_table(check, args.scene)
    for finding in findings:
        say(f"{finding.level:8} {finding.topic:8} {finding}")
    if not findings and unread is None:
        say("no problems found")
    if args.out is not None:
        _write(args.out, check, findings)
    if unread is not None:
        raise unread
    return WRONG if any(finding.level == "error" for finding in findings) else 0


def _check_folder(args: Namespace) -> tuple[Check, tuple[Finding, ...], InputError | None]:
    from mvseg.checks.check_scene import check_scene
    from mvseg.formats.scene_folder import load_masks, load_scene
    from mvseg.runs.request import find_given

    wanted = () if args.categories is None else [name.strip() for name in args.categories.split(",")]
    regions, unread = None, None
    with collect_warnings() as noticed:
        scene = load_scene(args.scene)
        if args.masks is not None:
            try:
                masks = find_given(args.scene, args.masks)
                regions = load_masks(scene, masks, crowd=args.coco_crowd, categories=wanted)
            except InputError as error:  # the findings about cameras and photos may explain it
                unread = error
    check = check_scene(scene, regions)
    # without readable masks, missing photos are no fault of their own
    found = [each for each in check.findings if unread is None or each.code != "no_photos_no_masks"]
    return check, keep_causes((*noticed, *found)), unread


def _check_result(folder: Path) -> tuple[Check, tuple[Finding, ...]]:
    from mvseg.checks.check_scene import check_scene
    from mvseg.results.read import load_result

    result = load_result(folder)
    assert result.run is not None
    check = check_scene(result.scene, result.regions, is_detected=result.run.mask_kind is None)
    others = [each for each in result.run.list_findings() if each.topic in ("leaves", "edits", "run")]
    return check, keep_causes((*check.findings, *others))


def _run_target(args: Namespace) -> int:
    from mvseg.formats.target import BAR
    from mvseg.results.earlier import check_file
    from mvseg.runs.check_target import check_target
    from mvseg.system.atomic import write_text_whole

    if args.masks is not None or args.categories is not None:
        raise InputError("--masks and --categories have no effect with --target: its shapes are found by their colour")
    if args.out is not None:
        check_file(args.out / TARGET_FILE, b'"shapes"')
    check = check_target(args.scene, bar=BAR if args.bar is None else args.bar)
    say(f"{args.scene}: {check.num_tags} tags, {check.residual:.2f} mm off; lengths {check.scale - 1:+.2%} by the tags")
    line = "{:12} {:>13} {:>13} {:>9} {:>7} {:>5} {:>10}"
    say("\n" + line.format("shape", "true", "measured", "sd", "error", "95 %", "photos"))
    for shape in check.shapes:
        areas = [f"{area:.1f} mm^2" for area in (shape.true_area, shape.area)]
        holds, photos = "yes" if shape.holds else "no", f"{shape.num_views} of {shape.num_masks}"
        say(line.format(shape.name, *areas, f"{shape.sd:.1f}", f"{shape.error:+.1%}", holds, photos))
    say(f"\n{check.verdict}")
    if args.out is not None:
        args.out.mkdir(parents=True, exist_ok=True)
        write_text_whole(args.out / TARGET_FILE, json.dumps(check.describe(), indent=1) + "\n")
        say(f"{args.out}: {TARGET_FILE}", to_stderr=True)
    return 0 if check.is_right else WRONG


def _print_table(check: Check, place: Path) -> None:
    from mvseg.checks.cameras import field_of_view

    scene, cameras = check.scene, check.scene.cameras
    up = "unknown" if scene.up is None else "{:.2f} {:.2f} {:.2f}".format(*scene.up)
    say(f"{place}: {len(cameras)} cameras, unit {scene.unit or 'unknown'}, up {up}")
    sees, photos = check.coverage.sees, sum(each.size is not None for each in check.photos)
    say(f"{int(sees.sum())} of {len(cameras)} look at one point; {photos} photos", end="")
    say("" if check.regions is None else f"; {len(check.regions)} masks", end="\n\n")
    width = max(4, *(len(view.name) for view in scene.views))
    line = f"{{:{width}}} {{:>11}} {{:>6}} {{:>6}} {{:>8}} {{:>6}} {{:>7}} {{:>5}} {{:>7}}"
    say(line.format("view", "size", "field", "next", "photo", "masks", "border", "fit", "miss"))
    forms = {"next_deg": "{:.0f}°", "photo": "{}", "masks": "{}", "border": "{}", "fit": "{:.0%}",
             "miss_px": "{:.0f} px"}  # fmt: skip
    for row, angle, size in zip(_rows(check), field_of_view(cameras), cameras.sizes.tolist(), strict=True):
        known = ["-" if row[name] is None else form.format(row[name]) for name, form in forms.items()]
        say(line.format(row["view"], "{} x {}".format(*size), f"{angle:.0f}°", *known))
    say()


def _rows(check: Check) -> list[dict[str, Any]]:
    from mvseg.checks.masks import touches_border
    from mvseg.checks.poses import view_agreement

    num, regions = len(check.scene.views), check.regions
    counts: list[Any] = [None] * num
    border, (fit, miss) = counts, np.full((2, num), np.nan)
    if regions is not None:
        counts = regions.num_per_view.tolist()
        border = regions.view_index[touches_border(regions, check.scene.cameras)].bincount(minlength=num).tolist()
    if check.agreement is not None:
        agreement = view_agreement(check.agreement)
        fit, miss = agreement.fitting, agreement.offset_px
    return [
        {
            "view": view.name,
            "looks_at_point": bool(check.coverage.sees[index]),
            "next_deg": _or_none(check.coverage.angle[index]),
            "photo": "broken" if photo.problem else "missing" if photo.size is None else "yes",
            "masks": counts[index],
            "border": border[index],
            "fit": _or_none(fit[index]),
            "miss_px": _or_none(miss[index]),
        }
        for index, (view, photo) in enumerate(zip(check.scene.views, check.photos, strict=True))
    ]


def _or_none(value: float) -> float | None:
    return None if np.isnan(value) else float(value)


def _write(out: Path, check: Check, findings: Sequence[Finding]) -> None:
    from mvseg.checks.camera_plan import WALK_FILE, draw_walk
    from mvseg.system.atomic import write_text_whole

    off = {view for each in findings if each.topic == "poses" and each.level == "error" for view in each.views}
    content = {"scene": check.scene.name, "findings": [each.as_json() for each in findings], "views": _rows(check)}
    out.mkdir(parents=True, exist_ok=True)
    write_text_whole(out / CHECK_FILE, json.dumps(content, indent=1) + "\n")
    write_text_whole(out / WALK_FILE, draw_walk(check.scene, tuple(off))[1])
    say(f"{out}: {CHECK_FILE}, {WALK_FILE}", to_stderr=True)
