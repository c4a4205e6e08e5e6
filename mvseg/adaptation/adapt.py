"""`adapt_detector`: detect, match, keep what the views confirm, learn from it, look again."""

from __future__ import annotations

import json
import math
import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path

import torch

from mvseg.adaptation.config import AdaptConfig
from mvseg.adaptation.labels import FoundLeaves, write_labels
from mvseg.config import RunConfig
from mvseg.detection.crops import boxes_to_look_at
from mvseg.detectors.weights_file import Description, encode_weights, read_weights
from mvseg.detectors.zoo import find_weights
from mvseg.errors import InputError, InputWarning
from mvseg.formats.photos import check_photos, read_photo
from mvseg.formats.scene_folder import load_scene
from mvseg.matching.match import check_baselines
from mvseg.pipeline import detect_regions, pose_scene
from mvseg.scene import Scene
from mvseg.system.atomic import lock_folder, write_text_whole, write_whole
from mvseg.training.config import TrainConfig
from mvseg.training.loop import train
from mvseg.verification.other_views import hear_witnesses
from mvseg.verification.sure_masks import confirmed_masks

SCALES = (0.7, 1.4)  # training samples against the size of the detection
LEAST_KEPT = 0.5  # of the masks found, by the other views: where they keep fewer, labels are wrong too often


@dataclass(frozen=True)
class Agreement:
    """How far a detector and the other views agree.

    Attributes:
        num_found: masks that the detector finds in all photos.
        num_kept: masks that are left of these when the other views are heard.
        num_labels: masks that are sure enough to learn from, with those that only the other views show.
        num_photos: photos with such a mask.
    """

    num_found: int
    num_kept: int
    num_labels: int
    num_photos: int

    @staticmethod
    def of(scenes: Sequence[FoundLeaves]) -> Agreement:
        views = [leaves.revised.view_index[leaves.confirmed].unique() for leaves in scenes]
        return Agreement(
            num_found=sum(len(leaves.found) for leaves in scenes),
            num_kept=sum(leaves.num_kept for leaves in scenes),
            num_labels=sum(int(leaves.confirmed.sum()) for leaves in scenes),
            num_photos=sum(len(each) for each in views),
        )


def adapt_detector(
    folders: Sequence[Path],
    out: Path,
    config: AdaptConfig = AdaptConfig(),
    *,
    run: RunConfig = RunConfig(),
    progress: bool = False,
) -> tuple[Agreement, Agreement]:
    """Fine-tune a detector on the photos of its own scenes; masks that the other views confirm or show are labels.

    One round: what the new detector finds would confirm the mistakes of the old one. Nothing that the views leave open
    is learned as background, see `write_labels`.

    Args:
        folders: scene folders with photos.
        out: gets `weights.safetensors`, for `detect.weights`; `labels/`, the photos with their labels, to look at;
            `training/`, the training run; `agreement.json`. Goes on where a killed run stopped.
        config: of the adaptation.
        run: how leaves are found (`detect.weights` is what is adapted) and matched.
        progress: show progress bars.

    Returns:
        How far the views agree with the old and the new weights. InputWarnings say so where they keep less than half of
        what the old ones find (labels are wrong then), and where they agree less with the new ones.

    Raises:
        InputError: a scene without photos, weights for several categories, no confirmed mask at all, or what `train`
            raises.
    """
    weights, description = read_adaptable(run.detect.weights)
    names = [folder.resolve().name for folder in folders]
    if len(set(names)) < len(names):
        raise InputError(f"two of the scenes {', '.join(names)} have one name, expected different names")
    scenes = {name: load_scene(folder) for name, folder in zip(names, folders, strict=True)}
    for scene in scenes.values():
        check_photos(scene)
        check_baselines(scene.cameras)
    out.mkdir(parents=True, exist_ok=True)
    with lock_folder(out):
        size = detection_size(scenes.values(), run.detect.image_size, usual=description.image_size)
        found = find_leaves(scenes, config, size, run=run, keep=out / "detections", progress=progress)
        before = Agreement.of(found)
        if not before.num_labels:
            least = f"in {config.min_views} views with a match score of {config.min_match_score:g}"
            raise InputError(f"none of the {before.num_found} masks found is confirmed {least}: nothing to learn from")
        if before.num_kept < LEAST_KEPT * before.num_found:
            message = f"the other views keep only {before.num_kept} of the {before.num_found} masks found"
            message = f"{message}: expect wrong labels, and worse weights; look at {out / 'labels'}"
            warnings.warn(message, InputWarning, stacklevel=2)
        if not (out / "training" / "config.yaml").is_file():
            write_labels(found, out / "labels", longest_side=math.ceil(SCALES[1] * size), progress=progress)
        train(
            TrainConfig(
                photos=out / "labels" / "images",
                labels=out / "labels" / "labels",
                output=out / "training",
                arch=description.arch,
                weights=str(weights),
                image_size=config.image_size,
                orientation="upright",
                scale_range=(SCALES[0] * size / config.image_size, SCALES[1] * size / config.image_size),
                epochs=math.ceil(config.num_samples / before.num_photos),
                lr=config.lr,
                warmup_steps=20,
                ema_decay=0.99,
                light_probability=0.3,
                seed=config.seed,
                checkpoint_every=25,
                num_workers=0,
                resume=True,
            )
        )
        adapted = out / "weights.safetensors"
        write_adapted(out / "training" / "model.safetensors", adapted, image_size=size)
        run = replace(run, detect=replace(run.detect, weights=str(adapted)))
        after = Agreement.of(find_leaves(scenes, config, size, run=run, keep=out / "detections", progress=progress))
        text = json.dumps({"before": asdict(before), "after": asdict(after)}, indent=1) + "\n"
        write_text_whole(out / "agreement.json", text)
    if after.num_kept * before.num_found < before.num_kept * after.num_found or after.num_labels < before.num_labels:
        message = f"the other views kept {before.num_kept} of {before.num_found} masks before and keep {after.num_kept}"
        message = f"{message} of {after.num_found} now: the old weights may be the better ones"
        warnings.warn(message, InputWarning, stacklevel=2)
    return before, after


def read_adaptable(name: str) -> tuple[Path, Description]:
    """The file of these weights, and what it says.

    Raises:
        InputError: no such weights, a file that does not say what it holds, or several categories.
    """
    path = find_weights(name) or Path(name)
    _, description = read_weights(path)
    if description is None:
        raise InputError(f"{path} does not say its architecture, expected a model.safetensors of a training run")
    if len(description.categories) != 1:
        raise InputError(f"{path} has the categories {', '.join(description.categories)}, expected one to adapt")
    return path, description


def detection_size(scenes: Iterable[Scene], image_size: int | None, *, usual: int) -> int:
    """The longer side at which the detector sees the photos: `image_size`, or `usual` where none is asked for (then
    smaller photos stay as they are)."""
    return image_size or min(usual, max(int(scene.cameras.sizes.max()) for scene in scenes))


def find_leaves(
    scenes: Mapping[str, Scene],
    config: AdaptConfig,
    size: int,
    *,
    run: RunConfig,
    keep: Path,
    progress: bool = False,
) -> list[FoundLeaves]:
    """Detect and match in every scene, photos with a longer side of at most `size` pixels, and hear the other views."""
    found = []
    for name, scene in scenes.items():
        detections, matching = detect_regions(scene, run, keep=keep, progress=progress)
        scene = pose_scene(scene, matching)
        photos = partial(read_photo, scene)
        revised, rematched, _ = hear_witnesses(
            detections, matching, cameras=scene.cameras, photos=photos, progress=progress
        )
        assert revised.from_views is not None  # the other views were heard
        whole, boxes = torch.nn.functional.pad(scene.cameras.sizes, (2, 0)), None
        if run.detect.crop == "auto":
            boxes = boxes_to_look_at(revised.regions, rematched, scene.cameras, longest=size)
        confirmed = confirmed_masks(
            revised.regions, rematched, min_match_score=config.min_match_score, min_views=config.min_views
        )
        found.append(
            FoundLeaves(
                name=name,
                scene=scene,
                boxes=whole if boxes is None else boxes,
                found=detections.regions,
                revised=revised.regions,
                confirmed=confirmed,
                num_kept=int((~revised.from_views).sum()),
            )
        )
    return found


def write_adapted(trained: Path, path: Path, *, image_size: int) -> None:
    """The weights of a training run, for photos of this size (longer side, pixels)."""
    state, description = read_weights(trained)
    assert description is not None  # every training run writes one
    content = encode_weights(state, replace(description, image_size=image_size))
    write_whole(path, lambda partial: partial.write_bytes(content))
