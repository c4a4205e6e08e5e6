"""A Dask cluster of processes on this machine, and what becomes of an item whose worker dies."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest

from batch_work import describe_process, do_as_told
from mvseg.batch.workers import Lost, connect, run_on_dask
from mvseg.errors import InputError

distributed = pytest.importorskip("distributed")
dask = pytest.importorskip("dask")
pytestmark = pytest.mark.filterwarnings("ignore::ResourceWarning")


@pytest.fixture(scope="module")
def cluster(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    settings = {
        "distributed.scheduler.allowed-failures": 0,
        "temporary-directory": str(tmp_path_factory.mktemp("dask")),
        "distributed.logging.distributed": "critical",
    }
    with (
        dask.config.set(settings),
        distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=":0") as cluster,
    ):
        yield cluster


@pytest.mark.slow
def test_a_worker_that_dies_loses_what_it_had_and_the_rest_goes_on(cluster: Any, tmp_path: Path) -> None:
    begun: list[int] = []
    words = ["a", "kill", "b", "raise", "c", "d"]
    file = tmp_path / "scheduler.json"
    file.write_text(json.dumps({"address": cluster.scheduler_address}))
    with connect(str(file)) as client:
        answers = {}
        for number, word in enumerate(words):  # one by one: what waits on a worker may be lost with it
            answers |= dict(run_on_dask(do_as_told, {number: word}, begun.append, client=client))
    assert sorted(answers) == list(range(6))
    assert [answers[key][0] for key in (0, 2, 4, 5)] == ["A", "B", "C", "D"]
    assert isinstance(answers[1], Lost)
    assert answers[1].reason.startswith("died with its worker, most likely because memory ran out")
    assert answers[3] == Lost("stopped with ValueError: it is broken")
    assert begun == [0, 1, 2, 3, 4, 5]


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="looks into /proc")
def test_workers_end_on_sigterm_as_dask_has_it(cluster: Any) -> None:
    """Loading pycolmap would set a handler that prints a C++ trace, and may hang."""
    with connect(cluster.scheduler_address) as client:
        cluster.wait_for_workers(2, timeout=120)
        before = client.run(describe_process)
        list(run_on_dask(do_as_told, {0: "a"}, int, client=client))
        after = client.run(describe_process)
    assert len(after) == 2
    assert {is_loaded for is_loaded, _ in after.values()} == {True}
    assert {is_handled for _, is_handled in after.values()} == {is_handled for _, is_handled in before.values()}


@pytest.mark.slow
def test_items_are_given_to_all_workers_at_once_and_taken_back(cluster: Any, tmp_path: Path) -> None:
    with connect(cluster.scheduler_address) as client:
        answers = dict(run_on_dask(do_as_told, dict(enumerate("abcdef")), int, client=client))
        assert [answers[key][0] for key in range(6)] == list("ABCDEF")
        items = dict(enumerate(["a", *(f"touch:{tmp_path / str(number)}" for number in range(40))]))
        with closing(run_on_dask(do_as_told, items, int, client=client)) as some:
            assert next(some)[0] == 0
        client.submit(do_as_told, "b", pure=False).result()
    assert len(list(tmp_path.iterdir())) < 20


@pytest.mark.parametrize(
    ("scheduler", "message"),
    [
        ("nowhere.json", "nowhere.json: cannot be read"),
        ("broken.json", "broken.json: is not a scheduler file of Dask"),
        ("list.json", "list.json: is not a scheduler file of Dask"),
        ("tcp://127.0.0.1:9", "no Dask scheduler answers at tcp://127.0.0.1:9"),
        ("127.0.0.1:9", "no Dask scheduler answers at 127.0.0.1:9"),
    ],
)
def test_a_scheduler_that_is_not_there(
    scheduler: str, message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("mvseg.batch.workers.TIMEOUT", 0.5)
    monkeypatch.chdir(tmp_path)
    Path("broken.json").write_text("{")
    Path("list.json").write_text("[]")
    with pytest.raises(InputError) as error:
        connect(scheduler)
    assert str(error.value).startswith(message)


class Cluster:
    """What `run_on_dask` asks of a client, with faults."""

    def __init__(self, *, at_once: Exception | None = None, later: BaseException | None = None) -> None:
        self.at_once, self.later, self.status, self.loop = at_once, later, "running", None

    def register_plugin(self, *_: object, **__: object) -> None:
        if self.at_once is not None:
            raise self.at_once

    def submit(self, *_: object, **__: object) -> Any:
        assert self.later is not None
        raise self.later

    def cancel(self, _: object) -> None:
        raise OSError("closed")


@pytest.mark.parametrize(
    ("client", "message"),
    [
        (Cluster(at_once=ModuleNotFoundError("No module named 'mvseg'")), "a Dask worker cannot run mvseg .*No module"),
        (Cluster(at_once=OSError("Timed out")), "the Dask scheduler does not answer any more: start it again"),
        (Cluster(later=OSError("Comm is closed")), "the Dask scheduler does not answer any more: start it again"),
    ],
)
def test_a_cluster_that_cannot_work_is_one_sentence(client: Any, message: str) -> None:
    with pytest.raises(InputError, match=message):
        list(run_on_dask(do_as_told, {0: "a"}, int, client=client))


def test_a_missing_library_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(InputError, match=r"^--scheduler needs distributed: pip install 'mvseg\[batch\]'$"):
        connect("tcp://127.0.0.1:9")
