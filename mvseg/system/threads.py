"""How many threads NumPy, SciPy, torch and OpenCV compute on: one, but for networks, whose layers are worth sharing.

Waking another thread takes longer than a product of matrices of 78 x 78; and sums do not depend on the machine's cores.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager

from threadpoolctl import threadpool_limits

VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")


@contextmanager
def on_one_thread() -> Iterator[None]:
    """Compute on one thread in the block, or in the function that this decorates."""
    import cv2  # takes long to load
    import torch

    of_torch, of_opencv = torch.get_num_threads(), cv2.getNumThreads()
    use_one_thread()
    try:
        with threadpool_limits(limits=1, user_api="blas"):
            yield
    finally:
        torch.set_num_threads(of_torch)
        cv2.setNumThreads(of_opencv)


def use_one_thread() -> None:
    """Let torch and OpenCV use one thread from now on in this process."""
    import cv2
    import torch

    torch.set_num_threads(1)
    cv2.setNumThreads(1)


@contextmanager
def start_on_one_thread() -> Iterator[None]:
    """Let processes that are started in the block compute on one thread: libraries look when they are loaded."""
    earlier = {name: os.environ.get(name) for name in VARIABLES}
    os.environ.update(dict.fromkeys(VARIABLES, "1"))
    try:
        yield
    finally:
        for name, value in earlier.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value
