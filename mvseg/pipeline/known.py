"""What is known of a scene, from the first matching to the last edit; and masks that were given, matched."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from mvseg.corrections.corrected import Fate, Refused
from mvseg.findings.finding import Finding
from mvseg.masks import Masks
from mvseg.matching.match import match_masks
from mvseg.matching.result import Matching
from mvseg.matching.split import split_merged
from mvseg.pipeline.open_scene import Opened
from mvseg.results.result import NOTHING_LEARNED, Instances, Learned
from mvseg.scene import Scene
from mvseg.system.running import timed
from mvseg.verification.choose import add_beside
from mvseg.verification.evidence import Drawn, draw_views
from mvseg.verification.leaf_color import colors_of_leaves
from mvseg.verification.leaf_scores import rate_pass

if TYPE_CHECKING:
    from mvseg.verification.choose import Leaves, LeftOut


@dataclass(frozen=True, eq=False)
class Known:
    """What is known of a scene: which mask shows which leaf, and what else there is to choose from.

    Attributes:
        opened: the scene as it was opened.
        matching: the masks with their ids, and what matching says of the scene.
        instances: `starts` and `probabilities` of those that the views chose; nothing else.
        proposals: R masks on the CPU, the excessive set of the detector; those that were given.
        matched: tables of masks of it that are matched, the sure ones first; () where masks were given.
        image_size: pixels, the longer side of the photos, or of their parts, as the detector saw them; 0 where masks
            were given.
        boxes: (V, 4) int64 xyxy, the parts of the photos that it looked at; None: all of them.
        left: candidates that the views did not choose.
        edits: what came of a person's edits; () without any.
        refused: pixels where a person says that no leaf is, and where no mask is.
        learned: by the detector from this scene.
        disagreement: where the views disagree about the masks, see `find_disagreement`.
    """

    opened: Opened
    matching: Matching
    instances: Instances
    proposals: Masks
    matched: tuple[Masks, ...]
    image_size: int
    boxes: Tensor | None
    left: tuple[LeftOut, ...]
    edits: tuple[Fate, ...] = ()
    refused: tuple[Refused, ...] = ()
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

    @property
    def agreed_area(self) -> float:
        """Pixels, see `rate_pass`."""
        return rate_pass(self.masks, self.instances.probabilities)

    @property
    def longest_side(self) -> int:
        """Pixels, of the photos or of their parts that the detector looked at."""
        sizes = self.scene.cameras.sizes if self.boxes is None else self.boxes[:, 2:] - self.boxes[:, :2]
        return int(sizes.max())

    @cached_property
    def shown(self) -> Masks:
        """The masks that a person sees, and edits: those that were given, or those that the views chose, and what else
        was surely detected beside these."""
        if self.opened.is_chosen:
            return add_beside(self.masks, self.matched[0], self.scene.cameras)
        return self.masks if self.opened.given is None else self.proposals

    @cached_property
    def drawn(self) -> tuple[Drawn, ...]:
        """V views of the proposals, see `draw_views`."""
        return draw_views(self.proposals.regions, (), self.scene.cameras.to("cpu"))

    def draw_ahead(self) -> None:
        """Find what all edits of chosen masks begin with, before anybody waits for the first one."""
        _ = self.shown, [each.is_shared for each in self.drawn]

    @cached_property
    def leaf_colors(self) -> NDArray[np.bool_]:
        """The colours of leaves, see `colors_of_leaves`."""
        return colors_of_leaves(self.masks.to("cpu"), self.opened.photos)

    def with_masks(self, masks: Masks) -> Known:
        """The same with other masks. Gaps between their ids close; what is known of the instances follows."""
        return replace(
            self, matching=self.matching.with_masks(masks.close_gaps()), instances=self.instances.close_gaps(masks)
        )

    def with_leaves(self, leaves: Leaves) -> Known:
        """The same with the leaves that the views chose."""
        instances = Instances(starts=leaves.surfaces, probabilities=leaves.probabilities)
        return replace(self, instances=instances, left=leaves.left).with_masks(leaves.masks)

    def cut_merged(self) -> Known:
        """Masks that show two leaves are cut, where that is asked for; surfaces know best which ones do, so where they
        check the ids, they come first."""
        return self.with_masks(split_merged(self.masks)) if self.opened.is_cut else self


def match_given(opened: Opened) -> Known:
    """The same id for given masks of the same leaf, see `match_masks`."""
    given = opened.given
    assert given is not None, "expected a scene with masks"
    with timed("match"):
        matching = match_masks(given, opened.scene.cameras, config=opened.config.match)
    known = Known(
        opened=opened,
        matching=matching,
        instances=Instances(),
        proposals=given.to("cpu"),
        matched=(),
        image_size=0,
        boxes=None,
        left=(),
        disagreement=opened.find_disagreement(matching),
    )
    return known.cut_merged()
