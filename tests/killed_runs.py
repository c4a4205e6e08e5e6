"""A script that runs `mvseg <verb>` and kills it: imports everything once, and forks a process for each run.

Reads one JSON object per line: "arguments" of the command, "log" for what it prints, "signal" and the "delay" in
seconds after which it is sent (none: the run is left alone). Answers with the "status" as `subprocess` has it, the
"seconds", and the processes "left" that the run had started.
"""

from __future__ import annotations

import json
import os
import signal
import sys
import time
from pathlib import Path
from typing import Any

import torch

import mvseg.pipeline.run_scene
import mvseg.results.folder
import mvseg.results.plant_files
import mvseg.training.state
from mvseg.cli import main
from mvseg.simulation.dataset import PRESETS, Preset
from tiny_training import build_tiny

TINY = Preset(plants=(("dev", 4),), leaves=(2,), views=(2,), size=(48, 48), has_coco=True)
GRACE = 60.0  # seconds; a worker that is starting notices that its parent is gone when it has loaded this module


def run(arguments: list[str], log: str) -> None:
    """Be the command, with a tiny detector to train and a tiny data set to simulate; never returns."""
    code = 1
    try:
        os.setsid()
        handle = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        os.dup2(handle, 1)
        os.dup2(handle, 2)
        signal.signal(signal.SIGTERM, signal.SIG_DFL)  # pycolmap is there already, and has set its own
        PRESETS["tiny"] = TINY
        mvseg.training.state.build_detector = lambda *arguments, **options: build_tiny()
        code = main(arguments)
        sys.stdout.flush()
        sys.stderr.flush()
    finally:
        os._exit(code)


def processes_of(session: int) -> list[int]:
    """Processes that are alive in a session. Linux only; elsewhere none are found."""
    alive = []
    for path in Path("/proc").glob("[0-9]*/stat"):
        try:
            state, _, _, of_session = path.read_text().rpartition(")")[2].split()[:4]
        except OSError:
            continue
        if int(of_session) == session and state not in "ZX":
            alive.append(int(path.parent.name))
    return alive


def answer(request: dict[str, Any]) -> dict[str, Any]:
    started = time.monotonic()
    process = os.fork()
    if not process:
        run(request["arguments"], request["log"])
    if request.get("signal") is not None:
        time.sleep(request["delay"])
        os.kill(process, request["signal"])
    _, status = os.waitpid(process, 0)
    seconds = time.monotonic() - started
    while processes_of(process) and time.monotonic() - started < seconds + GRACE:
        time.sleep(0.02)
    return {"status": os.waitstatus_to_exitcode(status), "seconds": seconds, "left": processes_of(process)}


if __name__ == "__main__":
    torch.set_num_threads(1)  # as in the tests (conftest.py): bits are compared
    for line in sys.stdin:
        print(json.dumps(answer(json.loads(line))), flush=True)
