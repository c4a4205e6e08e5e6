"""Correct a result, or tracks, in the browser: served to this machine only, saved after every edit."""

from __future__ import annotations

import shlex
import threading
from contextlib import ExitStack, suppress
from contextvars import copy_context
from pathlib import Path

from jsonargparse import ArgumentParser, Namespace

from mvseg.cli.options import add_shared
from mvseg.errors import InputError
from mvseg.system.say import say


def add_options(parser: ArgumentParser) -> None:
    parser.add_argument("result", type=Path, help="result folder of mvseg infer or match, or output of mvseg track")
    parser.add_argument("--plant", type=str | None, help="of an output of mvseg track with several plants")
    parser.add_argument("--no_browser", action="store_true", help="only print the address, do not open the browser")
    add_shared(parser, "num_workers")


def run(args: Namespace) -> int:
    """Run the verb until Ctrl-C; returns the exit code."""
    import webbrowser

    from mvseg.results.read import find_result
    from mvseg.server.correction_server import Corrector
    from mvseg.server.local_server import CorrectionServer
    from mvseg.server.open_result import OpenResult, check_writable, open_alone
    from mvseg.server.open_tracks import OpenTracks
    from mvseg.server.saved_edits import CORRECTIONS_FILE
    from mvseg.system.atomic import sweep_abandoned
    from mvseg.system.running import running
    from mvseg.system.worker_pool import default_workers, load_ahead
    from mvseg.tracking.recorded import is_tracks

    sweep_abandoned(args.result)
    has_tracks = is_tracks(args.result)
    folder = args.result if has_tracks else find_result(args.result)
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder, expected a result of mvseg infer")
    if args.plant is not None and not has_tracks:
        raise InputError(f"{folder}: holds one plant, expected --plant with an output of mvseg track only")
    check_writable(folder)
    num_workers = default_workers() if args.num_workers is None else args.num_workers
    with open_alone(folder), ExitStack() as stack:
        now = stack.enter_context(running(num_workers=1 if has_tracks else num_workers))
        opened: OpenResult | OpenTracks = OpenTracks(folder, args.plant) if has_tracks else OpenResult(folder)
        if opened.notice:
            say(f"mvseg: {opened.notice}", to_stderr=True)
        corrector = Corrector(opened)
        server = stack.enter_context(CorrectionServer(corrector))
        computing = threading.Thread(target=copy_context().run, args=(corrector.compute,))
        try:
            computing.start()
            load_ahead(now.workers, "mvseg.reconstruction.surface.fit_surfaces")
            say(f"{server.address}\nEvery edit is saved to {folder}/{CORRECTIONS_FILE}. Ctrl-C ends.")
            if not args.no_browser:
                webbrowser.open(server.address)
            server.serve_forever()
        except KeyboardInterrupt:
            if opened.learner is not None and opened.learner.learned is not None:
                say("\nWhat the detector has learned is in the whole result, if the page made it since.")
            what, verb = ("tables and page", "track") if has_tracks else ("whole result", "infer")
            again = ["--again", str(folder.resolve()), "--corrections", str(folder.resolve() / CORRECTIONS_FILE)]
            say(f"\nThe {what} with these corrections: {shlex.join(['mvseg', verb, *again])}")
        finally:
            corrector.close()
            stack.close()  # the workers stop, whatever they are doing
            while computing.is_alive():  # torch aborts the process if it ends before its threads
                with suppress(KeyboardInterrupt):
                    computing.join()
    return 0
