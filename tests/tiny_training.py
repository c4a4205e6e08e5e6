"""A tiny data set and a tiny Mask R-CNN for the training tests; as a script, two processes that share steps.

The script imports everything once and forks: imports take longer than the runs.
"""

from __future__ import annotations

import os
import socket
import sys
import traceback
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import jsonargparse
import numpy as np
import torch
from safetensors.torch import load_file
from torch import Tensor, nn
from torchvision.models.detection import MaskRCNN
from torchvision.models.detection.anchor_utils import AnchorGenerator
from torchvision.models.detection.faster_rcnn import FastRCNNPredictor, TwoMLPHead
from torchvision.models.detection.mask_rcnn import MaskRCNNHeads, MaskRCNNPredictor
from torchvision.ops import MultiScaleRoIAlign

from mvseg.detectors.mask_rcnn import build_detector
from mvseg.detectors.weights_file import Description, encode_weights
from mvseg.training.loop import TrainConfig, train


def write_photos(folder: Path, count: int, size: int = 64) -> tuple[Path, Path]:
    """`count` photos of 0 to 3 bright ellipses with label PNGs; the first photo is empty."""
    rng = np.random.default_rng(7)
    for name in ("photos", "labels"):
        (folder / name).mkdir(parents=True)
    for index in range(count):
        photo = rng.integers(20, 60, (size, size, 3), dtype=np.uint8)
        labels = np.zeros((size, size), np.uint16)
        for leaf in range(min(index, 3)):
            center, axes = rng.integers(15, size - 15, 2).tolist(), rng.integers(6, 14, 2).tolist()
            angle, color = float(rng.integers(180)), rng.integers(120, 255, 3).tolist()
            cv2.ellipse(photo, center, axes, angle, 0, 360, color, -1)
            cv2.ellipse(labels, center, axes, angle, 0, 360, leaf + 1, -1)
        cv2.imwrite(str(folder / "photos" / f"leaf_{index}.png"), photo)
        cv2.imwrite(str(folder / "labels" / f"leaf_{index}.png"), labels)
    return folder / "photos", folder / "labels"


class TinyBackbone(nn.Sequential):
    """Stride 8, 16 channels."""

    out_channels = 16

    def __init__(self) -> None:
        super().__init__(
            nn.Conv2d(3, 16, 5, 4, 2), nn.GroupNorm(2, 16), nn.ReLU(), nn.Conv2d(16, 16, 3, 2, 1), nn.ReLU()
        )


def build_tiny(num_classes: int = 2) -> MaskRCNN:
    """About 40 thousand parameters, the same ones every time; RoIs and anchors are sampled, so seeds matter."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(3)
        return MaskRCNN(
            TinyBackbone(),
            rpn_anchor_generator=AnchorGenerator(((8, 16, 32),), ((0.7, 1.4),)),
            rpn_batch_size_per_image=32,
            rpn_pre_nms_top_n_train=100,
            rpn_post_nms_top_n_train=50,
            rpn_pre_nms_top_n_test=50,
            rpn_post_nms_top_n_test=20,
            box_roi_pool=MultiScaleRoIAlign(["0"], 5, 2),
            box_head=TwoMLPHead(16 * 5 * 5, 32),
            box_predictor=FastRCNNPredictor(32, num_classes),
            box_batch_size_per_image=16,
            box_score_thresh=0.01,
            mask_roi_pool=MultiScaleRoIAlign(["0"], 8, 2),
            mask_head=MaskRCNNHeads(16, (16,), 1),
            mask_predictor=MaskRCNNPredictor(16, 16, num_classes),
        )


def make_config(folder: Path, output: Path, **changes: Any) -> TrainConfig:
    """12 steps: two epochs of six, four photos each, two forward passes per step."""
    settings: dict[str, Any] = {
        "photos": folder / "photos",
        "labels": folder / "labels",
        "output": output,
        "hold_out_every": 5,
        "image_size": 64,
        "epochs": 2,
        "batch_size": 4,
        "images_per_forward": 2,
        "lr": 2e-2,
        "warmup_steps": 2,
        "ema_decay": 0.9,
        "precision": "fp32",
        "device": "cpu",
        "num_workers": 0,
        "checkpoint_every": 2,
        "log_every": 1,
    }
    return TrainConfig(**settings | changes)


def write_finished_run(folder: Path) -> Path:
    """The files of a finished training run of the smaller architecture, three categories, without the training."""
    folder.mkdir()
    (folder / "model.safetensors").write_bytes(_finished_weights())
    (folder / "metrics.json").write_text('{"best": {"epoch": 3, "mask_AP": 0.5, "mask_AP50": 0.75}}')
    (folder / "config.yaml").write_text("arch: mobilenet_v3_large_fpn\n")
    return folder


@cache
def _finished_weights() -> bytes:
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        model = build_detector("mobilenet_v3_large_fpn", 4)
    return encode_weights(model.state_dict(), Description("mobilenet_v3_large_fpn", ("a", "b", "c"), 96))


def parse_config(path: Path) -> TrainConfig:
    """A YAML file as the command line reads it."""
    parser = jsonargparse.ArgumentParser(exit_on_error=False)
    parser.add_class_arguments(TrainConfig)
    return TrainConfig(**vars(parser.parse_path(path)))


def load_weights(path: Path) -> dict[str, Tensor]:
    return load_file(path)


def fork(run: Callable[[], None]) -> int:
    """Start a process that does `run`; its process id."""
    process = os.fork()
    if process:
        return process
    try:
        run()
    except BaseException:
        traceback.print_exc()
        os._exit(1)
    os._exit(0)


def train_as(rank: int, port: int, config: TrainConfig) -> None:
    """Be one of two processes, with the environment that torchrun gives them."""
    os.environ.update(RANK=str(rank), LOCAL_RANK=str(rank), WORLD_SIZE="2")
    os.environ.update(MASTER_ADDR="127.0.0.1", MASTER_PORT=str(port))
    train(config, build_tiny())


def train_together(folder: Path, output: Path) -> bool:
    """Whether two processes get to the end of the run."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
    processes = [fork(lambda rank=rank: train_as(rank, port, make_config(folder, output))) for rank in range(2)]
    return all(os.waitpid(process, 0)[1] == 0 for process in processes)


if __name__ == "__main__":
    torch.set_num_threads(1)  # as in the tests (conftest.py): bits are compared
    sys.exit(not train_together(*map(Path, sys.argv[1:])))
