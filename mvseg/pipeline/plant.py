"""One plant, from the first matching to the last edit; and given masks, matched."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mvseg.corrections.corrected import Fate, RejectedPixel
from mvseg.findings.finding import Finding
from mvseg.masks import Masks
from mvseg.matching.match import match_masks
from mvseg.matching.result import Matching
from mvseg.pipeline.open_scene import Opened
from mvseg.results.result import NOTHING_LEARNED, Instances, Learned
from mvseg.scene import Scene
from mvseg.system.running import timed
from mvseg.verification.candidates import Key
from mvseg.verification.choose import Edited, Leaves, RejectedCandidate, add_beside, choose_leaves, find_again
from mvseg.verification.evidence import Drawn, draw_views
from mvseg.verification.leaf_color import colored_shares
from mvseg.verification.leaf_scores import Rating, rate_pass
from mvseg.verification.picture import colors_of_leaves


@dataclass(frozen=True, eq=False)
class Plant:
    """Masks of one plant: which one shows which leaf, and what else there is to choose from.

    Whoever made the masks, a plant is the same: given masks are proposals of which all are sure.

    Attributes:
        matching: D masks with their ids, and a report on the scene.
        proposals: R masks on the CPU, the excessive set of the detector, or the given masks.
        matched: tables of matched proposals, the sure ones first.
        image_size: longer side of the photos, or of their parts, as the segmenter saw them; pixels.
        boxes: (V, 4) int64 xyxy, the parts of the photos that the segmenter saw.
        instances: initial surfaces (`starts`) and probabilities of the leaves.
        agreement: of the views about the leaves, see `Leaves`; NaN where they do not choose.
        keys: {instance id: key of the candidate that it was}.
        refused: pixels without a mask where the user says that no leaf is.
        disagreement: finding on views that disagree about the masks, see `find_disagreement`; None: they agree.
    """

    opened: Opened
    matching: Matching
    proposals: Masks
    matched: tuple[Masks, ...]
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
        """See `rate_pass`; by the leaf colours of the plant itself."""
        return self.rate_by(self)

    def rate_by(self, other: Plant) -> Rating:
        """Rate by the leaf colours of the same plant, seen another time."""
        masks, photos = self.masks.to("cpu"), self.opened.photos
        colored = colored_shares(masks, photos, other.leaf_colors) if photos.exist else None
        pixel = self.longest_side / self.image_size
        return rate_pass(masks, self.instances.probabilities, pixel=pixel, colored=colored)

    @property
    def longest_side(self) -> int:
        """Longer side of the parts of the photos that the segmenter saw, pixels."""
        return int((self.boxes[:, 2:] - self.boxes[:, :2]).max())

    @cached_property
    def editable(self) -> Masks:
        """Masks that the user sees and edits: given masks, or accepted ones and, beside them, sure detections that show
        something else."""
        return self.masks if self.opened.holds else add_beside(self.masks, self.matched[0], self.scene.cameras)

    def ids_of(self, masks: Masks) -> Tensor:
        """(D,) int64, the leaf that each mask of a later table showed here: -1 for none, and for masks made since."""
        ids = torch.full((len(self.proposals) + 1,), -1)
        ids[self.masks.proposal.cpu()] = self.masks.instance_ids.cpu()
        return ids[masks.proposal.cpu().clamp(min=-1)]  # the last one is -1

    @cached_property
    def drawn(self) -> tuple[Drawn, ...]:
        """V views of the proposals, see `draw_views`."""
        judges = self.opened.judges
        return draw_views(self.proposals.regions, (), judges.cameras, photos=judges.photos)

    def draw_ahead(self) -> None:
        """Compute in advance what all edits of detected masks begin with."""
        _ = self.editable, [each.is_shared for each in self.drawn]

    @cached_property
    def leaf_colors(self) -> NDArray[np.bool_]:
        """The colours of leaves, see `colors_of_leaves`."""
        return colors_of_leaves(self.masks.to("cpu"), self.opened.photos)

    def with_masks(self, masks: Masks) -> Plant:
        """The same with other masks of the same leaves."""
        return replace(self, matching=self.matching.with_masks(masks))

    def with_leaves(self, leaves: Leaves) -> Plant:
        """The same with the leaves that were chosen."""
        instances = Instances(starts=leaves.surfaces, probabilities=leaves.probabilities)
        chosen = replace(self, instances=instances, rejected=leaves.rejected, agreement=leaves.agreement)
        return replace(chosen, keys=leaves.keys).with_masks(leaves.masks)

    def choose(self, edited: Edited | None = None, *, drawn: Sequence[Drawn] = ()) -> Plant:
        """Choose leaves, see `choose_leaves`."""
        with timed("choose"):
            leaves = choose_leaves(self.proposals, self.matched, self.opened.judges, edited=edited, drawn=drawn)
        return self.with_leaves(leaves)


def match_given(opened: Opened) -> Plant:
    """The same id for given masks of the same leaf, see `match_masks`, and `choose_leaves`."""
    given = opened.given
    assert given is not None, "expected a scene with masks"
    with timed("match"):
        matching = match_masks(given, opened.scene.cameras, config=opened.config.match)
    return hold_matched(opened, matching)


def hold_matched(
    opened: Opened, matching: Matching, *, image_size: int | None = None, boxes: Tensor | None = None
) -> Plant:
    """A plant of masks that are held to what they were matched to, unless surfaces say otherwise."""
    boxes = whole_photos(opened.scene) if boxes is None else boxes
    masks = matching.masks.to("cpu")
    masks = replace(masks, proposal=torch.arange(len(masks)))
    with timed("choose"):
        again = find_again(masks, opened.judges, opened.config.match)
    plant = Plant(
        opened=opened,
        matching=matching,
        proposals=masks,
        matched=(masks,) if again is None else (masks, again),
        image_size=int(boxes.max()) if image_size is None else image_size,
        boxes=boxes,
        disagreement=opened.find_disagreement(matching),
    )
    return plant.choose()


def whole_photos(scene: Scene) -> Tensor:
    """(V, 4) int64 xyxy, boxes of the whole photos."""
    sizes = scene.cameras.sizes.cpu()
    return torch.cat((torch.zeros_like(sizes), sizes), 1)
