"""The traits of a batch by MIAPPE 1.1 and as BrAPI v2 observations; see docs/data-out.md."""

from __future__ import annotations

from pathlib import Path

from jsonargparse import ArgumentParser, Namespace


def add_options(parser: ArgumentParser) -> None:
    """The options of the verb."""
    parser.add_argument("batch", type=Path, help="the --out of mvseg batch")
    parser.add_argument("--out", type=Path | None, help="folder to write (default: export/ in the batch's folder)")
    parser.add_argument("--miappe", action="store_true", help="tables by the checklist of MIAPPE 1.1, as CSV")
    parser.add_argument("--brapi", action="store_true", help="BrAPI v2 observations, as JSON")
    help_factors = "columns of the batch's table that are experimental factors, as treatment,light"
    parser.add_argument("--factors", type=str | None, help=help_factors)


def run(args: Namespace) -> int:
    """Run the verb; returns the exit code."""
    from mvseg.batch.export import export_batch  # keeps --help and wrong options quick
    from mvseg.batch.status import EXPORT

    out = args.out or args.batch / EXPORT
    factors = [name.strip() for name in args.factors.split(",")] if args.factors else []
    count = export_batch(args.batch, out, miappe=args.miappe, brapi=args.brapi, factors=factors)
    print(f"{out}: {count} observations")
    return 0
