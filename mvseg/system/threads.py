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
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    try:
        with threadpool_limits(limits=1, user_api="blas"):
            yield
    finally:
        torch.set_num_threads(of_torch)
        cv2.setNumThreads(of_opencv)


def stay_on_one_thread() -> None:
    """Let this process compute on one thread from now on, and the processes that it starts."""
    os.environ.update(dict.fromkeys(VARIABLES, "1"))  # libraries look when they are loaded
    import cv2
    import torch

    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    threadpool_limits(1)
