"""One plant, from the first matching to the last edit; and given masks, matched."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from mvseg.arrays import Bools
from mvseg.corrections.corrected import Fate, RejectedPixel
from mvseg.detection.numbers import DETECTION
from mvseg.errors import collect_warnings
from mvseg.findings.finding import Finding
from mvseg.masks import Masks
from mvseg.matching.match import match_masks
from mvseg.matching.result import Matching
from mvseg.pipeline.open_scene import Opened
from mvseg.results.result import NOTHING_LEARNED, Instances, Learned
from mvseg.scene import Scene
from mvseg.system.running import timed
from mvseg.verification.candidates import JOINED, Key
from mvseg.verification.choose import Edited, RejectedCandidate, add_beside, choose_leaves, find_again
from mvseg.verification.joined_halves import join_halves
from mvseg.verification.leaf_color import colored_shares
from mvseg.verification.leaf_scores import Rating, rate_pass
from mvseg.verification.picture import colors_of_leaves

if TYPE_CHECKING:  # loads torchvision
    from mvseg.detection.detect_scene import Pass


@dataclass(frozen=True, eq=False)
class Plant:
    """Masks of one plant: which one shows which leaf, and what else there is to choose from.

    Whoever made the masks, a plant is the same: given masks are proposals of which all are sure.

    Attributes:
        matching: D masks with their ids, and a report on the scene.
        proposals: R masks on the CPU, the excessive set of the detector and joined halves, or the given masks.
        matched: {source of candidates: table of matched proposals}, see `SOURCES`.
        image_size: longer side of the photos, or of their parts, as the segmenter saw them; pixels.
        boxes: (V, 4) int64 xyxy, the parts of the photos that the segmenter saw.
        instances: initial surfaces (`starts`) and probabilities of the leaves.
        agreement: of the views about the leaves, see `Leaves`; NaN where they do not choose.
        keys: {instance id: key of the candidate that it was}.
        refused: pixels without a mask where the user says that no leaf is.
        disagreement: finding on views that disagree about the masks, see `find_disagreement`; None: they agree.
        colors: of leaves, by which the plant is rated; None: its own.
        findings: of the pass that found it, to warn of if it stays.
    """

    opened: Opened
    matching: Matching
    proposals: Masks
    matched: Mapping[str, Masks]
    image_size: int
    boxes: Tensor
    instances: Instances = field(default_factory=Instances)
    rejected: tuple[RejectedCandidate, ...] = ()
    agreement: float = float("nan")
    keys: Mapping[int, Key] = field(default_factory=dict)
    edits: tuple[Fate, ...] = ()
    refused: tuple[RejectedPixel, ...] = ()
    learned: Learned = NOTHING_LEARNED
    disagreement: Finding | None = None
    colors: Bools | None = None
    findings: tuple[Finding, ...] = ()

    @property
    def scene(self) -> Scene:
        """The scene with the views that were taken."""
        return self.opened.scene

    @property
    def masks(self) -> Masks:
        """The table of masks."""
        return self.matching.masks

    @cached_property
    def rating(self) -> Rating:
        """See `rate_pass`."""
        masks, photos = self.masks.to("cpu"), self.opened.photos
        colored, pixel = None, self.longest_side / self.image_size
        if photos.exist:
            colored = colored_shares(masks, photos, self.leaf_colors if self.colors is None else self.colors)
        return rate_pass(masks, self.instances.probabilities, pixel=pixel, colored=colored)

    @property
    def longest_side(self) -> int:
        """Longer side of the parts of the photos that the segmenter saw, pixels."""
        return int((self.boxes[:, 2:] - self.boxes[:, :2]).max())

    @cached_property
    def editable(self) -> Masks:
        """Masks that the user sees and edits: given masks, or accepted ones and, beside them, sure detections that show
        something else."""
        return self.masks if self.opened.holds else add_beside(self.masks, self.matched["matched"], self.scene.cameras)

    def ids_of(self, masks: Masks) -> Tensor:
        """(D,) int64, the leaf that each mask of a later table showed here: -1 for none, and for masks made since."""
        ids = torch.full((len(self.proposals) + 1,), -1)
        ids[self.masks.proposal.cpu()] = self.masks.instance_ids.cpu()
        return ids[masks.proposal.cpu().clamp(min=-1)]  # the last one is -1

    @cached_property
    def leaf_colors(self) -> Bools:
        """The colours of leaves, see `colors_of_leaves`."""
        return colors_of_leaves(self.masks.to("cpu"), self.opened.photos)

    def with_masks(self, masks: Masks) -> Plant:
        """The same with other masks of the same leaves."""
        return replace(self, matching=self.matching.with_masks(masks))

    def choose(self, edited: Edited | None = None) -> Plant:
        """Choose leaves, see `choose_leaves`."""
        with timed("choose"):
            leaves = choose_leaves(self.proposals, self.matched, self.opened.judges, edited=edited)
        instances = Instances(starts=leaves.surfaces, probabilities=leaves.probabilities)
        chosen = replace(self, instances=instances, rejected=leaves.rejected, agreement=leaves.agreement)
        return replace(chosen, keys=leaves.keys).with_masks(leaves.masks)

    def add_joined(self) -> Plant:
        """Choose once more, where surfaces judge and leaves are halves of one: joined ones are candidates, too."""
        photos, fit = self.opened.judges.photos if self.instances.starts else None, self.opened.judges.fit
        with timed("choose"):
            joined = None if photos is None else join_halves(self.masks, photos, fit)
        if joined is None:
            return self
        is_new = joined.proposal < 0
        joined = replace(joined, proposal=joined.proposal.where(~is_new, len(self.proposals) - 1 + is_new.cumsum(0)))
        proposals = Masks.concatenate((self.proposals, joined.select(is_new)))
        return replace(self, proposals=proposals, matched={**self.matched, JOINED: joined}).choose()


def match_given(opened: Opened) -> Plant:
    """The same id for given masks of the same leaf, see `match_masks`, and `choose_leaves`."""
    given = opened.given
    assert given is not None, "expected a scene with masks"
    with timed("match"):
        matching = match_masks(given, opened.scene.cameras, config=opened.config.match)
    return make_plant(opened, matching)


def make_plant(opened: Opened, matching: Matching, detected: Pass | None = None) -> Plant:
    """A plant whose leaves the views choose, of the candidates of all `SOURCES`.

    `detected`: the pass whose sure proposals were matched. Without one, and where masks are held to what they were
    matched to, the masks of the matching are all proposals."""
    masks, frames = matching.masks.to("cpu"), whole_photos(opened.scene)
    if opened.holds or detected is None:
        masks = replace(masks, proposal=torch.arange(len(masks)))
    boxes = frames if detected is None or detected.boxes is None else detected.boxes
    plant = Plant(
        opened=opened,
        matching=matching.with_masks(masks),
        proposals=masks if opened.holds or detected is None else detected.proposals(),
        matched={},
        image_size=int(boxes.max()) if detected is None else detected.longest,
        boxes=boxes,
        disagreement=opened.find_disagreement(matching),
    )
    tables = {name: source(plant, detected) for name, source in SOURCES.items()}
    plant = replace(plant, matched={name: each for name, each in tables.items() if each is not None}).choose()
    return plant.add_joined()


def match_more(plant: Plant, detected: Pass | None) -> Masks | None:
    """Weak proposals of a detector, matched with the sure ones."""
    if detected is None or plant.opened.holds:
        return None
    with collect_warnings():  # of the sure ones already
        return detected.match(min(DETECTION.more_score, plant.opened.config.detect.min_score)).masks


def match_freed(plant: Plant, _: Pass | None) -> Masks | None:
    """Held masks that do not show their own leaf, matched again, see `find_again`."""
    if not plant.opened.holds:
        return None
    with timed("choose"):
        return find_again(plant.masks, plant.opened.judges, plant.opened.config.match)


# Each gives proposals with ids of their own. Instances that an earlier one has, by name, are not added again, so that
# the order does not matter. "matched" needs no other source; joined halves (`add_joined`) and edits are two more.
SOURCES: dict[str, Callable[[Plant, Pass | None], Masks | None]] = {
    "matched": lambda plant, _: plant.masks,
    "matched again": match_freed,
    "matched more": match_more,
}


def whole_photos(scene: Scene) -> Tensor:
    """(V, 4) int64 xyxy, boxes of the whole photos."""
    sizes = scene.cameras.sizes.cpu()
    return torch.cat((torch.zeros_like(sizes), sizes), 1)
