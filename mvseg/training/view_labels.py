"""Labels for the detector from the masks that the views chose: self-training, judged by the other views.

The paper feeds the ids of clusters back into the proposals of the same network (Sec. 3.2); this feeds them back into
its weights, as self-training does with labels that a network is sure of (Xie et al., "Self-training with Noisy
Student", CVPR 2020), and test-time training with the photos at hand (Sun et al., ICML 2020). There the network judges
its own labels; here, photos of the same leaves from elsewhere do.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional
from torchvision.transforms import v2

from mvseg.crop import Box
from mvseg.evaluation.labelled_photo import LabelledPhoto, mask_photo
from mvseg.formats.photos import ReadPhoto
from mvseg.masks import SURE, Masks, Origin
from mvseg.verification.leaf_color import has_leaf_color
from mvseg.verification.numbers import CHOICE
from mvseg.verification.picture import colors_of_leaves

LIKELY = 0.5  # definition: P of a leaf that is learned: it is likelier a leaf than not


@dataclass(frozen=True, eq=False)
class ViewLabels:
    """Labels that a detector may learn from the photos of V views.

    Attributes:
        leaves: masks that are labels.
        doubtful: other masks and proposals, neither leaf nor background.
        colors: (B, B, B) bool, the colours of the leaves, see `leaf_colors`: pixels that have one are not background.
    """

    leaves: Masks
    doubtful: Masks
    colors: NDArray[np.bool_]

    @property
    def num_leaves(self) -> int:
        """How many leaves have labels; a mask of the user that is matched to nothing is a leaf of its own."""
        ids = self.leaves.instance_ids
        return len(ids[ids > 0].unique()) + int((ids < 1).sum())

    @property
    def are_enough(self) -> bool:
        """Whether there are `CHOICE.least_leaves` to learn from."""
        return self.num_leaves >= CHOICE.least_leaves

    def in_photo(self, view: int, photo: np.ndarray, box: Box, *, size: tuple[int, int]) -> LabelledPhoto:
        """The labels of one view in the part `box`, xyxy, of its photo (H, W, 3) uint8 RGB, scaled to `size` (height,
        width). Ignored are pixels of doubtful masks, and leaf-coloured ones, but for those of labels."""
        x1, y1, x2, y2 = box
        part = torch.from_numpy(photo[y1:y2, x1:x2].copy()).permute(2, 0, 1)
        small = v2.functional.resize(part, list(size), antialias=True).permute(1, 2, 0).contiguous().numpy()
        doubtful = self.doubtful.regions
        covered = doubtful.label_map(view, torch.ones_like(doubtful.view_index), (photo.shape[1], photo.shape[0])) > 0
        ignore = has_leaf_color(small, self.colors) | _scale(covered[y1:y2, x1:x2], size)
        rows = (self.leaves.view_index == view).nonzero()[:, 0].tolist()
        shown = [_scale(self.leaves.regions.placed(row).within(box).pixels, size) for row in rows]
        masks = [mask for mask in shown if mask.any()]
        return mask_photo(small, masks, classes=[1] * len(masks), ignore=ignore)


def label_views(masks: Masks, proposals: Masks, photos: ReadPhoto, *, probabilities: Mapping[int, float]) -> ViewLabels:
    """Labels for a detector from the masks that the views chose; too few to learn from unless they `are_enough`.

    Args:
        masks: D masks with ids; match scores are q, how likely a mask shows its leaf.
        proposals: R masks, everything else that a detector took for a leaf.
        probabilities: {id: P}, how likely each instance is a leaf; see `are_labels`.
    """
    is_label = are_labels(masks, probabilities)
    leaves = masks.select(is_label)
    doubtful = Masks.concatenate((masks.select(~is_label), proposals))
    return ViewLabels(leaves=leaves, doubtful=doubtful, colors=colors_of_leaves(leaves, photos))


def are_labels(masks: Masks, probabilities: Mapping[int, float]) -> Tensor:
    """Select masks to learn from, (D,) bool.

    A mask is a label when it likely shows its instance (match score of at least `SURE`), this is likely a leaf (P of at
    least `LIKELY`; an instance without a P is one), and a detector or a user found it there; or when the user made or
    confirmed it. Masks that surfaces of other views made (`Origin.OTHER_VIEWS`) are none.
    """
    is_seen = masks.origin != Origin.OTHER_VIEWS
    unlikely = torch.tensor([each for each, chance in probabilities.items() if chance < LIKELY], dtype=torch.int64)
    is_likely = (masks.instance_ids > 0) & ~torch.isin(masks.instance_ids, unlikely)
    return masks.is_corrected | (is_likely & is_seen & (masks.match_scores >= SURE))


def _scale(mask: Tensor, size: tuple[int, int]) -> NDArray[np.bool_]:
    scaled = functional.interpolate(mask[None, None].byte(), size, mode="nearest-exact")
    return scaled[0, 0].bool().numpy()
