"""Fine-tuning a single-view detector: epochs, evaluation, checkpoints, on one process or many.

One optimisation step takes `batch_size` samples, in chunks of `images_per_forward`. torchrun's processes share the
chunks of a step; a single process works through them one after another and adds up the gradients. Each chunk seeds the
random samplers of torchvision's losses from (seed, step, chunk), and no norm looks at the batch
(`detectors/mask_rcnn.py`). So a run depends on `batch_size` and `images_per_forward` but not on the number of
processes, except for the order in which gradients are added up: torchvision normalises its losses over the images of
one forward call, and these are the same images.

All randomness is a function of the seed and the step. A killed run therefore resumes with the same bits (on a CPU, with
the same number of threads) without the state of any generator or scheduler in its checkpoint.

Files in `output`: run.json (what the folder is), config.yaml (resolved), log.jsonl (losses by step), metrics.json (by
epoch), model.safetensors (the best epoch by mask AP; without validation samples the last), checkpoint.pt,
broken_samples.txt if samples were skipped.
"""

from __future__ import annotations

import json
import logging
import math
import signal
import sys
import time
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, nullcontext
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import torch
import yaml  # type: ignore[import-untyped]
from torch import Tensor, nn
from torch.nn.parallel import DistributedDataParallel
from torch.utils.data import DataLoader
from torchvision.models.detection import MaskRCNN
from tqdm import tqdm

from mvseg.detectors.mask_rcnn import count_parameters
from mvseg.detectors.run import detect
from mvseg.detectors.weights_file import Description, encode_weights
from mvseg.errors import InputError
from mvseg.evaluation.average_precision import Annotations, annotate_detections, annotate_truth, average_precision
from mvseg.results.earlier import Output, check_out, claim_folder
from mvseg.system.atomic import lock_folder, sweep_folder, write_text_whole, write_whole
from mvseg.training.augmentation import AugmentedSamples, Target, mix_seed, order_epoch
from mvseg.training.config import TrainConfig as TrainConfig
from mvseg.training.config import config_values
from mvseg.training.data import SampleList, keep_sound, list_results, list_samples, read_sample
from mvseg.training.processes import Processes, join_processes
from mvseg.training.state import TrainingState, apply_gradients, learning_rate, save_state, start_state

logger = logging.getLogger(__name__)
OUTPUT = Output("training")
Chunk = tuple[list[Tensor], list[Target], list[int]]


@dataclass(frozen=True, eq=False)
class Run:
    """Constants of a run.

    Attributes:
        processes: this process among those that train together.
        samples: the sound training samples.
        held_out: the sound validation samples, None without validation.
    """

    config: TrainConfig
    processes: Processes
    samples: SampleList
    held_out: SampleList | None

    @property
    def epoch_size(self) -> int:
        """Samples of an epoch: the photos, then the new plants."""
        return len(self.samples) + self.config.new_plants

    @property
    def steps_per_epoch(self) -> int:
        return math.ceil(self.epoch_size / self.config.batch_size)


def train(config: TrainConfig, model: MaskRCNN | None = None) -> None:
    """Train a detector and write its files into `config.output`.

    Under torchrun every process calls this with the same config. torch's global generators are left as they were.

    Args:
        model: a detector of your own, with a class for every category of the data, to train in place of
            `build_detector(config.arch, ...)`; `config.arch` is then only its name in the files. If its norms look at
            the batch, the run depends on the number of processes.

    Raises:
        InputError: broken samples (unless `skip_broken`), nothing to train on, an output folder with another run, or
            one that another process is writing to, a checkpoint of another config, weights that do not fit, a loss or
            gradient that is not finite (the message names the photos).
    """
    with join_processes(config.device) as processes:
        if config.num_chunks % processes.count:
            expected = f"expected a multiple of the number of processes ({processes.count})"
            raise InputError(f"batch_size / images_per_forward is {config.num_chunks}, {expected}")
        cuda = [processes.device] if processes.device.type == "cuda" else []
        with torch.random.fork_rng(devices=cuda):
            samples, held_out = processes.ask_first(lambda: find_samples(config))
            state = start_state(config, samples, device=processes.device, model=model)
            run = Run(config=config, processes=processes, samples=samples, held_out=held_out)
            with ExitStack() as stack:
                config.output.mkdir(parents=True, exist_ok=True)
                processes.ask_first(lambda: stack.enter_context(lock_folder(config.output)))
                run_epochs(run, state)


def find_samples(config: TrainConfig) -> tuple[SampleList, SampleList | None]:
    """The training and the validation samples, checked; broken_samples.txt is written if some are skipped. Raises
    InputError: an output folder that holds something else, broken samples, nothing to train on."""
    check_out(config.output, OUTPUT)
    parts, crowd = [], config.coco_crowd
    if config.photos is not None and config.labels is not None:
        parts.append(list_samples(config.photos, config.labels, crowd=crowd))
    parts += [] if config.from_results is None else [list_results(config.from_results)]
    if len({part.categories for part in parts}) > 1:
        expected = f"expected {parts[1].categories} as results"
        raise InputError(f"{config.labels} has categories {parts[0].categories}, {expected}")
    samples, held_out = SampleList(sum((part.samples for part in parts), ()), parts[0].categories), None
    if config.val_photos is not None and config.val_labels is not None:
        held_out = list_samples(config.val_photos, config.val_labels, crowd=crowd)
        if held_out.categories != samples.categories:
            raise InputError(f"{config.val_labels} has categories {held_out.categories}, expected {samples.categories}")
    elif every := config.hold_out_every:
        indices = range(len(samples))
        held_out = samples.select(indices[::every])
        samples = samples.select([index for index in indices if index % every])
    keep = partial(keep_sound, skip_broken=config.skip_broken, skip_unlabelled=config.skip_unlabelled)
    samples, broken = keep(samples, "training")
    problems = list(broken.values())
    if held_out is not None:
        held_out, broken = keep(held_out, "validation")
        problems += broken.values()
    logger.info("%d samples to train on, %d to validate, %d skipped", len(samples), len(held_out or ()), len(problems))
    if problems:
        claim_folder(config.output, OUTPUT)
        write_text_whole(config.output / "broken_samples.txt", "\n".join(problems) + "\n")
    return samples, held_out


def run_epochs(run: Run, state: TrainingState) -> None:
    """Train and evaluate until the last epoch; the first process writes the files."""
    if run.processes.is_first:
        output = run.config.output
        claim_folder(output, OUTPUT)
        sweep_folder(output)
        write_text_whole(output / "config.yaml", yaml.safe_dump(config_values(run.config), sort_keys=False))
        cut_log(output / "log.jsonl", state.step)
    network: nn.Module = state.model
    if run.processes.count > 1:
        network = DistributedDataParallel(state.model)
    chunks = load_chunks(run, state.step)
    for epoch in range(len(state.history), run.config.epochs):
        started = time.monotonic()
        train_epoch(run, state, network=network, chunks=chunks)
        losses = {name: total / run.steps_per_epoch for name, total in state.loss_sums.items()}
        scores = evaluate(run, state) if run.held_out is not None else {}
        record = {"epoch": epoch, "step": state.step, **losses, **scores}
        shown = ", ".join(f"{name} {value:.3f}" for name, value in record.items() if isinstance(value, float))
        logger.info("epoch %d of %d: %s", epoch + 1, run.config.epochs, shown)
        state.history.append(record | {"seconds": round(time.monotonic() - started, 1)})
        state.loss_sums = {}
        if run.processes.is_first:
            close_epoch(run, state)
    logger.info("finished; %s holds epoch %d", run.config.output / "model.safetensors", best_epoch(state.history) + 1)


def train_epoch(run: Run, state: TrainingState, *, network: nn.Module, chunks: Iterator[Chunk]) -> None:
    """Do the remaining steps of the current epoch, with checkpoints on the way and one at the end.

    `network` is the state's model, wrapped if several processes train; `chunks` are those of this process from the
    state's step on. Raises InputError: a loss or a gradient is not finite; the message names the photos.
    """
    config, epoch, num_steps = run.config, len(state.history), run.steps_per_epoch
    first = state.step - epoch * num_steps
    hidden = None if run.processes.is_first else True  # None: hidden unless on a terminal
    for step in tqdm(range(first, num_steps), f"epoch {epoch + 1}", num_steps, initial=first, disable=hidden):
        rate = learning_rate(config, state.step, num_steps * config.epochs)
        losses = add_gradients(run, state, network=network, chunks=chunks)
        if not apply_gradients(config, state, rate):
            batch = order_epoch(run.epoch_size, config.batch_size, seed=config.seed, epoch=epoch)[step]
            raise not_finite("gradient", run, state, batch)
        for name, value in losses.items():
            state.loss_sums[name] = state.loss_sums.get(name, 0.0) + value
        if run.processes.is_first:
            if state.step % config.log_every == 0:
                with (config.output / "log.jsonl").open("a", encoding="utf-8") as log:
                    log.write(json.dumps({"step": state.step, "lr": rate, **losses}) + "\n")
            if state.step % config.checkpoint_every == 0 or step == num_steps - 1:
                save_state(state, config, run.samples)


def add_gradients(run: Run, state: TrainingState, *, network: nn.Module, chunks: Iterator[Chunk]) -> dict[str, float]:
    """Forward and backward of this process's chunks of a step; the losses and their sum "loss", averaged over all
    chunks of all processes."""
    processes, config = run.processes, run.config
    state.optimizer.zero_grad()
    numbers = range(processes.rank, config.num_chunks, processes.count)
    sums: dict[str, Tensor] = {}
    for number in numbers:
        photos, targets, indices = next(chunks)
        photos = [photo.to(processes.device, non_blocking=True) for photo in photos]
        targets = [{key: value.to(processes.device) for key, value in target.items()} for target in targets]
        torch.manual_seed(mix_seed(config.seed, state.step, number))  # torchvision samples anchors and RoIs at random
        is_last = number == numbers[-1]  # DDP averages the gradients over the processes once, with the last chunk
        with network.no_sync() if isinstance(network, DistributedDataParallel) and not is_last else nullcontext():
            with torch.autocast(processes.device.type, torch.bfloat16, enabled=state.is_bf16):
                losses = network(photos, targets)
            losses = {name: value.float() for name, value in losses.items()}
            losses["loss"] = torch.stack(list(losses.values())).sum()
            if not math.isfinite(losses["loss"].item()):
                raise not_finite("loss", run, state, indices)
            (losses["loss"] / len(numbers)).backward()
        for name, value in losses.items():
            sums[name] = sums.get(name, torch.zeros_like(value)) + value.detach() / config.num_chunks
    return processes.add_up(sums)


def not_finite(what: str, run: Run, state: TrainingState, indices: list[int]) -> InputError:
    photos = [sample.name for sample in run.samples.samples]
    names = ", ".join(photos[index] if index < len(photos) else f"new plant {index}" for index in indices)
    which = f"the {what} of step {state.step} (epoch {len(state.history) + 1})"
    return InputError(f"{which} is not finite on {names}: look at these photos, or lower lr, or set precision to fp32")


def load_chunks(run: Run, first_step: int) -> Iterator[Chunk]:
    """This process's chunks of all steps from `first_step` to the end of the run, read and augmented by workers."""
    config = run.config
    keys, size = [], config.images_per_forward
    for epoch in range(first_step // run.steps_per_epoch, config.epochs):
        batches = order_epoch(run.epoch_size, config.batch_size, seed=config.seed, epoch=epoch)
        for batch in batches[max(0, first_step - epoch * run.steps_per_epoch) :]:
            for number in range(run.processes.rank, config.num_chunks, run.processes.count):
                keys.append([(epoch, index) for index in batch[number * size : (number + 1) * size]])
    loader = DataLoader(
        AugmentedSamples(run.samples, run.config),
        batch_sampler=keys,
        num_workers=config.num_workers,
        collate_fn=collate,
        pin_memory=run.processes.device.type == "cuda",
        worker_init_fn=_leave_signals,
    )
    return iter(loader)


def _leave_signals(_: int) -> None:
    """Workers end with their parent, which alone handles SIGTERM. Errors of samples still reach the parent."""
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    sys.excepthook = lambda *_: None


def collate(items: list[tuple[Tensor, Target, int]]) -> Chunk:
    photos, targets, indices = (list(column) for column in zip(*items, strict=True))
    return photos, targets, indices


def evaluate(run: Run, state: TrainingState) -> dict[str, float | None]:
    """Average precision on the validation samples, which the processes share; the same dict in every process."""
    assert run.held_out is not None
    processes = run.processes
    indices = range(processes.rank, len(run.held_out), processes.count)
    shown = tqdm(indices, "evaluating", disable=None if processes.is_first else True, leave=False)
    state.result.eval()
    truth, detections = detect_and_label(state.result, run.held_out, shown)
    state.model.train()
    return average_precision(processes.gather(truth), processes.gather(detections), len(run.held_out))


@torch.no_grad()
def detect_and_label(model: MaskRCNN, samples: SampleList, indices: Iterable[int]) -> tuple[Annotations, Annotations]:
    """Truth and detections (with "score") of those samples as COCO annotations without ids; the index is `image_id`.
    The model is in eval mode; photos go to the device of its parameters. Raises InputError: a sample cannot be read."""
    device = next(model.parameters()).device
    truth: Annotations = []
    detections: Annotations = []
    for index in indices:
        labelled = read_sample(samples.samples[index])
        truth += annotate_truth(labelled, index, len(samples.categories))
        photo = (labelled.photo.float() / 255).to(device)
        detections += annotate_detections(*detect(model, photo), index)
    return truth, detections


# --- files of the run


def cut_log(path: Path, step: int) -> None:
    """Remove the records after `step`, and a torn last line: what a killed run did after its last checkpoint."""
    if not path.is_file():
        return
    rows = []
    for line in path.read_text(encoding="utf-8").splitlines():
        try:
            record = json.loads(line)
        except json.JSONDecodeError:
            break
        if record["step"] <= step:
            rows.append(line + "\n")
    write_text_whole(path, "".join(rows))


def close_epoch(run: Run, state: TrainingState) -> None:
    """Export the weights if the epoch is the best so far, then metrics and the checkpoint."""
    config, output, best = run.config, run.config.output, best_epoch(state.history)
    if best == len(state.history) - 1:
        description = Description(config.arch, run.samples.categories, config.image_size)
        weights = encode_weights(state.result.state_dict(), description)
        write_whole(output / "model.safetensors", lambda partial: partial.write_bytes(weights))
    metrics = {
        "best_epoch": best,
        "best": state.history[best],
        "finished": len(state.history) == config.epochs,
        "num_parameters": count_parameters(state.model),
        "num_training_samples": run.epoch_size,
        "num_validation_samples": len(run.held_out or ()),
        "epochs": state.history,
    }
    write_text_whole(output / "metrics.json", json.dumps(metrics, indent=2, allow_nan=False) + "\n")
    save_state(state, config, run.samples)


def best_epoch(history: list[dict[str, Any]]) -> int:
    """Index of the record with the largest mask AP, the first of equals; the last record when none has one."""
    if all(record.get("mask_AP") is None for record in history):
        return len(history) - 1
    return max(range(len(history)), key=lambda index: history[index].get("mask_AP") or 0.0)
