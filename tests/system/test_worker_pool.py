"""Work in processes is what it is without them: the same answers, order, warnings and errors."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import replace
from multiprocessing import active_children
from pathlib import Path

import pytest
import torch

from batch_work import square, start_lightly
from blade_scene import EllipticBlade, as_regions, blade_masks, ring_cameras
from mvseg.errors import InputError
from mvseg.reconstruction.numbers import SEARCH
from mvseg.reconstruction.surface.fit_surfaces import fit_surfaces
from mvseg.system.running import running
from mvseg.system.worker_pool import AHEAD, Workers, default_workers, load_ahead, map_in_order, run_all, start_workers
from warned import warns_of

pytestmark = pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="processes are killed")


@pytest.fixture(scope="module")
def workers() -> Iterator[Workers]:
    with ExitStack() as stack:
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("mvseg.system.worker_pool._start_worker", start_lightly)
            workers = stack.enter_context(start_workers(2))
        yield workers


def test_few_answers_wait_for_a_slow_item(workers: Workers) -> None:
    naps = iter([0.5, *[0.0] * 99])
    assert next(map_in_order(nap, naps, workers)) is None
    assert 2 < 100 - len(list(naps)) <= 1 + AHEAD


def test_answers_come_in_order_from_other_processes(workers: Workers) -> None:
    answers = list(map_in_order(square, range(40, 80), workers))
    assert [square for square, _, _ in answers] == [number**2 for number in range(40, 80)]
    assert os.getpid() not in {process for _, process, _ in answers}
    assert {threads for _, _, threads in answers} == {"1"}
    assert [square for square, _, _ in map_in_order(square, range(3), workers[:1])] == [0, 1, 4]


def test_warnings_and_errors_are_those_of_the_work(workers: Workers) -> None:
    with warns_of("dark_photo"):
        assert next(map_in_order(square, [7], workers))[0] == 49
    with pytest.raises(InputError, match=r"^13 brings bad luck$"):
        list(map_in_order(square, [1, 13, 2], workers))
    assert next(map_in_order(square, [3], workers))[0] == 9  # the workers are still there


@pytest.mark.slow
def test_workers_import_nothing_of_the_users_folder(tmp_path: Path) -> None:
    (tmp_path / "pickle.py").write_text("raise SystemExit('the module of a stranger')")
    script = tmp_path / "script" / "run.py"
    script.parent.mkdir()
    script.write_text(
        "import sys\nfrom mvseg.system.worker_pool import run_all\n"
        "if __name__ == '__main__':\n    sys.exit(list(run_all(abs, [-1, -2, 3], 2)) != [1, 2, 3])\n"
    )
    command = [sys.executable, str(script)]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.slow
def test_surfaces_are_the_same_to_the_bit(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("mvseg.reconstruction.surface.fit_surfaces.SEARCH", replace(SEARCH, few_masks=0))
    cameras = ring_cameras(4)
    regions, ids = as_regions(blade_masks(EllipticBlade(), cameras))
    here = fit_surfaces(regions, ids, cameras)[1]
    with running(num_workers=2) as now:
        load_ahead(now.workers, fit_surfaces.__module__)  # while nobody waits
        there = fit_surfaces(regions, ids, cameras)[1]
    assert here.exists
    assert torch.equal(here.coefficients, there.coefficients)
    assert torch.equal(here.covariance, there.covariance)


def nap(seconds: float) -> None:
    time.sleep(seconds)


@pytest.mark.slow
def test_an_interruption_ends_them_at_once() -> None:
    before = set(active_children())

    def interrupt() -> None:
        with start_workers(2) as workers:
            next(map_in_order(nap, [0.0] * 20 + [3600.0] * 2, workers))
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupt()
    assert set(active_children()) <= before


@pytest.mark.slow
def test_a_killed_worker_is_said_and_none_is_left() -> None:
    before = set(active_children())
    with pytest.raises(InputError, match=r"^a worker process was killed, .* expected fewer workers$"):
        list(run_all(square, [1, -1, 2], 2))
    for process in set(active_children()) - before:
        process.join(20)
        assert not process.is_alive()


def test_how_many() -> None:
    assert 1 <= default_workers() <= 4
    with pytest.raises(InputError, match=r"^num_workers is 0, expected at least 1$"), start_workers(0):
        pass
