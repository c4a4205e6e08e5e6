"""Work on many scenes, in this process or in several.

Not in `__main__`: processes of a pool cannot find what is defined there when a package is run.
"""

from __future__ import annotations

import multiprocessing
from collections.abc import Callable, Iterable
from typing import Any

import torch
from tqdm import tqdm

from mvseg.simulation.dataset import start_worker


def run_all(work: Callable[[Any], None], items: Iterable[Any], num_workers: int, what: str) -> None:
    """Call `work` on every item, in this process or in a pool."""
    items = list(items)
    if not items:
        return
    with tqdm(total=len(items), desc=what, unit="scene") as bar:
        if num_workers == 1:
            torch.set_num_threads(1)
            for item in items:
                work(item)
                bar.update()
            return
        with multiprocessing.get_context("spawn").Pool(num_workers, start_process) as pool:
            for _ in pool.imap_unordered(work, items):
                bar.update()


def start_process() -> None:
    """Prepare a process of the pool: one thread, and an end with its parent."""
    start_worker()
    torch.set_num_threads(1)
