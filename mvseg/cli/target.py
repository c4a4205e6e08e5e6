"""Write a page to print, with shapes of known area: photographed and checked by `mvseg check --target`, it shows how
good cameras, masks, surfaces and areas are.
"""

from __future__ import annotations

from pathlib import Path

from jsonargparse import ArgumentParser, Namespace

from mvseg.system.say import say


def add_options(parser: ArgumentParser) -> None:
    parser.add_argument("page", type=Path, help="PDF file to write; A4, to be printed at 100 %%, in colour")


def run(args: Namespace) -> int:
    from mvseg.formats.target import SIGN, tag_corners, tag_distance, write_target
    from mvseg.results.earlier import check_file

    check_file(args.page, SIGN)
    write_target(args.page)
    scale = f"--distance marker:0 marker:{len(tag_corners()) - 1} {tag_distance():.2f} --unit mm"
    say(f"{args.page}: print it at 100 %, in colour. Of photos of it, mvseg pose needs {scale}")
    return 0
