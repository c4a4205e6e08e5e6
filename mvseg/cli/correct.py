"""Correct a result in the browser: served to this machine only, saved after every edit."""

from __future__ import annotations

import sys
import threading
from pathlib import Path

from jsonargparse import ArgumentParser, Namespace

from mvseg.cli.options import add_shared
from mvseg.errors import InputError


def add_options(parser: ArgumentParser) -> None:
    """The options of the verb."""
    parser.add_argument("result", type=Path, help="result folder of mvseg infer or match")
    parser.add_argument("--no_browser", action="store_true", help="only print the address, do not open the browser")
    add_shared(parser, "num_workers")


def run(args: Namespace) -> int:
    """Run the verb until Ctrl-C; returns the exit code."""
    import webbrowser

    from mvseg.results.read import find_result
    from mvseg.runs.correct_result import OpenResult, check_writable, open_alone, say_how_to_run
    from mvseg.runs.correction_server import CorrectionServer, Corrector
    from mvseg.system.worker_pool import default_workers, start_workers

    folder = find_result(args.result)
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder, expected a result of mvseg infer")
    check_writable(folder)
    num_workers = default_workers() if args.num_workers is None else args.num_workers
    with open_alone(folder), start_workers(num_workers) as workers:
        opened = OpenResult(folder, workers=workers)
        if opened.notice:
            print(f"mvseg: {opened.notice}", file=sys.stderr)
        corrector = Corrector(opened)
        with CorrectionServer(corrector) as server:
            threading.Thread(target=corrector.compute, daemon=True).start()
            print(f"{server.address}\nEvery edit is saved to {folder}/corrections.json. Ctrl-C ends.", flush=True)
            if not args.no_browser:
                webbrowser.open(server.address)
            try:
                server.serve_forever()
            except KeyboardInterrupt:
                print(f"\nThe whole result with these corrections: {say_how_to_run(opened)}")
            finally:
                corrector.close()
    return 0
