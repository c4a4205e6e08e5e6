"""Torchvision is loaded without torch's compiler, and both work as ever."""

from __future__ import annotations

import subprocess
import sys

import pytest

COMPILER = "torch._dynamo.convert_frame"


def run(code: str) -> None:
    done = subprocess.run([sys.executable, "-c", f"import sys\n{code}"], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("first", ["mvseg.detectors.zoo", "mvseg.detection.mask_rcnn", "mvseg.detection.detect_scene"])
def test_no_detector_loads_the_compiler(first: str) -> None:
    run(f"import {first}; assert 'torchvision' in sys.modules; assert '{COMPILER}' not in sys.modules")


def test_what_stood_in_for_the_compiler_is_gone_and_asks_the_true_one() -> None:
    run(
        f"""
import mvseg.detectors
stand_in = sys.modules["torchvision.ops.roi_align"].is_compile_supported
import torch
from torch._dynamo import utils
assert utils.__file__ and '{COMPILER}' in sys.modules
assert stand_in is not utils.is_compile_supported
assert stand_in("meta") == utils.is_compile_supported("meta")
assert torch.compile(lambda x: x + 1, backend="eager")(torch.zeros(1)) == 1
"""
    )


def test_it_stands_in_for_one_function_only() -> None:
    run(
        f"""
from mvseg.system.torchvision_import import DYNAMO, _StandIn
sys.modules[DYNAMO] = _StandIn(DYNAMO)
from torch._dynamo.utils import counters
import torch._dynamo.utils
assert counters is torch._dynamo.utils.counters and '{COMPILER}' in sys.modules
"""
    )


def test_a_compiler_that_is_loaded_already_stays() -> None:
    run(
        """
import torch._dynamo.utils
import mvseg.detectors
from torchvision.ops import roi_align
assert sys.modules["torchvision.ops.roi_align"].is_compile_supported is torch._dynamo.utils.is_compile_supported
"""
    )
