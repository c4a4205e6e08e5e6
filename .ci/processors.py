"""The numeric tests in the arithmetic of other processors, as far as this one can imitate them.

`make processors` tries all of them; `python .ci/processors.py sse avx2` tries these two. The first one that fails ends
it, and is named. Libraries choose their code by the processor: where they sum in another order, the last digits differ.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

from numpy._core._multiarray_umath import __cpu_dispatch__, __cpu_features__

FOUND = [name for name in __cpu_dispatch__ if __cpu_features__[name]]  # what NumPy uses beyond its least
WIDE = [name for name in FOUND if "AVX512" in name or name == "X86_V4"]

# {name: (instructions that it needs, variables)}; every value of a variable occurs, not every combination.
ARITHMETICS: dict[str, tuple[str | None, dict[str, str]]] = {
    "sse": (None, {
        "OPENBLAS_CORETYPE": "Prescott", "MKL_CBWR": "COMPATIBLE", "ATEN_CPU_CAPABILITY": "default",
        "ONEDNN_MAX_CPU_ISA": "SSE41", "NPY_DISABLE_CPU_FEATURES": " ".join(FOUND), "OPENCV_IPP": "disabled",
    }),
    "avx2": ("AVX2", {
        "OPENBLAS_CORETYPE": "Haswell", "MKL_CBWR": "AVX2", "ATEN_CPU_CAPABILITY": "avx2",
        "ONEDNN_MAX_CPU_ISA": "AVX2", "NPY_DISABLE_CPU_FEATURES": " ".join(WIDE), "OMP_NUM_THREADS": "2",
    }),
    "zen": ("AVX2", {"OPENBLAS_CORETYPE": "Zen", "OMP_NUM_THREADS": "2"}),
    "skylake": ("AVX512F", {"OPENBLAS_CORETYPE": "SkylakeX", "ATEN_CPU_CAPABILITY": "avx2"}),
}  # fmt: skip
VARIABLES = {name for _, variables in ARITHMETICS.values() for name in variables}
TESTS = (
    ["tests/test_masks.py", "tests/test_pipeline.py"]
    + [f"tests/{room}" for room in ("matching", "reconstruction", "detection", "verification", "traits")],
    # the plant that ships, slow tests included: its ids, shapes and traits, from masks and from pixels
    ["-m", "", "-k", "test_jitter or test_demo", "tests/test_jitter.py", "tests/test_cli.py"],
)


def try_arithmetic(name: str) -> bool:
    """Whether the tests pass; where this processor lacks the instructions, the arithmetic is left out."""
    needed, variables = ARITHMETICS[name]
    written = " ".join(f"{variable}={value!r}" for variable, value in variables.items())
    if needed is not None and not __cpu_features__.get(needed):
        print(f"processors: {name} is left out: this processor has no {needed}", flush=True)
        return True
    print(f"processors: {name}: {written}", flush=True)
    own = {variable: value for variable, value in os.environ.items() if variable not in VARIABLES}
    own |= {"OMP_NUM_THREADS": "1", "OMP_WAIT_POLICY": "passive"}
    num_processes = 2 // int(variables.get("OMP_NUM_THREADS", "1"))  # two threads in all: more get in each other's way
    for tests in TESTS:
        command = [sys.executable, "-m", "pytest", "-n", str(num_processes), *tests]
        if subprocess.run(command, env={**own, **variables}, check=False).returncode:
            print(f"processors: tests fail in the arithmetic {name}: {written}", file=sys.stderr)
            return False
    return True


if __name__ == "__main__":
    os.chdir(Path(__file__).parent.parent)
    unknown = [name for name in sys.argv[1:] if name not in ARITHMETICS]
    if unknown:
        sys.exit(f"processors: there is no arithmetic {unknown[0]}, expected {', '.join(ARITHMETICS)}")
    sys.exit(not all(map(try_arithmetic, sys.argv[1:] or ARITHMETICS)))
